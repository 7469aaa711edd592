"""``ic evaluate follow``: its own world by hand (LiDAR, shortest way), and one drive from end to end."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from instant_ic.cli.main import main
from instant_ic.experiments import follow
from instant_ic.experiments import follow_worlds as worlds
from instant_ic.experiments.follow_worlds import Room


def room(*shapes: tuple[float, ...]) -> Room:
    size = np.array([10.0, 8.0])
    every, start, goal = np.array(shapes, float).reshape(-1, 7), np.array([2.0, 4.0, 0.0]), np.array([8.0, 4.0])
    kinds = np.ones(len(shapes), int)
    return Room(size, every, kinds, start, goal, np.zeros((2, 2)), worlds.made(every, size))


class Quiet:
    """A source of noise that makes none."""

    @staticmethod
    def normal(mean: float, sigma: float, shape: tuple[int, ...]) -> np.ndarray:
        return np.zeros(shape)


def ahead(points: np.ndarray) -> np.ndarray:
    """Points within 1° of straight ahead, by height."""
    near = points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < math.radians(0.15)]
    return near[np.argsort(near[:, 2])]


class TestLidar:
    def test_each_ring_meets_what_is_at_its_height(self) -> None:
        # A box 0.5 m high whose front is 3 m ahead; a wall behind it at 6 m, 2.5 m high.
        seen = ahead(
            worlds.look(
                room((5.5, 4.0, 0.5, 1.0, 0.0, 0.0, 0.5), (8.05, 4.0, 0.05, 3.0, 0.0, 0.0, 2.5)).world,
                np.array([2.0, 4.0, 0.0]),
                Quiet(),
            )
        )  # type: ignore[arg-type]
        rings = np.degrees(np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1])))
        reach = dict(zip(np.round(rings[::2]).astype(int), np.hypot(seen[::2, 0], seen[::2, 1]), strict=True))
        assert reach[-15] == pytest.approx(0.6 / math.tan(math.radians(15)), abs=1e-3)  # the ground
        assert reach[-11] == pytest.approx(3.0, abs=1e-3)  # 0.6 - 3 tan 11° = 0.017: just its foot
        assert reach[-3] == pytest.approx(3.0, abs=1e-3)  # 0.44 m high
        assert reach[-1] == pytest.approx(6.0, abs=1e-3)  # over it
        assert reach[15] == pytest.approx(6.0, abs=1e-3)  # 2.2 m: the wall still
        top = ahead(worlds.look(room((5.5, 4.0, 0.5, 1.0, 0.0, 0.0, 0.4)).world, np.array([2.0, 4.0, 0.0]), Quiet()))  # type: ignore[arg-type]
        assert np.isclose(top[:, 0], 0.2 / math.tan(math.radians(3)), atol=1e-3).any()  # its top, 3.8 m off

    def test_a_hanging_bar_is_in_the_way_and_seen_from_afar_only(self) -> None:
        bar = (5.5, 4.0, 0.05, 1.0, 0.0, 0.9, 2.0)  # 0.3 m above the LiDAR: beams of 15° miss it within 1.1 m
        assert room(bar).world.occupied(*worlds.IN_THE_WAY_M, 0.05).cells.any()
        for x, seen in ((2.0, True), (4.8, False)):
            points = ahead(worlds.look(room(bar).world, np.array([x, 4.0, 0.0]), Quiet()))  # type: ignore[arg-type]
            assert (points[:, 2] > -worlds.LIDAR_HEIGHT_M + 0.01).any() == seen


class TestShortestWay:
    @staticmethod
    def way(*shapes: tuple[float, ...], margin: float = 0.0) -> np.ndarray | None:
        mask = room(*shapes).world.occupied(*worlds.IN_THE_WAY_M, 0.025)
        return worlds.shortest_way(mask, np.array([2.0, 4.0, 0.0]), np.array([8.0, 4.0, 0.0]), margin)

    def test_through_a_door_that_the_body_fits_and_no_other(self) -> None:
        def wall(door: float) -> list[tuple[float, ...]]:
            reach = (4.0 - door / 2) / 2
            return [(5.0, reach, 0.05, reach, 0.0, 0.0, 2.5), (5.0, 8 - reach, 0.05, reach, 0.0, 0.0, 2.5)]

        outer = [(5.0, -0.2, 6.0, 0.2, 0.0, 0.0, 2.5), (5.0, 8.2, 6.0, 0.2, 0.0, 0.0, 2.5)]
        assert self.way(*wall(0.60), *outer) is not None
        assert self.way(*wall(0.60), *outer, margin=0.08) is None
        assert self.way(*wall(0.44), *outer) is None

    def test_round_a_box_by_as_much_as_the_body_needs(self) -> None:
        way = self.way((5.0, 4.0, 0.5, 1.0, 0.0, 0.0, 1.0))
        assert way is not None
        # To (4.5 - 0.25, 5.25), past it, and back: 2·hypot(2.25, 1.25) + 1.5 = 6.65; steps of 22.5° add 2 % at most.
        length = float(np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1).sum())
        assert 6.45 < length < 1.04 * 6.65


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[dict, Path]]:
    out = tmp_path_factory.mktemp("r")
    words = [
        "--episodes",
        "1",
        "--seed",
        "3",
        "--jobs",
        "1",
        "--json",
        str(out / "f.json"),
        "--plot",
        str(out / "f.png"),
    ]
    assert main(["evaluate", "follow", *words]) == 0
    yield json.loads((out / "f.json").read_text()), out


def test_a_drive_reaches_its_goal_without_contact_and_is_told_in_full(drive: tuple[dict, Path]) -> None:
    figures, out = drive
    assert figures["reached"] == figures["reachable"] == 1
    assert figures["contacts"] == 0
    assert figures["path_ratio_mean"] < 1.3
    (each,) = figures["each"]
    assert each["reached"]
    assert each["driven_m"] > 0.9 * each["optimum_m"] > 4.0
    for name in ("planner", "controller", "costmap"):
        assert 0 < figures[f"{name}_ms_p50"] <= figures[f"{name}_ms_p99"]
    assert set(figures["targets"]) >= {"contacts == 0", "reached_share >= 0.97", "path_ratio_mean <= 1.2"}
    assert (out / "f.png").read_bytes()[:4] == b"\x89PNG"


def test_figures_of_episodes_by_hand() -> None:
    good = follow.Episode(0, True, True, 20.0, 8.0, 8.8, clearance_m=0.2, planner_ms=[2.0, 4.0])
    long = follow.Episode(1, True, True, 30.0, 5.0, 6.0, clearance_m=0.1)
    lost = follow.Episode(2, True, False, 60.0, 5.0, 3.2, contacts=1, clearance_m=0.0, reason="no way")
    none = follow.Episode(3, False, False, 40.0, math.inf, 2.0, clearance_m=0.3)
    figures = follow.summary([good, long, lost, none])
    assert (figures["reachable"], figures["reached"], figures["contacts"]) == (3, 2, 1)
    assert figures["path_ratio_mean"] == pytest.approx((1.1 + 1.2) / 2)
    assert figures["time_ratio_max"] == pytest.approx(30.0 * 0.4 / 5.0)
    assert figures["planner_ms_p50"] == 3.0
    assert not figures["targets"]["contacts == 0"]
    assert not figures["targets"]["reached_share >= 0.97"]
    assert figures["targets"]["path_ratio_mean <= 1.2"]
    rows = follow.report([good, long, lost, none], 0)["each"]
    assert rows[3]["optimum_m"] is None and rows[2]["path_ratio"] is None  # JSON knows no infinity
    json.dumps(rows, allow_nan=False)
