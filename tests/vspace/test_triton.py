"""The Triton kernels against their torch references, gradients included: on a GPU, else in Triton's interpreter."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

CUDA = torch.cuda.is_available()
if not CUDA:
    os.environ["TRITON_INTERPRET"] = "1"  # before triton is imported
triton = pytest.importorskip("triton", reason="triton is not installed: make install-tests")

import triton.language as tl  # noqa: E402

from instant_ic.geometry.poses import pose_matrix  # noqa: E402
from instant_ic.vspace import FieldConfig, TrainConfig  # noqa: E402
from instant_ic.vspace.config import GeometryConfig  # noqa: E402
from instant_ic.vspace.nerf import reference  # noqa: E402
from instant_ic.vspace.nerf import triton_kernels as kernels  # noqa: E402
from instant_ic.vspace.nerf.field import FieldParameters, Lattice, TrainingScene, ray_sources  # noqa: E402
from instant_ic.vspace.nerf.occupancy import build_occupancy  # noqa: E402
from instant_ic.vspace.nerf.reference import TorchField  # noqa: E402
from instant_ic.vspace.nerf.triton_device import TritonDevice  # noqa: E402
from instant_ic.vspace.prior import prepare  # noqa: E402
from instant_ic.vspace.view import perspective_rays  # noqa: E402
from tests import box_room  # noqa: E402
from tests.vspace.torch_device import TorchDevice, torch_priors  # noqa: E402

DEVICE = "cuda" if CUDA else "cpu"
F = np.float32
FIELD = FieldConfig(levels=2, log2_table=10, hidden=16)
TRAIN = TrainConfig(ray_columns=16, ray_rows=16)  # the interpreter takes a tenth of a second and more for a block
TOLERANCE = 1e-2 if CUDA else 1e-3  # tensor cores multiply with 11 bits


def to(array):
    return torch.from_numpy(np.ascontiguousarray(array)).to(DEVICE)


def room_scene():
    priors = []
    for number in range(2):
        pose = pose_matrix(0.3 - 0.5 * number, -0.1 + 0.4 * number, 0.05, 0.02, -0.03, 0.7 + number)
        picture = box_room.panorama(pose, 64)
        depth = picture.depth_m.copy()
        depth[30:32, 20:30] = 0  # a patch without depth
        priors.append(prepare(picture.rgb, depth, pose, 0.02, GeometryConfig(), 2048))
    gains = np.array([[1, 1, 1], [0.9, 1.1, 1.2]], F)
    occupancy = build_occupancy(priors, GeometryConfig(cell_m=0.2))
    return TrainingScene(tuple(priors), Lattice.for_prior(priors[0], FIELD), occupancy, gains)


@pytest.fixture(scope="module")
def scene():
    return room_scene()


@triton.jit
def angles(y, x, out, B: tl.constexpr):
    at = tl.arange(0, B)
    tl.store(out + at, kernels._atan2(tl.load(y + at), tl.load(x + at)))


def test_angles_agree_with_torch():
    turn = torch.linspace(-math.pi + 1e-4, math.pi, 248)
    y = torch.cat([turn.sin() * 3, torch.tensor([0.0, 0, 1, -1, 0, 1e-9, 5, -5])]).to(DEVICE)
    x = torch.cat([turn.cos() * 3, torch.tensor([1.0, -1, 0, 0, 0, 1, 5, -5])]).to(DEVICE)
    out = torch.zeros(256, device=DEVICE)
    angles[(1,)](y, x, out, 256)
    assert torch.allclose(out, torch.atan2(y, x), atol=1e-6)


@pytest.mark.parametrize(("levels", "hidden"), [(2, 16), (3, 12)])
def test_gradient_agrees_with_autograd(levels, hidden):
    config = FieldConfig(levels=levels, hidden=hidden, log2_table=10)
    device = TritonDevice(config, TRAIN, DEVICE)
    rng = np.random.default_rng(3)
    p = FieldParameters.random(config, 3)
    p.table[...] = rng.normal(size=p.table.shape).astype(np.float16)  # as the kernels read it
    p.b1[...], p.b2[...] = rng.normal(size=p.b1.shape), rng.normal(size=p.b2.shape)
    device.load(p)
    count = 70  # not a whole number of blocks
    points = rng.uniform(-4, 4, (count, 3)).astype(F)
    target = rng.normal(size=(count, 4)).astype(F)
    weight = (rng.random((count, 2)) > 0.3).astype(F)
    colour_weight, distance_weight = rng.random(count).astype(F), rng.random(count).astype(F)
    cells = np.geomspace(0.7, 40, config.levels).astype(F)
    origin = np.array([0.1, -0.2, 0.3], F)
    focus = np.array([[0.3, 0.2, -0.5, 0.01], [1.0, -1.0, 0.0, 0.01]], F)
    table_grad = torch.zeros(p.table.size, device=DEVICE)
    network_grad = torch.zeros(sum(a.size for a in p.network()), device=DEVICE)
    sums = torch.zeros(4, device=DEVICE)
    block = 64
    kernels.gradient[(math.ceil(count / block),)](
        device._p.table, 1 << 10, device._p.network, to(cells), to(origin), to(focus), 2, to(points), to(target),
        to(weight), to(colour_weight), to(distance_weight), count, table_grad, network_grad, sums, **device._shape,
        B=block,
    )  # fmt: skip
    tensors = [torch.from_numpy(a.copy()).requires_grad_() for a in (p.table, *p.network())]
    field = TorchField(*tensors, *(torch.from_numpy(a) for a in (cells, origin, focus)))
    losses = reference.loss(
        reference.query(field, torch.from_numpy(points)),
        *(torch.from_numpy(a) for a in (target, colour_weight * weight[:, 0], distance_weight * weight[:, 1])),
    )
    expected = torch.autograd.grad(sum(losses), field.parameters())
    wanted = [*(float(one.detach()) for one in losses), *weight.sum(axis=0)]
    assert sums.tolist() == pytest.approx(wanted, rel=TOLERANCE)
    flat = torch.cat([grad.reshape(-1) for grad in expected[1:]])
    for ours, theirs in ((table_grad.cpu(), expected[0].reshape(-1)), (network_grad.cpu(), flat)):
        scale = float(theirs.abs().max())
        assert scale > 0
        np.testing.assert_allclose(ours.numpy() / scale, theirs.numpy() / scale, atol=TOLERANCE)


def test_a_gradient_by_hand():
    # One level in use: a point in the middle of a cell of 1 m, so that each of the eight corners has weight 1/8.
    # Network: hidden 0 = feature 0, the distance = hidden 0; so the distance is the mean of the corners' feature 0.
    config = FieldConfig(levels=1, hidden=4, log2_table=10)
    device = TritonDevice(config, TRAIN, DEVICE)
    p = FieldParameters.random(config, 1)
    for array in (*p.network(), p.table):
        array[...] = 0
    p.w1[0, 0] = p.w2[3, 0] = 1
    p.table[0, :, 0] = 0.5
    device.load(p)
    table_grad, network_grad = torch.zeros(p.table.size, device=DEVICE), torch.zeros(40, device=DEVICE)
    sums = torch.zeros(4, device=DEVICE)
    kernels.gradient[(1,)](
        device._p.table, 1 << 10, device._p.network, to(np.ones(1, F)), to(np.zeros(3, F)), to(np.zeros((1, 4), F)), 1,
        to(np.full((1, 3), 0.5, F)), to(np.array([[0, 0, 0, 0.25]], F)), to(np.ones((1, 2), F)), to(np.ones(1, F)),
        to(np.ones(1, F)), 1, table_grad, network_grad, sums, **device._shape, B=64,
    )  # fmt: skip
    # Error 0.5 − 0.25; squared 0.0625; its slope 0.5, an eighth of which is each corner's.
    assert sums.tolist() == pytest.approx([0, 0.0625, 1, 1], abs=1e-6)
    slopes = table_grad.cpu().numpy().reshape(-1, 4)
    assert slopes[:, 0].sum() == pytest.approx(0.5, abs=1e-3)
    assert 1 <= np.count_nonzero(slopes[:, 0]) <= 8
    assert not slopes[:, 1:].any()


def test_sampled_rays_agree_with_the_reference(scene):
    device = TritonDevice(FIELD, TRAIN, DEVICE)
    device.set_scene(scene)
    columns, rows = TRAIN.ray_columns, TRAIN.ray_rows
    uniform = np.random.default_rng(2).random((columns * rows, 3), F)
    device.step(uniform, 1e-6, 1e-6)
    sources = torch.from_numpy(ray_sources(len(scene.priors), columns * rows // 64, 1))
    expected = reference.sample_rays(torch.from_numpy(uniform), columns, rows, torch_priors(scene, "cpu"), sources)
    b = device._buffers
    # At an edge a rounding decides which side is nearest: few may differ.
    same = np.isclose(b.points.cpu().numpy(), expected[0].numpy(), atol=1e-3).all(axis=1)
    assert same.mean() > 0.99
    np.testing.assert_allclose(b.target.cpu().numpy()[same], expected[1].numpy()[same], atol=5e-3)
    assert np.mean(np.isclose(b.weight.cpu().numpy()[same], expected[2].numpy()[same], atol=1e-5)) > 0.995


def test_adam_agrees_with_the_reference():
    rng = np.random.default_rng(1)
    shape, levels, size, block = (2, 64, 4), 2, 64, 32
    table = torch.from_numpy(rng.normal(size=shape).astype(F))
    m, v = torch.zeros(shape), torch.zeros(shape)
    ours = [table.clone().reshape(-1).to(DEVICE), torch.zeros(table.numel(), dtype=torch.float16, device=DEVICE)]
    moments = [torch.zeros(table.numel(), device=DEVICE) for _ in range(2)]
    first = ours[1].clone()
    for step in (1, 2, 3):
        grad = torch.zeros(shape)
        grad[:, rng.choice(size, 9, replace=False)] = torch.from_numpy(rng.normal(size=(2, 9, 4)).astype(F))
        rates = torch.tensor([0.01, 0.003]) * step
        reference.adam_touched(table, grad, m, v, rates[:, None, None], 0.9, 0.99, 1e-7)
        gpu_grad = grad.reshape(-1).to(DEVICE)
        kernels.adam_table[(levels * size // block,)](
            *ours, gpu_grad, *moments, rates.to(DEVICE), size, 0.9, 0.99, 1e-7, F=4, B=block
        )
        assert not gpu_grad.any()
        np.testing.assert_allclose(ours[0].cpu().numpy(), table.numpy().reshape(-1), rtol=1e-4, atol=1e-6)
    touched = (m != 0).any(dim=2)
    assert 0 < touched.sum() < touched.numel()
    halves = ours[1].cpu().reshape(shape)
    assert torch.equal(halves[touched], table[touched].half())
    assert torch.equal(halves[~touched], first.cpu().reshape(shape)[~touched])  # untouched entries are not written


def test_adam_of_the_network_by_hand():
    # The first step with the corrections in its rate: rate · (0.1 g) / (√(0.01 g²) + ε) = rate.
    value, grad = torch.tensor([1.0, 2.0, 3.0], device=DEVICE), torch.tensor([0.5, -4.0, 0.0], device=DEVICE)
    m, v = torch.zeros(3, device=DEVICE), torch.zeros(3, device=DEVICE)
    kernels.adam_network[(1,)](value, grad, m, v, torch.tensor([0.25], device=DEVICE), 0.9, 0.99, 1e-9, COUNT=3, B=4)
    assert value.tolist() == pytest.approx([0.75, 2.25, 3.0])
    assert grad.tolist() == [0, 0, 0]
    assert m.tolist() == pytest.approx([0.05, -0.4, 0])


def test_training_steps_agree_with_the_reference(scene):
    devices = TritonDevice(FIELD, TRAIN, DEVICE), TorchDevice(FIELD, TRAIN, "cpu")
    rng = np.random.default_rng(6)
    for device in devices:
        device.set_scene(scene)
    first = last = None
    for _ in range(3):  # on a GPU, from the second on it is the graph
        uniform = rng.random((TRAIN.ray_columns * TRAIN.ray_rows, 3), F)
        ours, theirs = (device.step(uniform, 0.03, 0.01) for device in devices)
        assert ours == pytest.approx(theirs, rel=0.05)
        first, last = first or ours, ours
    assert last[0] < 0.95 * first[0]
    a, b = (device.parameters() for device in devices)
    assert np.corrcoef(a.table.reshape(-1), b.table.reshape(-1))[0, 1] > 0.99
    assert np.corrcoef(a.w1.reshape(-1), b.w1.reshape(-1))[0, 1] > 0.99


def test_rendering_agrees_with_the_reference(scene):
    torch_device = TorchDevice(FIELD, TRAIN, "cpu")
    torch_device.set_scene(scene)
    rng = np.random.default_rng(4)
    for _ in range(10):
        torch_device.step(rng.random((TRAIN.ray_columns * TRAIN.ray_rows, 3), F), 0.04, 0.01)
    device = TritonDevice(FIELD, TRAIN, DEVICE)
    device.load(torch_device.parameters())
    device.set_scene(scene)
    rays = perspective_rays(pose_matrix(0.6, -0.5, 0, yaw=0.2), 9, 6, 1.5)  # no whole tiles
    colour, depth, confidence = device.render_rays(rays, 0.6, 0.5)
    expected_colour, expected_depth, expected_confidence = torch_device.render_rays(rays, 0.6, 0.5)
    assert colour.shape == (9 * 6, 3)
    assert np.mean(expected_depth > 0) > 0.8
    same = np.isclose(depth, expected_depth, rtol=0.01)
    assert same.mean() > 0.96  # a rounding decides at cell borders and edges
    assert np.mean(confidence[same] != expected_confidence[same]) < 0.02
    assert np.quantile(np.abs(colour[same] - expected_colour[same]), 0.98) < 0.02


def test_other_geometries_are_refused():
    with pytest.raises(ValueError, match="only distance"):
        TritonDevice(FieldConfig(geometry="density"), TRAIN, DEVICE)


@pytest.mark.skipif(CUDA, reason="the tests above have compiled them for this GPU")
def test_all_kernels_compile_for_gpus_that_are_not_here(tmp_path):
    """For compute capability 8.0 and 9.0: what the interpreter takes a compiler may refuse."""
    script, root = Path(__file__).with_name("triton_compile.py"), Path(__file__).parents[2]
    settings = {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(root)}
    made = subprocess.run(
        [sys.executable, str(script), "80", "90"],
        env={**os.environ, **settings}, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr[-2000:]
    lowered = [line for line in made.stdout.splitlines() if line.startswith("ttgir")]
    assert lowered == ["ttgir gradient 80 8", "ttgir gradient 90 1", "ttgir gradient 90 16", "ttgir render_rays 90"]
    whole = [line.split()[1] for line in made.stdout.splitlines() if line.startswith("cubin")]
    assert whole == ["sample_rays", "gradient", "adam_table", "adam_network"]
