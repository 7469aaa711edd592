"""The numba kernels against their plain torch references, gradients included, and against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import CUBE_FACES
from instant_ic.vspace import FieldConfig, TrainConfig
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.nerf import kernels, march, reference
from instant_ic.vspace.nerf.field import FieldParameters, Lattice, StackedPriors, TrainingScene, ray_sources
from instant_ic.vspace.nerf.numba_device import NumbaDevice
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.nerf.reference import TorchField
from instant_ic.vspace.prior import MOVED, prepare
from instant_ic.vspace.view import perspective_rays
from tests import box_room
from tests.vspace.torch_device import TorchDevice, torch_priors

F = np.float32
FOCUS = np.array(
    [[0.3, 0.2, -0.5, 0.01], [2.0, 1.0, 0.5, 0.02]], F
)  # pixels of 1 cm a metre: levels of 1 cm and less fade away


def random_field(levels, hidden=16, log2_table=10, seed=3):
    config = FieldConfig(levels=levels, hidden=hidden, log2_table=log2_table)
    p = FieldParameters.random(config, seed)
    rng = np.random.default_rng(seed)
    p.table[...] = rng.normal(size=p.table.shape)
    p.b1[...] = rng.normal(size=p.b1.shape)
    p.b2[...] = rng.normal(size=p.b2.shape)
    lattice = Lattice(np.array([0.1, -0.2, 0.3], F), np.geomspace(0.7, 40, levels).astype(F))
    return p, lattice


def torch_field(p, lattice):
    tensors = [torch.from_numpy(a.copy()).requires_grad_() for a in (p.table, *p.network())]
    return TorchField(
        *tensors, torch.from_numpy(lattice.cells_per_m), torch.from_numpy(lattice.origin), torch.from_numpy(FOCUS)
    )


def random_points(count, seed=5):
    return np.random.default_rng(seed).uniform(-4, 4, (count, 3)).astype(F)


@pytest.mark.parametrize(("levels", "count"), [(8, 200), (8, 64), (2, 1)])
def test_query_agrees_with_the_reference(levels, count):
    p, lattice = random_field(levels)
    points = random_points(count)
    out = np.empty((count, 4), F)
    kernels.query(p.table, *p.network(), lattice.cells_per_m, lattice.origin, FOCUS, points, out)
    expected = reference.query(torch_field(p, lattice), torch.from_numpy(points)).detach().numpy()
    np.testing.assert_allclose(out, expected, rtol=2e-3, atol=2e-3)


def test_encoding_by_hand():
    # One level, one cell a metre. Point (0.25, 0.5, 0): weights 0.75 and 0.25 along x, 0.5 along y, all on z = 0.
    # Entries: x ^ (y · 2654435761) with y = 1 and 2654435761 & 15 = 1, so (0,0) → 0, (1,0) → 1, (0,1) → 1, (1,1) → 0.
    table = np.zeros((1, 16, 4), F)
    table[0, 0], table[0, 1] = 1.0, 10.0
    x = np.zeros((4, kernels.BLOCK), F)
    entries, weights = np.zeros((1, 8, kernels.BLOCK), np.uint32), np.zeros((1, 8, kernels.BLOCK), F)
    point, origin, focus = np.array([[0.25, 0.5, 0.0]], F), np.zeros(3, F), np.zeros((1, 4), F)
    kernels.encode_block(table, np.array([1.0], F), origin, focus, point, 0, 1, entries, weights, x)
    # A pixel of 0 rad leaves all levels whole. 0.75·0.5·1 + 0.25·0.5·10 + 0.75·0.5·10 + 0.25·0.5·1 = 5.5
    assert x[:, 0] == pytest.approx([5.5] * 4)


@pytest.mark.parametrize(("levels", "count"), [(8, 300), (4, 70)])
def test_gradient_agrees_with_autograd(levels, count):
    p, lattice = random_field(levels)
    points = random_points(count)
    rng = np.random.default_rng(0)
    target = rng.normal(size=(count, 4)).astype(F)
    colour_weight = rng.random(count).astype(F)
    distance_weight = rng.random(count).astype(F)
    table_grad, touched = np.zeros_like(p.table), kernels.no_marks(p.table)
    g1, gb1, g2, gb2 = (np.zeros_like(a) for a in p.network())
    errors = kernels.gradient(
        p.table, *p.network(), lattice.cells_per_m, lattice.origin, FOCUS, points, target,
        colour_weight, distance_weight,
        table_grad, touched, g1, gb1, g2, gb2,
    )  # fmt: skip
    field = torch_field(p, lattice)
    losses = reference.loss(
        reference.query(field, torch.from_numpy(points)),
        *(torch.from_numpy(a) for a in (target, colour_weight, distance_weight)),
    )
    expected = torch.autograd.grad(sum(losses), field.parameters())
    assert errors == pytest.approx([float(loss.detach()) for loss in losses], rel=1e-3)
    for ours, theirs in zip((table_grad, g1, gb1, g2, gb2), expected, strict=True):
        scale = float(theirs.abs().max())
        np.testing.assert_allclose(ours / scale, theirs.numpy() / scale, atol=1e-3)
    has_gradient = (expected[0] != 0).any(dim=2).numpy()
    assert not np.any(has_gradient & (np.repeat(touched, kernels.MARKED, axis=1) == 0))


def test_adam_agrees_with_torchs_sparse_adam():
    rng = np.random.default_rng(1)
    table = rng.normal(size=(1, 32, 4)).astype(F)
    theirs = torch.from_numpy(table[0].copy()).requires_grad_()
    ours, m, v, grad = table.copy(), np.zeros_like(table), np.zeros_like(table), np.zeros_like(table)
    touched = kernels.no_marks(table)
    second, m2, v2 = (torch.from_numpy(a.copy()) for a in (table, m, v))
    adam = torch.optim.SparseAdam([theirs], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    for step in range(1, 6):
        rows = rng.choice(32, 7, replace=False)
        values = rng.normal(size=(7, 4)).astype(F)
        grad[0, rows], touched[0, rows // kernels.MARKED] = values, 1  # and their neighbours are left alone
        step_size = 0.01 * math.sqrt(1 - 0.99**step) / (1 - 0.9**step)
        reference.adam_touched(second, torch.from_numpy(grad.copy()), m2, v2, step_size, 0.9, 0.99, 1e-15)
        kernels.adam_touched(ours, grad, touched, m, v, np.full(1, step_size, F), F(0.9), F(0.99), F(1e-15))
        theirs.grad = torch.sparse_coo_tensor(rows[None], torch.from_numpy(values), (32, 4), check_invariants=True)
        adam.step()
        np.testing.assert_allclose(ours[0], theirs.detach().numpy(), rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(ours, second.numpy(), rtol=1e-3, atol=1e-5)
        assert not grad.any()
        assert not touched.any()


@pytest.fixture(scope="module")
def scene():
    pose = pose_matrix(0.3, -0.1, 0.05, 0.02, -0.03, 0.7)
    picture = box_room.panorama(pose, 128)
    depth = picture.depth_m.copy()
    depth[60:64, 40:60] = 0  # a patch without depth
    prior = prepare(picture.rgb, depth, pose, 0.02, GeometryConfig(), 2048)
    return TrainingScene((prior,), Lattice.for_prior(prior, FieldConfig()), build_occupancy((prior,), GeometryConfig()))


@pytest.fixture(scope="module")
def two_keyframes():
    """A scene of two keyframes: the older one is darker, half of its picture is masked, its depth is unsure there."""
    config = GeometryConfig()
    newest = pose_matrix(0.3, -0.1, 0.05, 0.02, -0.03, 0.7)
    older = pose_matrix(-1.0, 0.8, 0.0, 0.0, 0.02, -2.0)
    pictures = [box_room.panorama(pose, 64) for pose in (newest, older)]
    sigma = np.full(pictures[1].depth_m.shape, 0.04, F)
    sigma[:20] = 0.08
    priors = [
        prepare(pictures[0].rgb, pictures[0].depth_m, newest, 0.02, config, 2048),
        prepare((pictures[1].rgb * 0.8).astype(np.uint8), pictures[1].depth_m, older, sigma, config, 2048),
    ]
    occupancy = build_occupancy(priors, config)
    priors[1].content[:, :64] = MOVED
    gains = np.array([[1, 1, 1], [1.25, 1.25, 1.2]], F)
    return TrainingScene(tuple(priors), Lattice.for_prior(priors[0], FieldConfig()), occupancy, gains)


def sampled(scene, uniform, columns, rows, sources):
    stack, count = StackedPriors.of(scene), 2 * columns * rows
    points, target, weight = np.zeros((count, 3), F), np.zeros((count, 4), F), np.zeros((count, 2), F)
    march.sample_rays(
        uniform, columns, rows, sources, stack.rgb, stack.inverse_depth, stack.depth_edge, stack.usable, stack.trust,
        stack.map_from_camera, stack.gains, stack.band, points, target, weight,
    )  # fmt: skip
    return points, target, weight


@pytest.mark.parametrize("name", ["scene", "two_keyframes"])
def test_sampled_rays_agree_with_the_reference(name, request):
    scene = request.getfixturevalue(name)
    uniform = np.random.default_rng(2).random((64 * 32, 3), F)
    sources = ray_sources(len(scene.priors), 32, 3)
    ours = sampled(scene, uniform, 64, 32, sources)
    priors = torch_priors(scene, "cpu")
    expected = reference.sample_rays(torch.from_numpy(uniform), 64, 32, priors, torch.from_numpy(sources))
    # At an edge a rounding decides which side is nearest: a few points in thousands may differ.
    same = np.isclose(ours[0], expected[0].numpy(), atol=1e-3).all(axis=1)
    assert same.mean() > 0.998
    np.testing.assert_allclose(ours[1][same], expected[1].numpy()[same], atol=2e-3)
    assert (ours[2] == expected[2].numpy()).mean() > 0.998


def test_rays_of_several_keyframes(two_keyframes):
    # Points of both keyframes lie on the same walls; colours of the darker one are brought to the newest's exposure;
    # where it is masked nothing counts, where its depth is unsure it counts a quarter: (0.04 / 0.08)².
    uniform = np.random.default_rng(2).random((64 * 32, 3), F)
    older = np.ones(32, np.int32)
    points, target, weight = sampled(two_keyframes, uniform, 64, 32, older)
    surface = points.reshape(-1, 2, 64, 3)[:, 0].reshape(-1, 3)
    gap = np.minimum(np.abs(surface - box_room.ROOM_LOW), np.abs(surface - box_room.ROOM_HIGH)).min(axis=1)
    assert np.quantile(gap, 0.8) < 0.02
    assert set(np.unique(weight[:, 0])) == {0, 1}
    assert weight[:, 0].mean() == pytest.approx(0.5, abs=0.02)
    assert np.unique(weight[weight[:, 0] > 0, 1]) == pytest.approx([0.25, 1.0])
    colour = target.reshape(-1, 2, 64, 4)[:, 0, :, :3].reshape(-1, 3)
    direction = np.sin((np.arange(64) + 0.5) * math.pi / 64)
    picture = box_room.panorama(two_keyframes.priors[1].map_from_camera, 64).rgb / 255 - 0.5
    even = (picture.mean(axis=1) * direction[:, None]).sum(axis=0) / direction.sum()
    assert colour.mean(axis=0) == pytest.approx(even, abs=0.02)


def test_sampled_rays_lie_on_the_room_and_are_even_by_solid_angle(scene):
    uniform = np.random.default_rng(2).random((64 * 32, 3), F)
    points, _, _ = sampled(scene, uniform, 64, 32, np.zeros(32, np.int32))
    pose = scene.prior.map_from_camera.astype(F)
    surface = points.reshape(-1, 2, 64, 3)[:, 0].reshape(-1, 3)
    # Each lies on a wall (one coordinate at a limit) or on the box inside.
    gap = np.minimum(np.abs(surface - box_room.ROOM_LOW), np.abs(surface - box_room.ROOM_HIGH)).min(axis=1)
    inside_box = np.all((surface > box_room.BOX_LOW - 0.05) & (surface < box_room.BOX_HIGH + 0.05), axis=1)
    assert np.quantile(gap[~inside_box], 0.95) < 0.01
    assert inside_box.sum() > 10
    # A sixth of the rays goes into each of the six faces (equal solid angles).
    direction = (surface - pose[:3, 3]) @ pose[:3, :3]
    shares = [
        np.mean(np.argmax(direction @ np.array(list(CUBE_FACES.values()))[:, :, 0].T, axis=1) == face)
        for face in range(6)
    ]
    assert shares == pytest.approx([1 / 6] * 6, abs=0.01)


def test_a_rays_direction_and_colour_by_hand():
    # Level camera at the origin looking along x; everything 2 m away. Stratum (0, 0) of 8 × 8, in its middle:
    # turn 1/16, so azimuth 180° − 22.5° = 157.5°; height z = 1 − 2/16 = 0.875.
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[...] = (255, 51, 0)
    inverse, depth_edge = np.full((32, 64), 0.5, F), np.zeros((32, 64), np.uint8)
    uniform = np.full((64, 3), 0.5, F)
    uniform[:, 2] = 0.75  # half way to the band's far end
    points, target, weight = np.zeros((128, 3), F), np.zeros((128, 4), F), np.zeros((128, 2), F)
    one = np.ones((1, 32, 64), F)
    march.sample_rays(
        uniform, 8, 8, np.zeros(1, np.int32), rgb[None], inverse[None], depth_edge[None], one.astype(np.uint8), one / 4,
        np.eye(4, dtype=F)[None], np.ones((1, 3), F), np.array([0.1], F), points, target, weight,
    )  # fmt: skip
    assert weight == pytest.approx(np.tile([1, 0.25], (128, 1)))
    flat = math.sqrt(1 - 0.875**2)
    direction = [flat * math.cos(math.radians(157.5)), flat * math.sin(math.radians(157.5)), 0.875]
    assert points[0] == pytest.approx([2 * d for d in direction], abs=1e-5)
    assert points[64] == pytest.approx([2.1 * d for d in direction], abs=1e-5)  # 2 m · (1 + 0.1 · 0.5)
    assert target[0] == pytest.approx([0.5, 51 / 255 - 0.5, -0.5, 0], abs=1e-6)
    assert target[64] == pytest.approx([0.5, 51 / 255 - 0.5, -0.5, -0.5], abs=1e-6)  # behind the surface: negative


@pytest.mark.parametrize(
    ("name", "share", "depth_share"),
    [("scene", 0.0, 0.0), ("two_keyframes", 0.6, 0.5)],
)
def test_rendering_agrees_with_the_reference(name, share, depth_share, request):
    # A field that has learnt the room a little, drawn by both from aside.
    scene = request.getfixturevalue(name)
    field_config, train = FieldConfig(log2_table=13), TrainConfig(ray_columns=64, ray_rows=32)
    device = NumbaDevice(field_config, train)
    device.set_scene(scene)
    rng = np.random.default_rng(4)
    for _ in range(40):
        device.step(rng.random((64 * 32, 3), F), 0.04, 0.01)
    torch_device = TorchDevice(field_config, train, "cpu")
    torch_device.load(device.parameters())
    torch_device.set_scene(scene)
    rays = perspective_rays(pose_matrix(0.6, -0.5, 0, yaw=0.2), 48, 32, 1.5)
    expected_colour, expected_depth, expected_confidence = torch_device.render_rays(rays, share, depth_share)
    device.first_stride = 1
    colour, depth, confidence = device.render_rays(rays, share, depth_share)
    same = np.isclose(depth, expected_depth, rtol=0.005)
    assert same.mean() > 0.98  # a rounding decides at cell borders and edges
    assert np.mean(expected_depth > 0) > 0.8
    assert np.mean(confidence[same] != expected_confidence[same]) < 0.005
    assert np.quantile(np.abs(colour[same] - expected_colour[same]), 0.99) < 0.02
    # Interpolating between every fourth pixel's depth changes little where both meet a surface.
    device.first_stride = 4
    _, depth, _ = device.render_rays(rays, share, depth_share)
    both = (depth > 0) & (expected_depth > 0)
    relative = np.abs(depth[both] / expected_depth[both] - 1)
    assert np.median(relative) < 0.003
    assert np.quantile(relative, 0.95) < 0.03


@pytest.mark.parametrize("name", ["scene", "two_keyframes"])
def test_training_steps_agree_with_the_reference(name, request):
    field_config, train = FieldConfig(levels=4, log2_table=12), TrainConfig(ray_columns=32, ray_rows=16)
    devices = NumbaDevice(field_config, train), TorchDevice(field_config, train, "cpu")
    rng = np.random.default_rng(6)
    for device in devices:
        device.set_scene(request.getfixturevalue(name))
    for _ in range(10):
        uniform = rng.random((32 * 16, 3), F)
        ours, theirs = (device.step(uniform, 0.02, 0.005) for device in devices)
        assert ours == pytest.approx(theirs, rel=0.05)


def test_the_march_by_hand():
    # The network's output is its bias, the same everywhere, with the colour (0.6, 0.7, 0.8). The scene is a sphere of
    # 2 m round the camera, the band 5 %.
    rgb = np.random.default_rng(0).integers(0, 255, (32, 64, 3)).astype(np.uint8)
    prior = prepare(rgb, np.full((32, 64), 2.0, F), np.eye(4), 0.0, GeometryConfig(), 2048)
    scene = TrainingScene(
        (prior,), Lattice.for_prior(prior, FieldConfig()), build_occupancy((prior,), GeometryConfig())
    )
    config = FieldConfig(levels=2, log2_table=10, hidden=4)
    rays = perspective_rays(np.eye(4), 32, 16, 1.0)
    for distance in (-1.0, 1.0):
        p = FieldParameters.random(config, 1)
        p.w2[...], p.b2[...] = 0, [0.1, 0.2, 0.3, distance]
        device = NumbaDevice(config, TrainConfig())
        device.load(p)
        device.set_scene(scene)
        # Behind the surface everywhere: met at the first place in the band. In front everywhere, so that there is no
        # crossing: the place in the band that came nearest. Never outside of the band
        # (but for the interpolation between traced pixels, which takes the sphere for flat).
        colour, depth, _ = device.render_rays(rays, 0.0, 0.0)
        assert depth.min() > 1.88
        assert depth.max() < 2.12
        assert colour == pytest.approx(np.tile([0.6, 0.7, 0.8], (512, 1)), abs=1e-5)
    scene.occupancy.distance[...] = 30  # nothing anywhere
    _, depth, confidence = device.render_rays(rays, 1.0, 0.0)
    assert not depth.any()
    assert not confidence.any()
