"""Geometry as density: compositing and its gradient against torch's autograd, and against values worked out by hand."""

import math

import numpy as np
import pytest
import torch

from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import FieldConfig, TrainConfig, VirtualSpaceConfig
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.nerf import volume
from instant_ic.vspace.nerf.field import VOLUME_SAMPLES, FieldParameters, Lattice, TrainingScene, ray_sources
from instant_ic.vspace.nerf.kernels import no_marks
from instant_ic.vspace.nerf.numba_device import NumbaDevice
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.nerf.reference import TorchField, query, sample_rays
from instant_ic.vspace.prior import MOVED, prepare
from instant_ic.vspace.view import perspective_rays
from tests import box_room
from tests.vspace import volume_reference
from tests.vspace.torch_device import TorchDevice, torch_priors

F = np.float32
FIELD = FieldConfig(levels=4, log2_table=12, hidden=16, geometry="density")
TRAIN = TrainConfig(ray_columns=64, ray_rows=32)


@pytest.fixture(scope="module")
def scene():
    poses = pose_matrix(0.3, -0.1, 0.05, 0.02, -0.03, 0.7), pose_matrix(-1.0, 0.8, 0.0, 0.0, 0.02, -2.0)
    pictures = [box_room.panorama(pose, 64) for pose in poses]
    priors = [
        prepare(p.rgb, p.depth_m, pose, 0.02, GeometryConfig(), 2048) for p, pose in zip(pictures, poses, strict=True)
    ]
    occupancy = build_occupancy(priors, GeometryConfig())
    priors[1].content[:, :64] = MOVED
    return TrainingScene(tuple(priors), Lattice.for_prior(priors[0], FIELD), occupancy)


def random_parameters():
    p = FieldParameters.random(FIELD, 3)
    rng = np.random.default_rng(3)
    p.table[...] = rng.normal(size=p.table.shape)
    p.b1[...], p.b2[...] = rng.normal(size=p.b1.shape), rng.normal(size=p.b2.shape)
    return p


def test_weights_by_hand():
    # Densities e⁰ = 1 with spans 0.5 and 1, then nothing: exp(−0.5) = 0.6065, exp(−1.5) = 0.2231 of the light is left.
    raw = np.full(VOLUME_SAMPLES, -100, F)
    raw[:2] = 0
    span = np.array([0.5, 1.0, *[0.001] * (VOLUME_SAMPLES - 2)], F)
    weight, left = np.zeros(VOLUME_SAMPLES, F), np.zeros(VOLUME_SAMPLES, F)
    volume.ray_weights(raw, 0, span, weight, left)
    assert weight[:2] == pytest.approx([1 - 0.60653, 0.60653 - 0.22313], abs=1e-4)
    assert weight[2:] == pytest.approx([0] * (VOLUME_SAMPLES - 2), abs=1e-6)
    assert left[-1] == pytest.approx(0.22313, abs=1e-4)
    same = volume_reference.ray_weights(torch.from_numpy(raw)[None], torch.from_numpy(span)[None])[0].numpy()
    assert same == pytest.approx(weight, abs=1e-6)


def test_losses_by_hand():
    # One opaque sample 0.25 bands behind the surface, red 0.5 where 0.2 is wanted; the ray's depth counts half.
    output = torch.full((1, VOLUME_SAMPLES, 4), -100.0)
    output[..., :3] = 0
    output[0, 3] = torch.tensor([0.5, 0.0, 0.0, 6.0])
    offset = torch.linspace(-0.5, 1.25, VOLUME_SAMPLES)[None]
    span = torch.ones(1, VOLUME_SAMPLES)
    losses = volume_reference.volume_loss(
        output, offset, span, torch.tensor([[0.2, 0.0, 0.0]]), torch.tensor([[1.0, 0.5]])
    )
    # Colour 0.3² / 3; depth 0.5 · 0.25²; all of the light is stopped; one sample's own width: 1² · 0.25 / 3.
    assert [float(a) for a in losses] == pytest.approx([0.03, 0.03125, 0.0, 0.25 / 3], abs=1e-3)


