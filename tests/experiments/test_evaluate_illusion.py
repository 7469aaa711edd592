"""``ic evaluate illusion``: the truth against a world built without its box, figures by hand, a short film."""

from __future__ import annotations

import contextlib
import copy
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.cli.main import main
from instant_ic.experiments import illusion, teleop, teleop_worlds
from instant_ic.experiments.illusion import save_strip
from instant_ic.experiments.illusion_stack import LIVE, SOURCES, TRUE_DEPTH, FilmedStack, IllusionFrame, Passage, Score
from instant_ic.experiments.results import save_json
from instant_ic.experiments.teleop_stack import SimulatedStack, StackConfig
from instant_ic.experiments.worlds import Obstacle, without
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.building import Building, Zone
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import Material
from instant_ic.sim.worlds import corridor_world

BOX = Obstacle(4.25, 0.0, 0.5, 0.5, 0.0, 0.8)
RIGHT_ANGLE = math.pi / 2


@pytest.fixture(scope="module")
def corridor() -> teleop_worlds.Course:
    """The simulator's corridor; the face of its box is 4 m ahead of the origin."""
    return teleop_worlds.make_course("corridor", 0, 0)


# -- the truth


def test_distance_behind_the_near_face_by_hand() -> None:
    """From x = 3 the box's face is 1 m ahead, that of the next box 3 m; a third one stands 2 m aside."""
    boxes = [Obstacle(6.25, 0.2, 0.5, 0.5, 0.0, 0.8), BOX, Obstacle(4.0, 2.0, 0.5, 0.5, 0.0, 0.8)]
    passage = Passage.of(np.array([3.0, 0.0, 0.0]), boxes)
    assert [near for near, _ in passage.obstacles] == pytest.approx([1.0, 3.0])
    assert passage.obstacle_at(np.array([3.2, 0.0])) == (pytest.approx(-0.8), BOX)
    assert passage.obstacle_at(np.array([5.5, 0.3])) == (pytest.approx(1.5), BOX)
    assert passage.obstacle_at(np.array([6.5, 0.0])) == (pytest.approx(0.5), boxes[0])
    assert Passage.of(np.array([3.0, 0.0, math.pi]), boxes).obstacle_at(np.zeros(2)) is None
    turned = Obstacle(0.0, 0.0, 2.0, 1.0, math.pi / 2, 1.0).corners()
    assert turned[0] == pytest.approx([-0.5, 1.0])


def test_the_world_without_its_box_is_the_one_built_without_it(corridor: teleop_worlds.Course) -> None:
    """Depth and colours from inside and behind the box, and the depth from before it."""
    (box,) = corridor.obstacles
    assert (box.x, box.y, box.length) == pytest.approx((4.25, 0.0, 0.5), abs=0.06)
    removed = EquirectRenderer(without(corridor.world, box))
    free, full = EquirectRenderer(corridor_world(obstacle=False)), EquirectRenderer(corridor.world)
    for x in (3.4, 4.2, 5.5):
        pose = pose_matrix(x, 0.0, 1.2)
        ours, theirs = (one.render_perspective(pose, 160, 90, RIGHT_ANGLE) for one in (removed, free))
        assert np.abs(ours.depth_m - theirs.depth_m).max() < 0.01
        assert psnr_db(ours.rgb, theirs.rgb) > 30
    pose = pose_matrix(3.0, 0.0, 1.2)
    assert np.abs(removed.render(pose, 128, 64).depth_m - full.render(pose, 128, 64).depth_m).max() > 0.3


def test_a_poster_over_the_removed_box_stays() -> None:
    """A box of 0.6 m at the wall, a poster over it, a skirting board behind it: the box's front, sides and top go."""
    building = Building()
    room = building.add(Zone(-1.0, -1.2, 5.0, 1.2, 2.6))
    building.picture(room, "north", 3.0, 1.4, (0.5, 0.7), Material("poster:1"))
    building.builder.box((2.0, 0.85), (0.6, 0.6, 0.7))
    world = building.world("room", (0.0, 0.0, 0.0), light_cell_m=1.0, rays=1)
    gone = without(world, Obstacle(2.0, 0.85, 0.6, 0.6, 0.0, 0.7))
    moved = (gone.vertices != world.vertices).any(axis=1).reshape(len(world.normal), -1).all(axis=1)
    was = world.vertices.reshape(len(world.normal), -1, 3)[moved]
    assert moved.sum() == 4 and was[..., 2].max() == pytest.approx(0.7) and was[..., 0].min() == pytest.approx(1.7)
    assert gone.vertices[:, 2].min() < -900


