"""Pictures put together by torch, as on a GPU, against those of the CPU's kernels and values worked out by hand."""

import dataclasses
import gc
import math

import numpy as np
import pytest
import torch

from instant_ic.experiments import box_room
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import FieldConfig, PictureConfig, TrainConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace import torch_warp as kernels
from instant_ic.vspace.canvas import CpuCanvas
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.nerf.field import Rays
from instant_ic.vspace.nerf.torch_device import TorchDevice
from instant_ic.vspace.prior import SKY, prepare
from instant_ic.vspace.store import KeyframeSet, ready
from instant_ic.vspace.torch_canvas import TorchCanvas
from instant_ic.vspace.view import equirect_rays, perspective_rays
from instant_ic.vspace.warp import Pyramid

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
CAMERA = pose_matrix(0.3, -0.2, 0.1, 0.4)
SIZE = 80, 45


def keyframe(pose, height=64, unknown=None, place=0, robot=None):
    picture = box_room.panorama(pose, height)
    depth = picture.depth_m.copy()
    if unknown is not None:
        depth[unknown] = 0
    prior = prepare(picture.rgb, depth, pose, 0.02, GeometryConfig(), 2048, robot)
    return ready(place, prior, Pyramid.of(prior.rgb))


@pytest.fixture(scope="module")
def one():
    """One keyframe, a stripe of which has no depth, that shows a stand below it."""
    robot = np.zeros((64, 128), bool)
    robot[58:, 30:60] = True
    return KeyframeSet((keyframe(CAMERA, unknown=np.s_[20:40, 50:55], robot=robot),), np.ones((1, 3), np.float32))


@pytest.fixture(scope="module")
def three():
    """Three keyframes of other exposures; the oldest shows the open sky over the room."""
    places = CAMERA, pose_matrix(-1.0, 0.6, 0.0, 1.0), pose_matrix(1.0, -1.2, 0.2, -2.0)
    frames = [keyframe(pose, place=n) for n, pose in enumerate(places)]
    content = frames[2].prior.content.copy()
    content[:6] = SKY
    prior = dataclasses.replace(frames[2].prior, content=content)
    frames[2] = ready(2, prior, frames[2].warp.pyramid)
    return KeyframeSet(tuple(frames), np.array([[1, 1, 1], [0.8, 1.1, 1.2], [1.2, 0.9, 1]], np.float32))


def both(rays, shown, share=1.0, field=None):
    """The picture by the CPU's kernels and by torch: (rgb, depth, confidence, guessed) each."""
    pictures = []
    for canvas in (CpuCanvas(), TorchCanvas(DEVICE)):
        own = None if field is None else tuple(array.copy() for array in field)
        picture = canvas.draw(rays, shown, share, own, {})
        image = canvas.continued(picture, rays.shape, shown is None)
        pictures.append((*canvas.painted(picture, image), torch.as_tensor(picture.guessed).cpu().numpy()))
    return pictures


def assert_alike(expected, found):
    """A rounding may decide at edges: few pixels may differ."""
    rgb, depth, confidence, guessed = found
    assert rgb.dtype == np.uint8
    assert rgb.shape == expected[0].shape
    assert depth.shape == confidence.shape == expected[1].shape
    assert np.mean(confidence == expected[2]) > 0.998
    assert np.mean(guessed == expected[3]) > 0.998
    assert np.mean(np.isclose(depth, expected[1], rtol=2e-3)) > 0.995
    assert psnr_db(rgb, expected[0]) > 45
    seen = ((confidence > 0) & (expected[2] > 0)).reshape(rgb.shape[:2])
    assert not seen.any() or psnr_db(rgb[seen], expected[0][seen]) > 45


