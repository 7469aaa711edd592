"""Pose graph in the plane: Levenberg-Marquardt on sparse normal equations, robust against wrong edges.

Residual of an edge from node a to node b with measured pose z of b in a's frame: ``(Raᵀ(tb − ta) − tz, θb − θa − θz)``
(Grisetti et al., A tutorial on graph-based SLAM, 2010). Edges that may be wrong are scaled down by dynamic covariance
scaling (Agarwal et al., ICRA 2013). The kernel width is narrowed in stages, so that a correct edge across a large error
is not switched off before it can take effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.slam.scan import FloatArray

ROBUST_WIDTHS = (25e4, 25e2, 25.0)
"""Width of the robust kernel per stage: the χ² up to which an edge keeps its full weight."""
ITERATIONS = 10
"""Maximum number of iterations per stage."""


@dataclass(frozen=True)
class Edge:
    """A measured pose between two nodes.

    Attributes:
        a: id of the node in whose frame the pose is given.
        b: id of the other node.
        a_from_b: measured pose, (3,).
        covariance: covariance of the pose in a's frame, (3, 3).
        robust: true for an edge that may be wrong (loop closure), false for a step of the trajectory.
    """

    a: int
    b: int
    a_from_b: FloatArray
    covariance: FloatArray
    robust: bool = False


@dataclass(frozen=True)
class Solution:
    """An optimised graph.

    Attributes:
        poses: optimised poses, (n, 3).
        weights: weight of each edge from the robust kernel, (m,), 0..1; 1 for edges that are not robust.
    """

    poses: FloatArray
    weights: FloatArray


def residuals(poses: FloatArray, a: NDArray[np.intp], b: NDArray[np.intp], measured: FloatArray) -> FloatArray:
    """Return the residuals (m, 3) of edges between ``poses[a]`` and ``poses[b]`` with ``measured`` poses (m, 3)."""
    cos, sin = np.cos(poses[a, 2]), np.sin(poses[a, 2])
    dx, dy = (poses[b, :2] - poses[a, :2]).T
    turn = poses[b, 2] - poses[a, 2] - measured[:, 2]
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    return np.column_stack([cos * dx + sin * dy - measured[:, 0], -sin * dx + cos * dy - measured[:, 1], turn])


def optimise(poses: FloatArray, edges: Sequence[Edge], index: dict[int, int]) -> Solution:
    """Optimise the poses over all edges. The first node stays fixed.

    Args:
        poses: initial poses, (n, 3).
        edges: edges between the nodes.
        index: row in ``poses`` of each node, by its id.

    Raises:
        ValueError: an edge refers to an unknown node, or part of the graph is not connected to the first node.
    """
    try:
        a = np.array([index[edge.a] for edge in edges], dtype=np.intp)
        b = np.array([index[edge.b] for edge in edges], dtype=np.intp)
    except KeyError as missing:
        raise ValueError(f"an edge refers to node {missing}, which is not in the graph") from None
    poses = poses.copy()
    if len(edges) == 0 or len(poses) < 2:
        return Solution(poses, np.ones(len(edges)))
    measured = np.array([edge.a_from_b for edge in edges])
    information = np.linalg.inv(np.array([edge.covariance for edge in edges]))
    robust = np.array([edge.robust for edge in edges])
    stages = ROBUST_WIDTHS if robust.any() else (math.inf,)
    for width in stages:
        damping = 1e-6
        error = residuals(poses, a, b, measured)
        chi2 = np.einsum("mi,mij,mj->m", error, information, error)
        cost = _robust_cost(chi2, robust, width)
        for _ in range(ITERATIONS):
            step = _step(poses, a, b, error, information * _weights(chi2, robust, width)[:, None, None] ** 2, damping)
            if not np.isfinite(step).all():
                raise ValueError("the graph is not connected: no path from some nodes to the first one")
            trial = poses + step
            trial_error = residuals(trial, a, b, measured)
            trial_chi2 = np.einsum("mi,mij,mj->m", trial_error, information, trial_error)
            trial_cost = _robust_cost(trial_chi2, robust, width)
            if trial_cost > cost * (1 + 1e-9) + 1e-12:
                damping = max(10 * damping, 1e-4)
                if damping > 1e6:
                    break
                continue
            gain = cost - trial_cost
            poses, error, chi2, cost = trial, trial_error, trial_chi2, trial_cost
            damping *= 0.1
            if gain <= 1e-4 * cost + 1e-9 or np.abs(step).max() < 1e-4:
                break
    poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    return Solution(poses, _weights(chi2, robust, stages[-1]))


def _weights(chi2: FloatArray, robust: NDArray[np.bool_], width: float) -> FloatArray:
    """Return the scales of dynamic covariance scaling: s = min(1, 2Φ/(Φ + χ²))."""
    if math.isinf(width):
        return np.ones(len(chi2))
    return np.where(robust, np.minimum(1.0, 2 * width / (width + chi2)), 1.0)


def _robust_cost(chi2: FloatArray, robust: NDArray[np.bool_], width: float) -> float:
    """Return the cost that dynamic covariance scaling minimises, the sum of s²χ² + Φ(1 − s)²."""
    scale = _weights(chi2, robust, width)
    missing = 0.0 if math.isinf(width) else width * float(((1 - scale) ** 2).sum())
    return float((scale**2 * chi2).sum()) + missing


def _step(
    poses: FloatArray,
    a: NDArray[np.intp],
    b: NDArray[np.intp],
    error: FloatArray,
    information: FloatArray,
    damping: float,
) -> FloatArray:
    """Return the damped Gauss-Newton step (n, 3); NaN if the system is singular."""
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    n, m = len(poses), len(a)
    cos, sin = np.cos(poses[a, 2]), np.sin(poses[a, 2])
    dx, dy = (poses[b, :2] - poses[a, :2]).T
    by_a, by_b = np.zeros((m, 3, 3)), np.zeros((m, 3, 3))
    by_b[:, 0, 0], by_b[:, 0, 1], by_b[:, 1, 0], by_b[:, 1, 1], by_b[:, 2, 2] = cos, sin, -sin, cos, 1.0
    by_a[:] = -by_b
    by_a[:, 0, 2] = -sin * dx + cos * dy
    by_a[:, 1, 2] = -cos * dx - sin * dy
    rows, columns, values = [], [], []
    gradient = np.zeros(3 * n)
    corner = np.arange(3)
    for i, left in ((a, by_a), (b, by_b)):
        weighted = np.einsum("mji,mjk->mik", left, information)
        np.add.at(gradient, 3 * i[:, None] + corner, np.einsum("mij,mj->mi", weighted, error))
        for j, right in ((a, by_a), (b, by_b)):
            block = np.einsum("mij,mjk->mik", weighted, right)
            rows.append(np.broadcast_to(3 * i[:, None, None] + corner[:, None], (m, 3, 3)).ravel())
            columns.append(np.broadcast_to(3 * j[:, None, None] + corner, (m, 3, 3)).ravel())
            values.append(block.ravel())
    hessian = csc_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(3 * n, 3 * n)
    )[3:, 3:]
    diagonal = hessian.diagonal()
    hessian.setdiag(diagonal * (1 + damping))
    step = np.zeros(3 * n)
    try:
        factor = splu(
            hessian.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        step[3:] = factor.solve(-gradient[3:])
    except RuntimeError:  # "Factor is exactly singular"
        step[:] = np.nan
    return step.reshape(n, 3)
