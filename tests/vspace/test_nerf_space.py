"""The virtual space as a whole, and the making of a keyframe's prior."""

import dataclasses

import numpy as np
import pytest

from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import (
    FieldConfig,
    KeyframeError,
    NotReadyError,
    ReadinessConfig,
    SpaceState,
    TrainConfig,
    ViewContentConfig,
    VirtualSpace,
    VirtualSpaceConfig,
)
from instant_ic.vspace.composition import dissolve
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.nerf.occupancy import build_occupancy, surface_points
from instant_ic.vspace.prior import edge_quads, prepare
from instant_ic.vspace.warm_up import warm_up
from tests import box_room

CONFIG = VirtualSpaceConfig(
    device="cpu",
    field=FieldConfig(log2_table=14),
    train=TrainConfig(ray_columns=64, ray_rows=32, iterations=120),
)
FIELD_ONLY = dataclasses.replace(CONFIG, view=ViewContentConfig(field_alone=True))
CAMERA = pose_matrix(x=0.4, y=0.1, z=0.05, yaw=-0.5)


def trained(iterations, config=CONFIG, sigma=0.02):
    space = VirtualSpace(config)
    picture = box_room.panorama(CAMERA, 192)
    space.set_keyframe(picture.rgb, picture.depth_m, CAMERA, sigma)
    if iterations:
        space.train(iterations=iterations)
    return space


@pytest.fixture(scope="module")
def space():
    return trained(120)


def test_training_learns_the_room(space):
    untrained, first = trained(0, FIELD_ONLY), trained(1)
    assert first.status.psnr_db < 16  # about the spread of the room's colours round grey
    assert space.status.psnr_db > 24
    truth = box_room.perspective(CAMERA, 160, 90, 1.5).rgb
    view = space.render(CAMERA, 160, 90, 1.5)
    assert psnr_db(view.rgb, truth) > 23
    assert psnr_db(untrained.render(CAMERA, 160, 90, 1.5).rgb, truth) < 16
    assert (view.confidence > 0).mean() > 0.97


def test_a_view_from_aside_has_the_rooms_depth(space):
    pose = pose_matrix(x=0.9, y=-0.4, yaw=-0.2)
    view, truth = space.render(pose, 160, 90, 1.5), box_room.perspective(pose, 160, 90, 1.5)
    seen = view.confidence > 0
    error = np.abs(view.depth_m / truth.depth_m - 1)[seen]
    assert np.median(error) < 0.005
    assert psnr_db(view.rgb[seen], truth.rgb[seen]) > 21


def test_readiness_by_psnr_plateau_and_radius():
    rule = ReadinessConfig(psnr_db=90, plateau_iterations=20, plateau_db=50, max_radius_m=9)
    space = trained(20, VirtualSpaceConfig(device="cpu", field=CONFIG.field, train=CONFIG.train, readiness=rule), 0.05)
    assert space.status.state == SpaceState.TRAINING
    assert space.status.ready_radius_m == 0
    space.train(iterations=5)  # the 21st value shows less than 50 dB gained over 20 iterations
    assert space.status.ready_iterations == 21
    # 0.035 rad · median depth / 5 %
    median = space.keyframe.median_depth_m
    assert space.status.ready_radius_m == pytest.approx(0.035 * median / 0.05)


NEXT = pose_matrix(x=0.9, y=0.0, z=0.05, yaw=0.1)


def refreshed(space):
    picture = box_room.panorama(NEXT, 192)
    space.set_keyframe(picture.rgb, picture.depth_m, NEXT, 0.02)
    return space


def test_a_space_that_is_fit_stays_so_and_the_next_keyframe_is_shown_at_once():
    space = trained(120)
    assert space.status.state == SpaceState.READY
    refreshed(space)
    status = space.status
    assert (status.state, status.refreshing, status.ready_iterations) == (SpaceState.READY, True, 0)
    assert np.array_equal(space.keyframe.map_from_camera, NEXT)
    truth = box_room.perspective(NEXT, 80, 45, 1.5).rgb
    assert psnr_db(space.render(NEXT, 80, 45, 1.5).rgb, truth) > 23
    space.train()
    status = space.status
    assert (status.state, status.refreshing) == (SpaceState.READY, False)
    assert 5 <= status.ready_iterations < 120