@pytest.mark.parametrize(
    ("pose", "fov"),
    [
        (CAMERA, 1.57),  # the keyframe's own place: over the seam of the panorama and the stripe without depth
        (CAMERA @ pose_matrix(yaw=math.pi), 1.2),
        (CAMERA @ pose_matrix(pitch=1.5), 1.2),  # the pole
        (CAMERA @ pose_matrix(pitch=-1.5), 1.2),  # and the stand
        (CAMERA @ pose_matrix(0.6, 0.4, 0, -0.3), 1.57),
        (pose_matrix(0.3, 1.5, 0.1, -0.1), 1.57),  # past the box at what it hid
        (pose_matrix(0.0, 1.96, 0), 2.0),  # 4 cm off a wall, which passes through the view's plane
        (pose_matrix(-6.0), 0.6),  # from outside: backs alone
        (pose_matrix(0, 0, 9.0), 0.6),  # nothing at all
    ],
)
def test_the_warp_is_as_the_cpu_draws_it(one, pose, fov):
    expected, found = both(perspective_rays(pose, *SIZE, fov), one)
    assert_alike(expected, found)


def test_the_views_are_what_they_should_be(one):
    """What the poses above are to show is there: a test of the test."""
    past = both(perspective_rays(pose_matrix(0.3, 1.5, 0.1, -0.1), *SIZE, 1.57), one)[0]
    assert past[3].mean() > 0.02
    own = both(perspective_rays(CAMERA @ pose_matrix(yaw=0.6), *SIZE, 2.0), one)[0]
    assert set(np.unique(own[2])) == {0.5, 1}
    backs = both(perspective_rays(pose_matrix(-6.0), *SIZE, 0.6), one)[0]
    assert backs[2].max() == 0
    assert (backs[1] > 0).mean() > 0.9
    assert both(perspective_rays(pose_matrix(0, 0, 9.0), *SIZE, 0.6), one)[0][1].max() == 0


@pytest.mark.parametrize("pose", [CAMERA @ pose_matrix(0.5, -0.3, 0, 0.2), pose_matrix(1.0, 1.4, 0.0, -0.6)])
def test_several_keyframes_are_put_together_alike(three, pose):
    expected, found = both(perspective_rays(pose, *SIZE, 1.57), three)
    rgb, depth, confidence, guessed = found
    # Whether a keyframe has looked through a place is a matter of the last bits at every depth edge.
    assert np.mean(confidence == expected[2]) > 0.98
    assert np.mean(guessed == expected[3]) > 0.98
    assert np.mean(np.isclose(depth, expected[1], rtol=2e-3)) > 0.97
    assert psnr_db(rgb, expected[0]) > 35
    alone = both(perspective_rays(pose, *SIZE, 1.57), KeyframeSet(three.keyframes[:1], three.gains[:1]))[1]
    assert psnr_db(rgb, alone[0]) < 30  # the others do count


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_warp_and_field_are_dissolved_alike(one, share):
    rng = np.random.default_rng(3)
    rays = perspective_rays(CAMERA @ pose_matrix(0.6, 0.4, 0, -0.3), *SIZE, 1.57)
    count = len(rays.axial)
    confidence = rng.choice(np.array([0, 0.5, 1], np.float32), count)
    field = rng.random((count, 3)).astype(np.float32), 2 + rng.random(count).astype(np.float32), confidence
    assert_alike(*both(rays, one, share, field))


def test_a_panorama_of_the_field_is_continued_over_the_seam():
    rng = np.random.default_rng(5)
    rays = equirect_rays(np.eye(4), 64)
    confidence = np.ones((32, 64), np.float32)
    confidence[10:20, 60:] = confidence[10:20, :5] = 0
    field = rng.random((32 * 64, 3)).astype(np.float32), 1 + rng.random(32 * 64).astype(np.float32)
    assert_alike(*both(rays, None, 0.0, (*field, confidence.reshape(-1))))


