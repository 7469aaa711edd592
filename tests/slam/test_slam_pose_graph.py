"""The pose graph: known answers, wrong loops, faults."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam.pose_graph import Edge, optimise, residuals

STEP = np.diag([0.01**2, 0.01**2, 0.005**2])
LOOP = np.diag([0.01**2, 0.01**2, 0.005**2])


def index(count: int) -> dict[int, int]:
    return {k: k for k in range(count)}


def test_residual_by_hand() -> None:
    # a at (1, 2) looking along +y; b 3 m ahead of it, turned by another 90°. Measured: 2.5 m ahead, 0.5 m left, 80°.
    poses = np.array([[1.0, 2.0, math.pi / 2], [1.0, 5.0, math.pi]])
    measured = np.array([[2.5, 0.5, math.radians(80)]])
    error = residuals(poses, np.array([0]), np.array([1]), measured)
    assert error[0] == pytest.approx([0.5, -0.5, math.radians(10)])


def test_a_contradiction_is_shared_by_equal_edges() -> None:
    # Three edges along x say 1 m each, the loop says 3.4 m: four equal springs, each takes a quarter of the 0.4 m.
    poses = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]])
    edges = [Edge(k, k + 1, np.array([1.0, 0, 0]), STEP) for k in range(3)]
    edges.append(Edge(0, 3, np.array([3.4, 0, 0]), STEP))
    solution = optimise(poses, edges, index(4))
    assert solution.poses[:, 0] == pytest.approx([0.0, 1.1, 2.2, 3.3], abs=1e-6)
    assert np.allclose(solution.poses[:, 1:], 0, atol=1e-9)


def circle(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, list[Edge]]:
    """True poses twice round a circle, drifting ones, and the edges between them."""
    rng = np.random.default_rng(seed)
    step = np.array([0.3, 0.0, 4 * math.pi / count])
    true, drifting, edges = [np.zeros(3)], [np.zeros(3)], []
    for k in range(count - 1):
        true.append(compose2(true[-1], step))
        measured = step + rng.standard_normal(3) * [0.01, 0.01, 0.005]
        drifting.append(compose2(drifting[-1], measured))
        edges.append(Edge(k, k + 1, measured, STEP))
    return np.array(true), np.array(drifting), edges


def test_loops_undo_the_drift_and_a_wrong_one_is_switched_off() -> None:
    true, drifting, edges = circle(200, 3)
    for k in range(100, 200, 5):
        edges.append(Edge(k - 100, k, relative2(true[k - 100], true[k]), LOOP, robust=True))
    edges.append(Edge(10, 60, np.zeros(3), LOOP, robust=True))
    solution = optimise(drifting, edges, index(200))
    before = np.hypot(*(drifting - true)[100:, :2].T).mean()
    after = np.hypot(*(solution.poses - true)[:, :2].T)
    assert before > 0.2
    # 100 steps of 0.005 rad and 0.01 m, then tied back: what remains is the drift half-way round.
    assert after.max() < 0.6 * before and after.mean() < 0.4 * before
    assert after[0] == 0.0
    assert solution.weights[-1] < 0.01 and (solution.weights[:-1] > 0.5).all()


def test_a_large_true_loop_is_not_switched_off() -> None:
    # Drift of metres: at first the loop's χ² is far beyond the robust kernel.
    true, _, edges = circle(200, 3)
    bent = [Edge(e.a, e.b, e.a_from_b + [0, 0, 0.004], np.diag([0.02**2, 0.02**2, 0.02**2])) for e in edges]
    poses = [np.zeros(3)]
    for edge in bent:
        poses.append(compose2(poses[-1], edge.a_from_b))
    loops = [Edge(k - 100, k, relative2(true[k - 100], true[k]), LOOP, robust=True) for k in range(100, 200, 5)]
    assert np.hypot(*(np.array(poses) - true)[199, :2]) > 1.0
    solution = optimise(np.array(poses), bent + loops, index(200))
    assert (solution.weights > 0.5).all()
    rest = relative2(solution.poses[0], solution.poses[100])
    assert math.hypot(rest[0], rest[1]) < 0.15