def test_what_is_shown_passes_into_a_new_keyframe():
    space = VirtualSpace(dataclasses.replace(CONFIG, view=ViewContentConfig(refresh_views=4)))
    old, new = (box_room.panorama(pose, 96) for pose in (CAMERA, NEXT))
    space.set_keyframe(old.rgb, old.depth_m, CAMERA, 0.02)
    first = space.render(CAMERA, 64, 36, 1.5).rgb.astype(float)
    prepared = space.prepare(new.rgb, new.depth_m, NEXT, 0.02)
    assert np.array_equal(space.render(CAMERA, 64, 36, 1.5).rgb, first)  # preparing changes nothing
    space.show(prepared, dissolve=True)
    shown = [space.render(CAMERA, 64, 36, 1.5).rgb.astype(float) for _ in range(6)]
    assert np.array_equal(shown[3], shown[5])
    for number, picture in enumerate(shown[:4], 1):
        expected = 255 * dissolve(*(np.float32(image / 255) for image in (first, shown[5])), number / 4)
        assert picture == pytest.approx(expected, abs=2)
    # The field has not learnt it yet, and can at any time.
    assert len(space.scene.priors) == 1 and np.array_equal(space.scene.prior.map_from_camera, CAMERA)
    space.learn(prepared)
    space.train(iterations=2)
    assert space.status.iterations == 2
    assert np.array_equal(space.scene.prior.map_from_camera, NEXT)


def test_parts_that_disagree_change_at_once_and_the_others_pass():
    before = np.full((20, 40, 3), 0.5, np.float32)
    after = before + np.float32(0.02)
    after[:, 20:] = 0.9  # a door elsewhere
    image = dissolve(before, after, 0.25)
    assert image[:, :16] == pytest.approx(0.505)  # a quarter of the way
    assert image[:, 24:] == pytest.approx(0.9)


def test_another_scale_starts_anew():
    space = trained(30)
    picture = box_room.panorama(CAMERA, 192)
    space.set_keyframe(picture.rgb, 5 * picture.depth_m, CAMERA, 0.02)
    space.train(iterations=1)
    assert space.status.psnr_db < 16
    cells = space.scene.lattice.cells_per_m
    assert cells[0] == pytest.approx(trained(0).scene.lattice.cells_per_m[0] / 5, rel=1e-3)


def test_nothing_before_the_first_keyframe():
    space = VirtualSpace(CONFIG)
    assert space.status.state == SpaceState.EMPTY
    with pytest.raises(NotReadyError):
        space.train(10)
    with pytest.raises(NotReadyError):
        space.render(np.eye(4), 64, 36, 1.5)


