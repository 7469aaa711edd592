"""The numba kernels against their plain torch references, gradients included, and against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import CUBE_FACES
from instant_ic.nerf import (
    FieldConfig,
    TrainConfig,
    box_room,
    kernels,
    march,
    reference,
)
from instant_ic.nerf.config import GeometryConfig
from instant_ic.nerf.field import FieldParameters, Lattice, Scene
from instant_ic.nerf.numba_device import NumbaDevice
from instant_ic.nerf.occupancy import build_occupancy
from instant_ic.nerf.prior import prepare
from instant_ic.nerf.reference import TorchField
from instant_ic.nerf.torch_device import TorchDevice, torch_prior
from instant_ic.nerf.view import perspective_rays

F = np.float32
FOCUS = np.array([0.3, 0.2, -0.5, 0.01], F)  # pixels of 1 cm a metre: levels of 1 cm and less fade away


def random_field(levels, features, hidden=16, log2_table=10, seed=3):
    config = FieldConfig(levels=levels, features=features, hidden=hidden, log2_table=log2_table)
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


@pytest.mark.parametrize(("levels", "features", "count"), [(8, 4, 200), (8, 2, 64), (2, 2, 1)])
def test_query_agrees_with_the_reference(levels, features, count):
    p, lattice = random_field(levels, features)
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
    kernels.encode_block(
        table, np.array([1.0], F), np.zeros(3, F), np.zeros(4, F), np.array([[0.25, 0.5, 0.0]], F), 0, 1, x
    )
    # A pixel of 0 rad leaves all levels whole. 0.75·0.5·1 + 0.25·0.5·10 + 0.75·0.5·10 + 0.25·0.5·1 = 5.5
    assert x[:, 0] == pytest.approx([5.5] * 4)


@pytest.mark.parametrize(("levels", "features", "count"), [(8, 4, 300), (4, 2, 70)])
def test_gradient_agrees_with_autograd(levels, features, count):
    p, lattice = random_field(levels, features)
    points = random_points(count)
    rng = np.random.default_rng(0)
    target = rng.normal(size=(count, 4)).astype(F)
    colour_weight = rng.random(count).astype(F)
    distance_weight = rng.random(count).astype(F)
    table_grad, touched = np.zeros_like(p.table), np.zeros(p.table.shape[:2], np.uint8)
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
    assert not np.any(has_gradient & (touched == 0))


def test_adam_agrees_with_torchs_sparse_adam():
    rng = np.random.default_rng(1)
    table = rng.normal(size=(1, 32, 4)).astype(F)
    theirs = torch.from_numpy(table[0].copy()).requires_grad_()
    ours, m, v, grad = table.copy(), np.zeros_like(table), np.zeros_like(table), np.zeros_like(table)
    touched = np.zeros((1, 32), np.uint8)
    second, m2, v2 = (torch.from_numpy(a.copy()) for a in (table, m, v))
    adam = torch.optim.SparseAdam([theirs], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    for step in range(1, 6):
        rows = rng.choice(32, 7, replace=False)
        values = rng.normal(size=(7, 4)).astype(F)
        grad[0, rows], touched[0, rows] = values, 1
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
    return Scene(prior, Lattice.for_prior(prior, FieldConfig()), build_occupancy(prior, GeometryConfig()))


def test_sampled_rays_agree_with_the_reference(scene):
    prior = scene.prior
    uniform = np.random.default_rng(2).random((64 * 32, 3), F)
    points, target = np.zeros((2 * 64 * 32, 3), F), np.zeros((2 * 64 * 32, 4), F)
    pose = prior.map_from_camera.astype(F)
    march.sample_rays(
        uniform, 64, 32, prior.rgb, prior.inverse_depth, prior.torn, pose, F(prior.band), points, target
    )  # fmt: skip
    expected = reference.sample_rays(torch.from_numpy(uniform), 64, 32, torch_prior(scene, "cpu"))
    # At an edge a rounding decides which side is nearest: a few points in thousands may differ.
    same = np.isclose(points, expected[0].numpy(), atol=1e-3).all(axis=1)
    assert same.mean() > 0.998
    np.testing.assert_allclose(target[same], expected[1].numpy()[same], atol=2e-3)


def test_sampled_rays_lie_on_the_room_and_are_even_by_solid_angle(scene):
    prior = scene.prior
    columns, rows = 64, 32
    uniform = np.random.default_rng(2).random((columns * rows, 3), F)
    points, target = np.zeros((2 * columns * rows, 3), F), np.zeros((2 * columns * rows, 4), F)
    pose = prior.map_from_camera.astype(F)
    march.sample_rays(
        uniform, columns, rows, prior.rgb, prior.inverse_depth, prior.torn, pose, F(prior.band), points, target
    )  # fmt: skip
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
    inverse, torn = np.full((32, 64), 0.5, F), np.zeros((32, 64), np.uint8)
    uniform = np.full((64, 3), 0.5, F)
    uniform[:, 2] = 0.75  # half way to the band's far end
    points, target = np.zeros((128, 3), F), np.zeros((128, 4), F)
    march.sample_rays(uniform, 8, 8, rgb, inverse, torn, np.eye(4, dtype=F), F(0.1), points, target)
    flat = math.sqrt(1 - 0.875**2)
    direction = [flat * math.cos(math.radians(157.5)), flat * math.sin(math.radians(157.5)), 0.875]
    assert points[0] == pytest.approx([2 * d for d in direction], abs=1e-5)
    assert points[64] == pytest.approx([2.1 * d for d in direction], abs=1e-5)  # 2 m · (1 + 0.1 · 0.5)
    assert target[0] == pytest.approx([0.5, 51 / 255 - 0.5, -0.5, 0], abs=1e-6)
    assert target[64] == pytest.approx([0.5, 51 / 255 - 0.5, -0.5, -0.5], abs=1e-6)  # behind the surface: negative


@pytest.mark.parametrize(("share", "depth_share"), [(0.0, 0.0), (0.6, 0.5), (1.0, 1.0)])
def test_rendering_agrees_with_the_reference(scene, share, depth_share):
    # A field that has learnt the room a little, drawn by both from aside.
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
    expected_colour, expected_depth, expected_confidence = torch_device.draw(rays, share, depth_share)
    device.first_stride = 1
    colour, depth, confidence = device.draw(rays, share, depth_share)
    same = np.isclose(depth, expected_depth, rtol=0.005)
    assert same.mean() > 0.98  # a rounding decides at cell borders and edges
    assert np.mean(expected_depth > 0) > 0.8
    assert np.mean(confidence[same] != expected_confidence[same]) < 0.005
    assert np.quantile(np.abs(colour[same] - expected_colour[same]), 0.99) < 0.02
    # Interpolating between every fourth pixel's depth changes little where both meet a surface.
    device.first_stride = 4
    _, depth, _ = device.draw(rays, share, depth_share)
    both = (depth > 0) & (expected_depth > 0)
    relative = np.abs(depth[both] / expected_depth[both] - 1)
    assert np.median(relative) < 0.003
    assert np.quantile(relative, 0.95) < 0.03


def test_training_steps_agree_with_the_reference(scene):
    field_config, train = FieldConfig(levels=4, log2_table=12), TrainConfig(ray_columns=32, ray_rows=16)
    devices = NumbaDevice(field_config, train), TorchDevice(field_config, train, "cpu")
    rng = np.random.default_rng(6)
    for device in devices:
        device.set_scene(scene)
    for _ in range(10):
        uniform = rng.random((32 * 16, 3), F)
        ours, theirs = (device.step(uniform, 0.02, 0.005) for device in devices)
        assert ours == pytest.approx(theirs, rel=0.05)


def test_the_march_by_hand():
    # The network's output is its bias, the same everywhere, with the colour (0.6, 0.7, 0.8). The scene is a sphere of
    # 2 m round the camera, the band 5 %.
    rgb = np.random.default_rng(0).integers(0, 255, (32, 64, 3)).astype(np.uint8)
    prior = prepare(rgb, np.full((32, 64), 2.0, F), np.eye(4), 0.0, GeometryConfig(band_min=0.05), 2048)
    scene = Scene(prior, Lattice.for_prior(prior, FieldConfig()), build_occupancy(prior, GeometryConfig()))
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
        colour, depth, _ = device.draw(rays, 0.0, 0.0)
        assert depth.min() > 1.88
        assert depth.max() < 2.12
        assert colour == pytest.approx(np.tile([0.6, 0.7, 0.8], (512, 1)), abs=1e-5)
    scene.occupancy.distance[...] = 30  # nothing anywhere
    _, depth, confidence = device.draw(rays, 1.0, 0.0)
    assert not depth.any()
    assert not confidence.any()
