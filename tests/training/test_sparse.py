"""Fused depth for training: a revolution with faults, a local model; and photographs on surfaces."""

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import World
from instant_ic.sim.worlds import random_world
from instant_ic.training import sparse
from instant_ic.training.dataset import DatasetError
from instant_ic.training.photographs import unpack, with_photographs
from instant_ic.training.sparse import bend, misplaced, sample_prior, spoiled

SIZE = (64, 128)


@pytest.fixture(scope="module")
def world() -> World:
    return random_world(300_001)


@pytest.fixture(scope="module")
def room(world: World) -> tuple[EquirectRenderer, np.ndarray, np.ndarray, np.ndarray]:
    """Renderer, a camera's pose, the image and the true depth there."""
    renderer = EquirectRenderer(world)
    x, y, yaw = world.sample_free_poses(np.random.default_rng(0), 1)[0]
    pose = pose_matrix(x, y, 1.2, yaw=yaw)
    frame = renderer.render(pose, SIZE[1], SIZE[0])
    return renderer, pose, frame.rgb, frame.depth_m


@pytest.mark.parametrize("modelled", [0.0, 1.0])
def test_prior_of_a_revolution_and_of_a_model(room: tuple, modelled: float, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer, pose, rgb, true = room
    monkeypatch.setattr(sparse, "MODEL_SHARE", modelled)
    monkeypatch.setattr(sparse, "FAULTY_SHARE", 0.0)
    prior = sample_prior(renderer, pose, rgb, true, np.random.default_rng(1))
    assert prior is not None and prior.shape == (6, *SIZE)
    known, measured = prior[0] > 0, prior[2] > 0
    error = np.abs(prior[0] - true) / true
    assert known.mean() > 0.95 and 0.02 < measured.mean() < 0.3 and (prior[5] > 0).mean() > 0.95
    assert np.median(error[measured]) < 0.03 and np.median(error[known]) < 0.06
    assert (prior[1][known] > 0).all() and not prior[1][~known].any()
    again = sample_prior(renderer, pose, rgb, true, np.random.default_rng(1))
    np.testing.assert_array_equal(again, prior)  # nothing is left of the drive before


def test_bent_depth_is_smooth_over_the_seam() -> None:
    fields = [bend((64, 128), np.random.default_rng(seed)) for seed in range(20)]
    step = max(float(np.abs(np.log(field / np.roll(field, 1, axis=1))).max()) for field in fields)
    assert step < 0.25  # 2.8 degrees of a field whose values are 45 degrees apart
    assert 0.05 < np.std([np.log(field) for field in fields]) < 0.3


def test_faults_stay_on_their_beams_and_take_points_away() -> None:
    rng = np.random.default_rng(2)
    omega, azimuth = np.meshgrid(np.radians(np.arange(-15, 16, 2)), np.radians(np.arange(0, 360, 0.4)))
    range_m = np.where(np.abs(azimuth - np.pi) < 0.5, 2.0, 5.0).ravel()
    rays = np.stack([np.cos(omega) * np.cos(azimuth), np.cos(omega) * np.sin(azimuth), np.sin(omega)], -1).reshape(
        -1, 3
    )
    lost, changed = [], []
    for _ in range(12):
        left = spoiled(rays * range_m[:, None], rng)
        lost.append(1 - len(left) / len(rays))
        directions = left / np.linalg.norm(left, axis=1)[:, None]
        nearest = np.argmax(directions[::50] @ rays.T, axis=1)
        np.testing.assert_allclose(directions[::50], rays[nearest], atol=1e-9)
        distance = np.linalg.norm(left, axis=1)
        changed.append(float((np.minimum(np.abs(distance - 2), np.abs(distance - 5)) > 1e-6).mean()))
    assert 0 <= min(lost) < 0.1 and 0.1 < max(lost) < 0.7
    assert max(changed) > 0.01


def test_wrong_mount_is_within_its_bounds() -> None:
    points = np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    for seed in range(20):
        moved = misplaced(points, np.random.default_rng(seed))
        # The vertical axis moves by tilt alone: 1 degree about x and y and 2 cm along each axis.
        assert np.linalg.norm(moved[1] - points[1]) < 5 * np.radians(1.0) * np.sqrt(2) + 0.02 * np.sqrt(3)
        assert np.linalg.norm(moved[0] - points[0]) < 0.35


def test_photographs_change_the_surfaces_and_nothing_else(world: World, tmp_path: Path) -> None:
    wheel, rng = tmp_path / "robosuite.whl", np.random.default_rng(0)
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in ("brick", "clay", "cereal"):
            png = cv2.imencode(".png", rng.integers(0, 256, (1024, 512, 3), np.uint8))[1].tobytes()
            archive.writestr(f"robosuite/models/assets/textures/{name}.png", png)
    assert unpack(wheel, tmp_path / "t") == 2  # cereal is a box's print
    assert sorted(path.name for path in (tmp_path / "t").iterdir()) == ["brick.jpg", "clay.jpg"]
    assert cv2.imread(str(tmp_path / "t" / "clay.jpg")).shape == (512, 256, 3)
    changed = with_photographs(world, str(tmp_path / "t"), np.random.default_rng(3))
    own = len(world.textures.levels)
    exchanged = changed.texture >= own
    assert 0.3 < exchanged.mean() < 1 and changed.texture.max() < own + 2
    assert changed.faces is world.faces and changed.light is world.light and changed.uv is world.uv
    np.testing.assert_array_equal(changed.texture[~exchanged], world.texture[~exchanged])
    np.testing.assert_allclose(changed.tint[~exchanged], world.tint[~exchanged], rtol=1e-6)
    assert not world.textures.clamp[world.texture[exchanged]].any()  # a door keeps its texture
    pose = pose_matrix(*world.spawn[:2], 1.2)
    before, after = (EquirectRenderer(one).render(pose, 128, 64) for one in (world, changed))
    np.testing.assert_array_equal(before.depth_m, after.depth_m)
    assert (before.rgb != after.rgb).any()


def test_what_is_no_wheel_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.whl").write_bytes(b"no zip")
    with zipfile.ZipFile(tmp_path / "b.whl", "w") as archive:
        archive.writestr("other/a.png", b"")
    for name, text in (("a.whl", "not a wheel"), ("b.whl", "no textures"), ("c.whl", "not a wheel")):
        with pytest.raises(DatasetError, match=text):
            unpack(tmp_path / name, tmp_path / "t")
