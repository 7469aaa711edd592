"""Maps on disk, and finding one's place in them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from slam_planar_world import rectangle

from benchmarks.slam_worlds import Drive, Laser, drive
from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam import GridSlam, OccupancyGrid, Scan, SlamConfig, SlamResult, SlamStatus
from instant_ic.slam.localization import bound_nodes
from instant_ic.slam.loop_search import pool
from instant_ic.slam.map_files import (
    MapError,
    graph_file,
    load_graph,
    load_grid,
    occupied_points,
    save_graph,
    save_grid,
)
from instant_ic.slam.start import make_slam

LASER = Laser(240, 360.0, 12.0, 0.01)
# Two rooms and a door; nothing in it looks like anything else.
WALLS = [
    *rectangle(-3.0, -2.0, 9.0, 3.0), (3.0, -2.0, 3.0, 0.0), (3.0, 1.2, 3.0, 3.0), *rectangle(-2.0, 1.5, -1.0, 2.2),
    *rectangle(6.0, -1.5, 6.7, -1.0), (9.0, 1.0, 8.0, 3.0),
]  # fmt: skip
START = np.array([0.0, 0.5, 0.0])


def feed(slam: GridSlam, journey: Drive) -> list[SlamResult]:
    results = []
    for entry in journey.entries:
        results.append(slam.process(entry.scan, entry.odom_pose, entry.base_from_laser))
        job = slam.background_job()
        if job is not None:
            slam.take_over(job())
    return results


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, GridSlam]:
    """A map of the two rooms, its origin at START, and its files."""
    slam = GridSlam()
    feed(slam, drive(WALLS, [(0.0, 0.5), (5.0, 0.5), (7.0, 1.0), (0.0, 0.5)], LASER, 0, step_m=0.15))
    slam.finish()
    stem = tmp_path_factory.mktemp("m") / "deep" / "rooms"
    assert [file.name for file in slam.save(stem)] == ["rooms.yaml", "rooms.pgm", "rooms.graph.npz"]
    return stem, slam


def test_the_files_by_hand(tmp_path: Path) -> None:
    values = np.array([[-1, 0, 25], [26, 64, 65], [100, 50, -1]], dtype=np.int8)
    save_grid(tmp_path / "m", OccupancyGrid(values, 0.05, np.array([-1.5, 2.0])))
    picture = (tmp_path / "m.pgm").read_bytes()
    # The top row of the picture is the last row of the map: 100 → 0, 50 → 205, unknown → 205.
    assert picture == b"P5\n3 3\n255\n" + bytes([0, 205, 205, 205, 205, 0, 205, 254, 254])
    text = (tmp_path / "m.yaml").read_text()
    assert "image: m.pgm\n" in text and "origin: [-1.5, 2, 0]\n" in text and "resolution: 0.05\n" in text
    again = load_grid(tmp_path / "m.yaml")
    assert again.values.tolist() == [[-1, 0, 0], [-1, -1, 100], [100, -1, -1]]
    assert again.resolution == 0.05 and again.origin.tolist() == [-1.5, 2.0]
    # Centre of the cell in row 1, column 2; and of the one in row 2, column 0.
    assert occupied_points(again) == pytest.approx(np.array([[-1.375, 2.075], [-1.475, 2.125]]))


def write_map(folder: Path, pixels: bytes, text: str) -> Path:
    (folder / "p.pgm").write_bytes(b"P5\n%d 1\n255\n" % len(pixels) + pixels)
    path = folder / "p.yaml"
    path.write_text(f"image: p.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n{text}")
    return path


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        # Shares occupied of 0, 50, 100, 205, 254: 1.0, 0.80, 0.61, 0.196, 0.004.
        ("mode: trinary\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n", [100, 100, -1, -1, 0]),
        ("negate: 1\noccupied_thresh: 0.65\nfree_thresh: 0.25\n", [0, 0, -1, 100, 100]),
    ],
)
def test_thresholds_of_map_server(tmp_path: Path, text: str, expected: list[int]) -> None:
    grid = load_grid(write_map(tmp_path, bytes([0, 50, 100, 205, 254]), text))
    assert grid.values.tolist() == [expected]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("- 1\n", "keys image"),
        ("image: p.pgm\nresolution: 0\norigin: [0, 0, 0]\n", "resolution must be > 0"),
        ("image: p.pgm\nresolution: x\norigin: [0, 0, 0]\n", "resolution must be a number"),
        ("image: p.pgm\nresolution: .1\norigin: [0, 0, 0.5]\n", "rotated map"),
        ("image: p.pgm\nresolution: .1\norigin: [0, 0, 0]\nmode: raw\n", "mode must be trinary"),
        ("image: p.pgm\nresolution: .1\norigin: [0, 0, 0]\nfree_thresh: 0.9\n", "free_thresh < occupied_thresh"),
        ("image: none.pgm\nresolution: .1\norigin: [0, 0, 0]\n", "does not exist"),
        ("image: bad.pgm\nresolution: .1\norigin: [0, 0, 0]\n", "cannot be decoded"),
    ],
)
def test_a_bad_map_is_told(tmp_path: Path, text: str, what: str) -> None:
    (tmp_path / "p.pgm").write_bytes(b"P5\n1 1\n255\n\x00")
    (tmp_path / "bad.pgm").write_bytes(b"not a picture")
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(MapError, match=what):
        load_grid(tmp_path / "p")


def test_faults_of_saving_and_loading(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="empty"):
        GridSlam().save(tmp_path / "m")
    with pytest.raises(MapError, match="no pose graph"):
        load_graph(tmp_path / "m")
    graph_file(tmp_path / "m").write_bytes(b"zip?")
    with pytest.raises(MapError, match="damaged"):
        load_graph(tmp_path / "m")
    save_graph(tmp_path / "e", [], [])
    with pytest.raises(MapError, match="no keyframe"):
        load_graph(tmp_path / "e")
    (tmp_path / "file").write_text("")
    with pytest.raises(MapError, match="cannot be written"):
        save_grid(tmp_path / "file" / "m", OccupancyGrid(np.zeros((1, 1), np.int8), 0.1, np.zeros(2)))
    with pytest.raises(ValueError, match="needs a saved map"):
        make_slam(localize=True)


def test_the_graph_comes_back_as_it_was(made: tuple[Path, GridSlam]) -> None:
    stem, slam = made
    keyframes, edges = load_graph(stem)
    kept = [k for k in slam.front_end.trajectory if k.merged_into is None]
    assert len(keyframes) == len(kept) > 20
    for one, two in zip(keyframes, kept, strict=True):
        assert one.stamp_ns == two.stamp_ns
        assert np.array_equal(one.map_from_base, two.map_from_base)
        assert np.allclose(one.scan.points, two.scan.points, atol=1e-6)
        assert np.array_equal(one.scan.joined, two.scan.joined)
    assert len(edges) == len(slam.loop_closure.edges) >= len(keyframes) - 1
    assert np.array_equal(edges[3].covariance, slam.loop_closure.edges[3].covariance)


def elsewhere(seed: int = 5) -> tuple[Drive, list[np.ndarray]]:
    """A drive in the second room, with the true poses in the saved map's frame."""
    way = [(7.0, 2.0), (5.0, 1.0), (4.0, 0.5), (0.0, 0.5)]
    journey = drive(WALLS, way, LASER, seed, step_m=0.15)
    first = np.array([7.0, 2.0, math.atan2(-1.0, -2.0)])
    return journey, [compose2(relative2(START, first), pose) for pose in journey.truth]


