"""Loop closing: true loops are closed, false ones are not, and a known area does not grow."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from slam_planar_world import PlanarWorld, rectangle

from benchmarks.slam_worlds import Drive, Laser, cells, drive
from instant_ic.experiments.slam import trajectory_errors
from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam import GridSlam, SlamResult
from instant_ic.slam.likelihood_field import FieldSurface, LikelihoodField
from instant_ic.slam.loop_closure import chained, reversed_edge
from instant_ic.slam.loop_search import find_place, peaks, pool, score_volume, spread
from instant_ic.slam.pose_graph import Edge

COARSE = Laser(180, 360.0, 12.0, 0.015)


def run(journey: Drive, slam: GridSlam | None = None) -> tuple[GridSlam, list[SlamResult]]:
    slam = slam or GridSlam()
    results = []
    for entry in journey.entries:
        results.append(slam.process(entry.scan, entry.odom_pose, entry.base_from_laser))
        job = slam.background_job()
        if job is not None:
            slam.take_over(job())
    slam.finish()
    return slam, results


def loop_errors(slam: GridSlam, journey: Drive) -> np.ndarray:
    """How far each closed loop is from the truth, metres."""
    at = {entry.scan.stamp_ns: k for k, entry in enumerate(journey.entries)}
    true = [journey.truth[at[k.stamp_ns]] for k in slam.front_end.trajectory]
    rest = [
        relative2(relative2(true[edge.a], true[edge.b]), edge.a_from_b)
        for edge in slam.loop_closure.edges
        if edge.robust
    ]
    return np.array([math.hypot(r[0], r[1]) for r in rest])


def ring_world() -> tuple[list[tuple[float, float, float, float]], list[tuple[float, float]]]:
    """A ring of corridors, 14 m × 10 m along the middle, with pillars; once round and a little farther."""
    walls = rectangle(-1.0, -1.0, 15.0, 11.0) + rectangle(1.0, 1.0, 13.0, 9.0)
    for x, y in ((3.2, -0.9), (7.5, -0.8), (11.0, 0.7), (14.6, 4.0), (13.1, 7.0), (9.0, 10.6), (4.0, 9.1), (-0.8, 6.0)):
        walls += rectangle(x, y, x + 0.3, y + 0.3)
    return walls, [(0.0, 0.0), (14.0, 0.0), (14.0, 10.0), (0.0, 10.0), (0.0, 0.0), (7.0, 0.0)]


@pytest.fixture(scope="module")
def ring() -> tuple[Drive, GridSlam, list[SlamResult]]:
    walls, way = ring_world()
    journey = drive(walls, way, COARSE, 1, step_m=0.15, step_rad=0.15)
    return journey, *run(journey)


def test_a_loop_is_closed(ring: tuple[Drive, GridSlam, list[SlamResult]]) -> None:
    journey, slam, results = ring
    assert slam.loop_closure.closed > 5
    assert loop_errors(slam, journey).max() < 0.15
    online = np.array([r.map_from_base for r in results])
    metres, degrees = trajectory_errors(online, journey.truth)
    assert metres[-1] < 0.1 and degrees[-1] < 1.0
    wheels, _ = trajectory_errors(np.array([e.odom_pose for e in journey.entries]), journey.truth)
    assert wheels[-1] > 0.5  # what there was to correct
    assert np.array_equal(slam.frames.odom_from_base, journey.entries[-1].odom_pose)  # odometry stays what it was


def test_drift_grows_and_ends_with_the_loop(ring: tuple[Drive, GridSlam, list[SlamResult]]) -> None:
    _, _, results = ring
    sigma = np.array([math.sqrt(np.trace(r.covariance[:2, :2])) for r in results])
    assert np.argmax(sigma) > len(sigma) / 2
    assert sigma[-1] < 0.5 * sigma.max()
    assert all(np.linalg.eigvalsh(r.covariance).min() > -1e-12 for r in results)


def test_the_same_scans_give_the_same_map(ring: tuple[Drive, GridSlam, list[SlamResult]]) -> None:
    journey, slam, _ = ring
    again, _ = run(journey)
    one, other = (np.array([k.map_from_base for k in made.front_end.trajectory]) for made in (again, slam))
    assert one.tobytes() == other.tobytes()
    assert again.grid().values.tobytes() == slam.grid().values.tobytes()


def test_rooms_that_look_alike_are_not_taken_for_each_other() -> None:
    walls, way = cells(rooms=3)
    journey = drive(walls, way, COARSE, 2, step_m=0.15, step_rad=0.15)
    slam, results = run(journey)
    assert loop_errors(slam, journey).max(initial=0.0) < 0.3
    metres, _ = trajectory_errors(np.array([r.map_from_base for r in results]), journey.truth)
    assert metres.max() < 0.3  # the rooms repeat each 4 m


def test_a_bare_corridor_closes_no_false_loop() -> None:
    # To and fro between bare walls that end out of sight: nothing tells how far along the robot is.
    walls = [(-60.0, -1.0, 60.0, -1.0), (-60.0, 1.0, 60.0, 1.0)]
    journey = drive(walls, [(0.0, 0.0), (18.0, 0.0), (0.0, 0.0)], COARSE, 3, step_m=0.25)
    slam, _ = run(journey)
    assert len(slam.front_end.trajectory) > 60
    assert slam.loop_closure.closed == 0


def test_staying_in_one_room_does_not_add_keyframes_for_ever() -> None:
    walls = [*rectangle(-3, -3, 3, 3), *rectangle(2.0, 1.5, 2.6, 2.2)]
    square = [(-1.5, -1.5), (1.2, -1.5), (1.2, 1.2), (-1.5, 1.2)]
    journey = drive(walls, [*(square * 6), square[0]], COARSE, 4, step_m=0.25, step_rad=0.3)
    slam, results, counts = GridSlam(), [], []
    half = len(journey.entries) // 2  # three of the six rounds
    for part in (journey.entries[:half], journey.entries[half:]):
        results += run(replace(journey, entries=part), slam)[1]
        counts.append(int(slam.figures()["keyframes"]))
    assert np.isfinite(np.array([r.anchor.pose() for r in results])).all()
    metres, _ = trajectory_errors(np.array([r.map_from_base for r in results]), journey.truth)
    assert metres.max() < 0.1
    added = counts[1] - counts[0]
    assert added < 0.5 * counts[0]


def field_of(walls: PlanarWorld, poses: list[tuple[float, float, float]]) -> LikelihoodField:
    field = LikelihoodField(0.05, 16.0)
    angles = -math.pi + 2 * math.pi / 360 * np.arange(360)
    surfaces = []
    for pose in poses:
        ranges = walls.ranges(np.array(pose), angles)
        near = ranges < 12
        points = ranges[near, None] * np.column_stack([np.cos(angles), np.sin(angles)])[near]
        joined = np.zeros(len(points), dtype=bool)
        joined[1:] = np.hypot(*np.diff(points, axis=0).T) < 2.0  # else the far walls would be dotted lines
        surfaces.append(FieldSurface(np.array(pose), points, joined))
    field.rebuild(np.zeros(3), surfaces)
    return field


def seen_from(walls: PlanarWorld, pose: tuple[float, float, float]) -> np.ndarray:
    angles = -math.pi + 2 * math.pi / 360 * np.arange(360)
    ranges = walls.ranges(np.array(pose), angles)
    near = ranges < 12
    return spread(ranges[near, None] * np.column_stack([np.cos(angles), np.sin(angles)])[near], 0.1, 250)


def test_the_search_finds_what_is_metres_away() -> None:
    world = PlanarWorld(rectangle(-2, -1.5, 4, 2.5) + rectangle(1.5, 1.0, 2.0, 1.4))
    found = find_place(
        field_of(world, [(0, 0, 0), (2, 0, 0.5)]), seen_from(world, (1.7, -0.4, 0.6)), np.zeros(3), 3.0, 0.8
    )
    assert found is not None
    assert found.pose == pytest.approx([1.7, -0.4, 0.6], abs=0.03)
    assert found.score > 0.8 and found.shape > 0.2 and found.runner_up < 0.8 * found.score
    assert np.linalg.eigvalsh(found.covariance).min() > 0


def test_a_corridor_has_no_shape_and_a_symmetric_room_two_answers() -> None:
    corridor = PlanarWorld([(-40, -1, 40, -1), (-40, 1, 40, 1)])
    found = find_place(
        field_of(corridor, [(0, 0, 0), (1, 0, 0)]), seen_from(corridor, (2, 0, 0)), np.zeros(3), 2.0, 0.3
    )
    assert found is not None and found.shape < 0.05
    square = PlanarWorld(rectangle(-2, -2, 2, 2))
    found = find_place(field_of(square, [(0, 0, 0)]), seen_from(square, (0.5, 0, 0)), np.zeros(3), 1.0, 1.7)
    assert found is not None and found.runner_up > 0.95 * found.score  # 90° on, at (0, 0.5), it looks the same


def test_pooled_cells_hold_the_best_near_them() -> None:
    field = np.zeros((12, 12), dtype=np.float32)
    field[5, 9] = 0.7
    pooled = pool(field, 4)
    # Cell (5, 9) lies within 4 cells of the pooled cells 1 and 2 along y (4, 8) and 2 along x (8); x 3 is outside.
    assert [(int(j), int(i)) for j, i in np.argwhere(pooled > 0)] == [(1, 2), (2, 2)]


def test_score_volume_and_peaks_by_hand() -> None:
    field = np.zeros((9, 9), dtype=np.float32)
    field[4, 6], field[2, 2] = 1.0, 0.5
    volume = score_volume(field, np.zeros(2), 1.0, np.zeros((1, 2)), np.array([4.0, 4.0, 0.0]), 3, 1, 0.1)
    assert volume.shape == (3, 7, 7)
    assert volume[1, 3, 5] == 1.0 and volume[1, 1, 1] == 0.5 and volume.sum() == pytest.approx(3 * 1.5)
    best = peaks(volume, 4, 1, 2)
    assert {tuple(int(v) for v in row[1:]) for row in best} == {(3, 5), (1, 1)}


def test_edges_are_turned_and_chained_right() -> None:
    rng = np.random.default_rng(0)
    covariance = np.diag([0.01, 0.02, 0.03]) ** 2
    ab, bc = np.array([1.0, 0.5, 0.7]), np.array([-0.3, 2.0, -1.2])
    first, second = Edge(1, 2, ab, covariance), Edge(2, 3, bc, covariance)
    # Oracle: 40000 draws of noise on both edges.
    noise = rng.multivariate_normal(np.zeros(3), covariance, (40_000, 2))
    draws = np.array([compose2(ab + one, bc + two) for one, two in noise])
    both = chained(first, second)
    assert (both.a, both.b) == (1, 3)
    assert both.a_from_b == pytest.approx(compose2(ab, bc))
    assert np.abs(np.cov(draws.T) - both.covariance).max() < 0.05 * np.abs(both.covariance).max()
    back = np.array([relative2(ab + one, np.zeros(3)) for one in noise[:, 0]])
    turned = reversed_edge(first)
    assert turned.a_from_b == pytest.approx(relative2(ab, np.zeros(3)))
    assert np.abs(np.cov(back.T) - turned.covariance).max() < 0.05 * np.abs(turned.covariance).max()