def test_a_sphere_by_hand():
    """All at 2 m, seen from 1 m ahead: 1 m in front, 3 m behind, √3 m to the side."""
    rgb = np.zeros((64, 128, 3), np.uint8)
    rgb[:, :64] = 200
    prior = prepare(rgb, np.full((64, 128), 2.0, np.float32), np.eye(4), 0.0, GeometryConfig(), 128)
    shown = KeyframeSet((ready(0, prior, Pyramid.of(rgb)),), np.ones((1, 3), np.float32))
    canvas = TorchCanvas(DEVICE)
    for yaw, metres in ((0.0, 1.0), (math.pi, 3.0), (math.pi / 2, math.sqrt(3))):
        rays = perspective_rays(pose_matrix(1.0, yaw=yaw), 33, 33, math.pi / 2)
        picture = canvas.draw(rays, shown, 1.0, None, {})
        rgb_seen, depth, confidence = canvas.painted(picture, canvas.continued(picture, (33, 33), False))
        assert depth.reshape(33, 33)[16, 16] == pytest.approx(metres, rel=2e-3)
        assert confidence.min() == 1
        if yaw == 0:
            assert rgb_seen[16, 4].tolist() == [200, 200, 200]  # columns run clockwise: the left half lies left
            assert rgb_seen[16, 28].tolist() == [0, 0, 0]


def test_fine_stripes_become_grey_in_a_small_picture():
    """Stripes of one panorama pixel under view pixels of many: their mean, 100, and no moiré."""
    rgb = np.zeros((256, 512, 3), np.uint8)
    rgb[:, ::2] = 200
    prior = prepare(rgb, np.full((32, 64), 3.0, np.float32), np.eye(4), 0.0, GeometryConfig(), 512)
    shown = KeyframeSet((ready(0, prior, Pyramid.of(rgb)),), np.ones((1, 3), np.float32))
    found = both(perspective_rays(np.eye(4), 16, 16, math.pi / 2), shown)[1]
    assert abs(found[0].astype(int) - 100).max() <= 2