@pytest.mark.parametrize("localize", [True, False])
def test_the_place_is_found_without_a_hint(made: tuple[Path, GridSlam], localize: bool) -> None:
    stem, maker = made
    journey, truth = elsewhere()
    slam = make_slam(SlamConfig(), stem.with_suffix(".yaml"), localize)
    assert isinstance(slam, GridSlam)
    results = feed(slam, journey)
    found = [k for k, result in enumerate(results) if result.localized]
    assert found and found[0] < 12 and found == list(range(found[0], len(results)))
    errors = [relative2(truth[k], results[k].map_from_base) for k in found]
    assert max(math.hypot(e[0], e[1]) for e in errors) < 0.06
    assert max(abs(e[2]) for e in errors) < math.radians(1.0)
    # Odometry is untouched, all of it is in map→odom.
    assert np.array_equal(slam.frames.odom_from_base, journey.entries[-1].odom_pose)
    assert compose2(slam.frames.map_from_odom, slam.frames.odom_from_base) == pytest.approx(slam.map_from_base)
    if localize:
        assert np.array_equal(slam.grid().values, load_grid(stem).values)
        assert len(slam.front_end.trajectory) < 12
    else:
        slam.finish()
        before = len(load_graph(stem)[0])
        more = stem.with_name("more")
        slam.save(more)
        keyframes, _ = load_graph(more)
        assert len(keyframes) > before
        # What was there stays where it was.
        assert keyframes[5].map_from_base == pytest.approx(maker.front_end.trajectory[5].map_from_base, abs=0.03)