@pytest.mark.parametrize("losses", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.1)])
def test_gradient_agrees_with_autograd(scene, losses):
    p = random_parameters()
    rng = np.random.default_rng(0)
    uniform = rng.random((16 * 8, 3), F)
    sources = ray_sources(2, 2, 3)
    assert set(sources) == {0, 1}
    priors = torch_priors(scene, "cpu")
    points, target, weight = sample_rays(torch.from_numpy(uniform), 16, 8, priors, torch.from_numpy(sources))
    table_grad, touched = np.zeros_like(p.table), no_marks(p.table)
    grads = [np.zeros_like(a) for a in p.network()]
    lattice, focus = scene.lattice, scene.focus
    errors = volume.volume_gradient(
        p.table, *p.network(), lattice.cells_per_m, lattice.origin, focus,
        points.numpy(), target.numpy(), weight.numpy(), uniform[:, 2].copy(), sources, focus[:, :3].copy(),
        np.array([prior.band for prior in priors], F), np.array(losses, F), table_grad, touched, *grads,
    )  # fmt: skip
    tensors = [torch.from_numpy(a.copy()).requires_grad_() for a in (p.table, *p.network())]
    field = TorchField(*tensors, *(torch.from_numpy(a) for a in (lattice.cells_per_m, lattice.origin, focus)))
    surface, colour, each = (a.view(-1, 2, 64, a.shape[1])[:, 0].flatten(0, 1) for a in (points, target, weight))
    number = torch.from_numpy(sources).long().repeat_interleave(64)
    samples, offset, span = volume_reference.band_samples(
        torch.from_numpy(focus[:, :3])[number], surface, torch.from_numpy(uniform[:, 2]),
        torch.tensor([prior.band for prior in priors])[number], priors[0],
    )  # fmt: skip
    output = query(field, samples.reshape(-1, 3)).reshape(*offset.shape, 4)
    terms = volume_reference.volume_loss(output, offset, span, colour[:, :3], each)
    expected = torch.autograd.grad(
        terms[0] + sum(w * term for w, term in zip(losses, terms[1:], strict=True)), field.parameters()
    )
    assert errors == pytest.approx([float(terms[0].detach()), float(terms[1].detach())], rel=1e-3)
    for ours, theirs in zip((table_grad, *grads), expected, strict=True):
        scale = float(theirs.abs().max())
        np.testing.assert_allclose(ours / scale, theirs.numpy() / scale, atol=2e-3)


def test_training_and_pictures_agree_with_the_reference(scene):
    devices = NumbaDevice(FIELD, TRAIN), TorchDevice(FIELD, TRAIN, "cpu")
    for device in devices:
        device.set_scene(scene)
    rng = np.random.default_rng(6)
    first, last = None, None
    for _ in range(30):
        uniform = rng.random((64 * 32, 3), F)
        last = devices[0].step(uniform, 0.02, 0.005)
        if first is None:
            first = last
            assert last == pytest.approx(devices[1].step(uniform, 0.02, 0.005), rel=0.02)
    assert last[0] < 0.5 * first[0]  # it learns
    devices[1].load(devices[0].parameters())
    devices[1].set_scene(scene)
    devices[0].first_stride = 1
    rays = perspective_rays(pose_matrix(0.6, -0.5, 0, yaw=0.2), 48, 32, 1.5)
    for shares in ((0.0, 0.0), (0.5, 0.5)):
        ours, theirs = (device.render_rays(rays, *shares) for device in devices)
        same = np.isclose(ours[1], theirs[1], rtol=0.005)
        assert same.mean() > 0.97
        assert np.mean(ours[1] > 0) > 0.8
        assert np.quantile(np.abs(ours[0][same] - theirs[0][same]), 0.99) < 0.02


def test_a_dense_wall_is_drawn_where_it_stands():
    # The density is the same everywhere and lets next to nothing through: each ray ends at the front of its band.
    # One that lets nearly everything through: the mean of the band, which is the guiding depth.
    rgb = np.random.default_rng(0).integers(0, 255, (32, 64, 3)).astype(np.uint8)
    prior = prepare(rgb, np.full((32, 64), 2.0, F), np.eye(4), 0.0, GeometryConfig(), 2048)
    scene = TrainingScene((prior,), Lattice.for_prior(prior, FIELD), build_occupancy([prior], GeometryConfig()))
    rays = perspective_rays(np.eye(4), 32, 16, 1.0)
    for raw, expected in ((6.0, 2 * (1 - 0.05 * 7 / 8)), (-8.0, 2.0)):
        p = FieldParameters.random(FIELD, 1)
        p.w2[...], p.b2[...] = 0, [0.1, 0.2, 0.3, raw]
        device = NumbaDevice(FIELD, TRAIN)
        device.first_stride = 1
        device.load(p)
        device.set_scene(scene)
        colour, depth, confidence = device.render_rays(rays, 0.0, 0.0)
        assert np.median(depth) == pytest.approx(expected, abs=0.004)
        # What of the light is not stopped comes from a mid-grey ground: 2 bands at e^raw a band.
        stopped = 1 - math.exp(-2 * math.exp(raw))
        assert colour == pytest.approx(np.tile(0.5 + stopped * np.array([0.1, 0.2, 0.3]), (512, 1)), abs=2e-3)
        assert confidence.min() == 1
        assert np.median(device.render_rays(rays, 0.0, 1.0)[1]) == pytest.approx(
            2.0, abs=0.004
        )  # the guiding depth alone


def test_a_field_of_density_needs_tiles_of_rays():
    with pytest.raises(ValueError, match="ray_rows must be a multiple of 16 with density"):
        VirtualSpaceConfig(field=FIELD, train=TrainConfig(ray_columns=32, ray_rows=24))
    with pytest.raises(ValueError, match="geometry must be distance or density"):
        FieldConfig(geometry="points")