def test_a_triangle_by_hand():
    """A quad 1 m ahead that spans ±45°, into 4 × 4 pixels of ±45°: all of it, at nearness 1; from behind, its back."""
    corner = math.sqrt(0.5)
    # Directions of a panorama of 4 columns: half pixels of 45°. The quad from azimuth 45° to −45°, elevation ±45°.
    rows = torch.tensor([[corner, corner], [1, 0], [corner, -corner]])
    columns = torch.tensor([[corner, corner], [1, 0], [corner, -corner], [0, -1], [-corner, -corner], [-1, 0]])
    mesh = kernels.Mesh(torch.full((2, 3), 0.5), rows, columns)  # corners 2 m away: at x = 1, y = ±1, z = ±√2
    patches = kernels.Patches(torch.tensor([0], dtype=torch.int32), torch.tensor([2], dtype=torch.uint8), mesh, False)
    buffer = torch.zeros(4, 4, dtype=torch.int32)
    kernels.draw_patches(patches, torch.eye(4), 1.0, buffer)
    assert torch.all(buffer & kernels.MARKS == kernels.KNOWN)
    assert (buffer & ~kernels.MARKS).view(torch.float32).numpy() == pytest.approx(1.0, abs=1e-6)
    ahead = torch.eye(4)
    ahead[:3, :3] = torch.tensor([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    ahead[0, 3] = 3.0  # the view looks back at the quad from 2 m beyond it
    buffer.zero_()
    kernels.draw_patches(patches, ahead, 1.0, buffer)
    # 1 m to the sides and √2 m up and down at 2 m: pixels whose centres lie at ±¼ of 2 m, not those at ±¾.
    inner = np.zeros((4, 4), int)
    inner[1:3, 1:3] = 1
    assert np.array_equal(buffer & kernels.MARKS, kernels.BEHIND * inner)
    assert (buffer & ~kernels.MARKS).view(torch.float32).numpy() == pytest.approx(0.5 * inner, abs=1e-6)


def test_rays_that_are_no_lens_are_drawn_alike(one):
    lens = perspective_rays(CAMERA @ pose_matrix(0.6, 0.4, 0, -0.3, 0.1, 0.2), *SIZE, 1.57)
    plain = Rays(lens.origin, lens.directions, lens.axial, lens.shape)
    first, second = (TorchCanvas(DEVICE).draw(rays, one, 1.0, None, {}) for rays in (lens, plain))
    assert (first.confidence == second.confidence).float().mean() > 0.998
    assert torch.isclose(first.colour, second.colour, atol=5e-3).float().mean() > 0.998


def test_work_in_small_parts_gives_the_same_bits(one, monkeypatch):
    rays = perspective_rays(CAMERA @ pose_matrix(0.6, 0.4, 0, -0.3), *SIZE, 1.57)
    whole = TorchCanvas(DEVICE).draw(rays, one, 1.0, None, {})
    monkeypatch.setattr(kernels, "FRAGMENTS", 1000)
    parts = TorchCanvas(DEVICE).draw(rays, one, 1.0, None, {})
    assert torch.equal(whole.depth, parts.depth)
    assert torch.equal(whole.colour, parts.colour)


def test_keyframes_are_let_go():
    canvas = TorchCanvas(DEVICE)
    shown = KeyframeSet((keyframe(CAMERA, 32),), np.ones((1, 3), np.float32))
    canvas.draw(perspective_rays(CAMERA, 16, 16, 1.0), shown, 1.0, None, {})
    assert len(canvas._keyframes) == 1
    del shown
    gc.collect()
    assert len(canvas._keyframes) == 0


SMALL = VirtualSpaceConfig(
    device="cpu",
    field=FieldConfig(levels=2, log2_table=10, hidden=8),
    train=TrainConfig(ray_columns=16, ray_rows=16),
    geometry=GeometryConfig(cell_m=0.3),
    keyframes=2,
)
WARP, MIXED = PictureConfig(), PictureConfig(-20.0, 60.0)


def space_on(canvas, picture=WARP):
    """A space of two keyframes, the second of which is passing in; ``canvas`` None: the CPU's own."""
    space = VirtualSpace(dataclasses.replace(SMALL, picture=picture))
    if canvas is not None:
        space._device = TorchDevice(SMALL.field, SMALL.train, "cpu")
        space._device.canvas = canvas
    for number, pose in enumerate((CAMERA, CAMERA @ pose_matrix(-0.7, 0.3, 0, 0.5))):
        room = box_room.panorama(pose, 64)
        prepared = space.prepare(room.rgb, room.depth_m, pose, 0.02)
        space.learn(space.scene_of(prepared))
        space.show(prepared, dissolve=number > 0)
    space._colour_error = 0.01  # 20 dB: half of the field, where there is any of it
    return space


@pytest.mark.parametrize("picture", [WARP, MIXED], ids=["warp", "warp and field"])
def test_a_space_shows_the_same_by_either(picture):
    """The first pictures of a keyframe that passes in, a cube and a panorama."""
    pose = CAMERA @ pose_matrix(0.4, 0.2)
    spaces = space_on(None, picture), space_on(TorchCanvas(DEVICE), picture)
    for _ in range(2):
        views = [space.render(pose, 48, 32, 1.5) for space in spaces]
        assert psnr_db(views[1].rgb, views[0].rgb) > 35
        assert np.mean(views[1].confidence == views[0].confidence) > 0.97
        assert views[1].expected_psnr_db == pytest.approx(views[0].expected_psnr_db, abs=0.3)
    told = [space.expected_psnr_db(pose) for space in spaces]
    assert told[1] == pytest.approx(told[0], abs=0.3)
    if picture is WARP:
        around = [space.render_cube(pose, 16) for space in spaces]
    else:
        around = [space.render_equirect(pose, 32) for space in spaces]
    assert psnr_db(around[1].rgb, around[0].rgb) > 33


def test_a_gpu_without_memory_for_a_picture_is_left_for_the_cpu(monkeypatch):
    monkeypatch.setattr("instant_ic.vspace.devices._may_have_cuda", lambda: False)
    space = space_on(TorchCanvas(DEVICE))
    space.config = dataclasses.replace(space.config, device="auto")
    pose = CAMERA @ pose_matrix(0.4, 0.2)
    first = space.render(pose, 48, 32, 1.5)

    def no_memory(*arguments):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")

    with monkeypatch.context() as patch:
        patch.setattr(TorchCanvas, "continued", no_memory)
        second = space.render(pose, 48, 32, 1.5)
    assert "out of memory" in space.status.warning
    assert isinstance(space._device.canvas, CpuCanvas)
    assert psnr_db(second.rgb, first.rgb) > 25