def test_a_robot_carried_off_is_found_again(made: tuple[Path, GridSlam]) -> None:
    stem, _ = made
    journey, _ = elsewhere()
    slam = make_slam(SlamConfig(), stem, True)
    feed(slam, journey)
    assert slam.localized
    # Lifted, and set down in the other room: odometry says nothing of it.
    other = drive(WALLS, [(-2.0, -1.0), (1.5, -1.0), (1.5, 2.0)], LASER, 6, step_m=0.15)
    held = slam.frames.odom_from_base
    last_ns = journey.entries[-1].scan.stamp_ns
    moved = [
        replace(e, scan=replace(e.scan, stamp_ns=e.scan.stamp_ns + last_ns), odom_pose=compose2(held, e.odom_pose))
        for e in other.entries
    ]
    results = feed(slam, Drive(moved, other.truth))
    statuses = [r.status for r in results]
    assert SlamStatus.LOST in statuses
    assert results[-1].localized
    truth = compose2(relative2(START, np.array([-2.0, -1.0, 0.0])), other.truth[-1])
    error = relative2(truth, results[-1].map_from_base)
    assert math.hypot(error[0], error[1]) < 0.06


def test_a_symmetric_map_gives_no_answer_until_told(tmp_path: Path) -> None:
    walls = rectangle(-2.0, -2.0, 2.0, 2.0)
    maker = GridSlam()
    feed(maker, drive(walls, [(-0.5, 0.0), (0.5, 0.0)], LASER, 0))
    maker.save(tmp_path / "square")
    slam = make_slam(SlamConfig(), tmp_path / "square", True)
    with pytest.raises(ValueError, match="no scan"):
        slam.set_pose([0.0, 0.0, 0.0])
    assert not slam.process(Scan(np.full(9, np.inf), 0.0, 0.1, 0.1, 9.0, 0)).localized  # an empty first scan
    results = feed(slam, drive(walls, [(0.0, -0.5), (0.0, 0.9)], LASER, 1))
    assert not any(result.localized for result in results)  # four headings fit equally well
    assert slam.saved is not None and slam.saved.ambiguous
    # The drive began in map coordinates (0.5, −0.5), looking along +y, and went 1.4 m: told within 0.3 m and 15°.
    slam.set_pose([0.7, 0.7, math.pi / 2 + 0.25])
    last = drive(walls, [(0.0, -0.5), (0.0, 0.9)], LASER, 1).entries[-1]
    scan = replace(last.scan, stamp_ns=last.scan.stamp_ns + 10**8)
    result = slam.process(scan, last.odom_pose)
    assert result.localized
    assert result.map_from_base == pytest.approx([0.5, 0.9, math.pi / 2], abs=0.05)
    with pytest.raises(ValueError, match="not finite"):
        slam.set_pose([math.nan, 0.0, 0.0])
    with pytest.raises(ValueError, match="no saved map"):
        maker.set_pose([0.0, 0.0, 0.0])