# -- figures


def frame(distance_m: float | None, db: float, expected: float = 25.0) -> IllusionFrame:
    scores = dict.fromkeys(SOURCES, Score(db, 0.5))
    return IllusionFrame(0, 1.0, distance_m, False, scores, dict.fromkeys(SOURCES, 0.1), expected)


def test_figures_by_hand() -> None:
    frames = [frame(0.1, 20.0), frame(0.2, 24.0), frame(0.4, 28.0), frame(None, 24.0)]
    whole = illusion.figures(frames, LIVE)
    assert whole["psnr_mean_db"] == 24.0 and whole["frames"] == 4
    assert whole["psnr_p05_db"] == pytest.approx(20.6)  # 0.15 of the way from the first to the second of four
    rows = illusion.by_distance(frames, TRUE_DEPTH)
    assert [(row["distance_m"], row["frames"], row["psnr_mean_db"]) for row in rows] == [(0.0, 2, 22.0), (0.5, 1, 28.0)]
    figures = illusion.report([illusion.Film(0, True, [frame(None, 24.0)])], illusion.TeleopSettings(methods=("ic",)))
    assert figures["by_distance"] == [] and figures["frames_without_obstacle"] == 1
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    with pytest.raises(ValueError, match="virtual space was not shown"):
        illusion.report([illusion.Film(0)], illusion.TeleopSettings())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--episodes", "0"], "episodes must be at least 1"),
        (["--world", "nowhere"], "neither corridor"),
        (["--jobs", "0"], "jobs must be at least 1"),
        (["--plot", "strip.jpg"], "must end in .png"),
        (["--plot", "/no/such/folder/plot.png"], "does not exist"),
        (["--timeout", "0"], "--timeout must be > 0"),
        (["-p", "no_node.key:=1"], "expected NODE.KEY:=VALUE"),
    ],
)
def test_wrong_arguments_are_reported(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "illusion", "--episodes", "1", *words]) in (1, 2)
    assert message in " ".join(capsys.readouterr().err.split())


# -- a short film


class SmallFilm(FilmedStack):
    """A page of few pixels, which costs less."""

    size = (160, 90)


def film(corridor: teleop_worlds.Course) -> illusion.Film:
    """From 1.6 m before the box's face into it, with depth from the LiDAR alone."""
    world = copy.copy(corridor.world)
    world.spawn = (2.4, 0.0, 0.0)
    course = teleop_worlds.Course(world, np.array([[4.6, 0.0]]), corridor.obstacles)
    small = ("theta_camera.theta.width:=640", "theta_camera.theta.height:=320")
    settings = illusion.TeleopSettings(1, 0, "corridor", ("ic",), "lidar", pictures=False, overrides=small)
    result = illusion.Film(0)

    def make_stack(world: teleop_worlds.World, config: StackConfig) -> FilmedStack:
        return SmallFilm(world, config, course, 0, result.take)

    def at_most_8_s(stack: SimulatedStack) -> None:
        if stack.time_s > 8.0:
            raise TimeoutError

    with contextlib.suppress(TimeoutError):
        teleop.run_episode(settings, 0, at_most_8_s, ("ic",), make_stack, course)
    return result


def test_a_short_film(corridor: teleop_worlds.Course, tmp_path: Path) -> None:
    first = film(corridor)
    settings = illusion.TeleopSettings(1, 0, "corridor", ("ic",), "lidar")
    figures = illusion.report([first], settings)
    assert figures["frames"] >= 8 and figures["frames_without_obstacle"] == 0
    rows = [row["distance_m"] for row in figures["by_distance"]]
    assert rows[0] < 0 <= rows[-1]
    assert figures["with_true_depth"]["psnr_mean_db"] > figures["psnr_mean_db"] > 12
    assert 0 < figures["unseen_share_mean"] < 0.5
    assert all(each["with_obstacle"] == (each["distance_m"] < 0) for each in figures["each"])
    save_json(tmp_path / "film.json", figures)
    assert json.loads((tmp_path / "film.json").read_text()) == figures
    save_strip(tmp_path / "strip.png", [first])
    strip = cv2.imread(str(tmp_path / "strip.png"))
    assert strip.shape == (24 + 225 * len(rows), 64 + 3 * 400, 3) and strip.std() > 20
    with pytest.raises(ValueError, match="no obstacle was passed"):
        save_strip(tmp_path / "strip.png", [illusion.Film(0)])