BAD = {
    "black": ({"rgb": np.zeros((64, 128, 3), np.uint8)}, "one colour"),
    "nan depth": ({"depth": np.full((64, 128), np.nan, np.float32)}, "not finite"),
    "empty depth": ({"depth": np.zeros((64, 128), np.float32)}, "known in 0%"),
    "negative depth": ({"depth": np.full((64, 128), -1, np.float32)}, "negative"),
    "no rotation": ({"pose": np.diag([2.0, 1, 1, 1])}, "rotation"),
    "negative sigma": ({"sigma": -0.1}, "relative_sigma"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_keyframe_is_refused_and_changes_nothing(space, name):
    changes, words = BAD[name]
    picture = box_room.panorama(CAMERA, 64)
    values = {"rgb": picture.rgb, "depth": picture.depth_m, "pose": CAMERA, "sigma": 0.02, **changes}
    before = space.status
    with pytest.raises(KeyframeError, match=words):
        space.set_keyframe(values["rgb"], values["depth"], values["pose"], values["sigma"])
    assert dataclasses.astuple(space.status) == dataclasses.astuple(
        before
    )  # from Python 3.13 on, dataclasses with a NaN never compare equal


SMALL = dataclasses.replace(
    CONFIG, device="auto", field=FieldConfig(log2_table=10), train=TrainConfig(ray_columns=32, ray_rows=16)
)


def no_memory(*args):
    import torch

    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB")


def once(call):
    """Fails the first time."""
    calls = []

    def limited(*args):
        calls.append(args)
        return no_memory() if len(calls) == 1 else call(*args)

    return limited


@pytest.mark.parametrize("call", ["step", "render_rays", "set_scene"])
def test_a_gpu_without_memory_is_left_for_the_cpu_with_what_is_learnt(call, monkeypatch):
    monkeypatch.setattr("instant_ic.vspace.devices._may_have_cuda", lambda: False)
    # Pictures by the field.
    ready = dataclasses.replace(SMALL, readiness=ReadinessConfig(psnr_db=1), view=FIELD_ONLY.view)
    space, whole = trained(6, ready), trained(6, ready)
    monkeypatch.setattr(space.device, call, no_memory)
    assert not space.status.warning
    for s in (space, whole):
        if call == "set_scene":
            refreshed(s)
        s.train(iterations=4)
    views = [s.render(CAMERA, 64, 36, 1.5) for s in (space, whole)]
    # In a step Adam's moments start anew.
    least = 20 if call == "step" else 40
    assert psnr_db(views[0].rgb, views[1].rgb) > least
    assert "out of memory" in space.status.warning
    assert space.status.iterations == whole.status.iterations


def test_a_gpu_that_was_asked_for_fails_aloud_and_the_next_keyframe_recovers(monkeypatch):
    import torch

    space = trained(6, dataclasses.replace(SMALL, device="cpu"))  # any device that was asked for by name
    before = space.render(CAMERA, 64, 36, 1.5)
    with monkeypatch.context() as patch:
        patch.setattr(space.device, "set_scene", no_memory)
        with pytest.raises(torch.OutOfMemoryError):
            refreshed(space)
        assert np.array_equal(space.render(CAMERA, 64, 36, 1.5).rgb, before.rgb)  # the old space is whole
        picture = box_room.panorama(CAMERA, 192)
        patch.setattr(space.device, "set_scene", once(space.device.set_scene))
        with pytest.raises(torch.OutOfMemoryError):
            space.set_keyframe(picture.rgb, 5 * picture.depth_m, CAMERA, 0.02)  # would start anew
        assert np.array_equal(space.render(CAMERA, 64, 36, 1.5).rgb, before.rgb)
    refreshed(space)
    space.train(iterations=3)
    assert space.status.psnr_db > 5
    assert space.status.state == SpaceState.TRAINING


@pytest.mark.parametrize("keyframes", [1, 2])
def test_warm_up_leaves_nothing_to_compile(keyframes):
    from instant_ic.vspace import agreement_kernels, background_kernels, fill_kernels, warp_kernels
    from instant_ic.vspace.nerf import kernels, march

    modules = (background_kernels, agreement_kernels, fill_kernels, kernels, march, warp_kernels)
    compiled = [value for module in modules for value in vars(module).values() if hasattr(value, "signatures")]
    config = dataclasses.replace(CONFIG, keyframes=keyframes)
    warm_up(config)
    before = [len(function.signatures) for function in compiled]
    space = refreshed(trained(1, config))
    space.train(iterations=1)
    assert space.render(pose_matrix(x=2.0, y=-1.0, yaw=1.0), 64, 36, 1.5).unseen_share > 0
    assert [len(function.signatures) for function in compiled] == before


# -- prior and occupancy -------------------------------------------------------------------------------


def test_depth_edges_are_torn_and_leaning_planes_are_not():
    # A level camera 1.2 m over an endless floor: radial depth 1.2 / sin(−elevation), far rows differ by far more than
    # 10 %. An object at 2 m in columns 20 to 29 stands before it.
    height, width = 64, 128
    elevation = np.pi / 2 - (np.arange(height) + 0.5) * np.pi / height
    inverse = np.where(elevation < 0, np.sin(-elevation) / 1.2, 1 / 30.0)
    inverse = np.repeat(np.maximum(inverse, 1 / 30.0)[:, None], width, 1).astype(np.float32)
    plain = edge_quads(inverse, 0.1)
    assert plain[36:63].sum() == 0
    inverse[30:40, 20:30] = 0.5
    depth_edge = edge_quads(inverse, 0.1)
    assert depth_edge[31:38, 19].all()
    assert depth_edge[31:38, 29].all()
    assert not depth_edge[31:38, 21:28].any()
    assert not depth_edge[41:, :].any()


def test_occupancy_holds_every_surface_and_knows_distances():
    picture = box_room.panorama(CAMERA, 128)
    config = GeometryConfig()
    prior = prepare(picture.rgb, picture.depth_m, CAMERA, 0.02, config, 2048)
    grid = build_occupancy((prior,), config)
    cloud = surface_points(prior, 0.5)
    index = ((cloud - grid.origin) / grid.cell_m).astype(int)
    assert np.all(grid.distance[tuple(index.T)] == 0)
    # The camera is in free space: walls 2.35 m and more away to the sides, floor and ceiling 1.25 m (31 cells of 4 cm,
    # less the margin of two and the cell's own edge).
    cell = tuple(((CAMERA[:3, 3] - grid.origin) / grid.cell_m).astype(int))
    assert 24 <= int(grid.distance[cell]) <= 31
    assert (grid.distance == 0).mean() < 0.35