def test_a_bound_is_at_least_the_score_of_every_pose_of_its_node() -> None:
    rng = np.random.default_rng(0)
    field = np.where(rng.random((64, 64)) < 0.1, rng.random((64, 64)), 0.0).astype(np.float32)
    points = rng.uniform(-15.0, 15.0, (20, 2))
    nodes = np.array([[r, j, i] for r in range(4) for j in range(0, 16, 3) for i in range(0, 16, 3)], dtype=np.int32)
    sums, counts = unbounded(len(nodes))
    bound_nodes(pool(field, 4), np.zeros(2), 4.0, points, nodes, sums, counts, 0.0, math.pi / 2)
    assert (counts == len(points)).all()
    bounds = sums / len(points)
    for (r, j, i), bound in zip(nodes, bounds, strict=True):
        cos, sin = math.cos(r * math.pi / 2), math.sin(r * math.pi / 2)
        for place in rng.uniform(0.0, 4.0, (10, 2)) + 4.0 * np.array([i, j]):
            cells = np.floor(points @ np.array([[cos, sin], [-sin, cos]]) + place).astype(int)
            inside = ((cells >= 0) & (cells < 64)).all(axis=1)
            assert field[cells[inside, 1], cells[inside, 0]].sum() / len(points) <= bound + 1e-6
    # By hand: one cell of value 1 at (x 7, y 5), reached from the node of (x 4, y 4) by the first of two points.
    one = np.zeros((64, 64), dtype=np.float32)
    one[5, 7] = 1.0
    two = np.array([[2.0, 0.0], [0.0, 30.0]])
    node = np.array([[0, 1, 1]], dtype=np.int32)
    sums, counts = unbounded(1)
    for floor, sum_, count in ((0.6, 1.0, 2), (0.4, 1.0, 2)):
        bound_nodes(pool(one, 4), np.zeros(2), 4.0, two, node, sums, counts, floor, 1.0)
        assert (sums.tolist(), counts.tolist()) == ([sum_], [count])


def unbounded(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sums and counts of nodes of which no bound has been computed."""
    return np.zeros(count, dtype=np.float32), np.zeros(count, dtype=np.int32)


def test_a_lower_floor_continues_the_sums_of_a_higher_one() -> None:
    rng = np.random.default_rng(1)
    field = pool(rng.random((64, 64)).astype(np.float32), 4)
    points = rng.uniform(0.0, 40.0, (30, 2))
    nodes = np.array([[0, j, i] for j in range(16) for i in range(16)], dtype=np.int32)
    sums, counts = unbounded(len(nodes))
    before = counts.copy()
    for floor in (0.95, 0.9, 0.8, 0.0):
        bound_nodes(field, np.zeros(2), 4.0, points, nodes, sums, counts, floor, 1.0)
        assert (counts >= before).all()
        assert ((sums + len(points) - counts < floor * len(points)) == (counts < len(points))).all()
        before = counts.copy()
    at_once, _ = whole = unbounded(len(nodes))
    bound_nodes(field, np.zeros(2), 4.0, points, nodes, *whole, 0.0, 1.0)
    np.testing.assert_array_equal(sums, at_once)


def test_a_place_needs_a_second_scan(made: tuple[Path, GridSlam]) -> None:
    stem, _ = made
    journey, _ = elsewhere()
    slam = make_slam(SlamConfig(), stem, True)
    entry = journey.entries[0]
    states = []
    for index in range(2):  # the robot stands: no second keyframe is needed
        scan = replace(entry.scan, stamp_ns=entry.scan.stamp_ns + index * 5 * 10**8)
        result = slam.process(scan, entry.odom_pose, entry.base_from_laser)
        job = slam.background_job()
        assert job is not None
        slam.take_over(job())
        states.append((result.localized, slam.localized))
    assert states == [(False, False), (False, True)]
