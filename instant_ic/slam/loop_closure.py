"""Loop closure: search for loops between keyframes and optimisation of their poses, in parallel to the scan thread.

Loop closure keeps its own copy of the poses. Only new keyframes go in, and only a `LoopOutcome` comes out. The same
keyframes therefore give the same result, independent of timing. `LoopClosure.update`, for each new keyframe:

1. ``_add``: tie the keyframe to the previous one by the measured step, and grow the drift.
2. ``_chains``: every `SPACING_M`, find runs of older keyframes within the drift of its pose.
3. ``find_place``: match the recent keyframes (``_query``) against each run, by correlative search. The place must fix
   the pose in every direction and be clearly better than the next best place (``_good``).
4. ``_confirm``: a large correction needs several loops that agree with each other.
5. ``_optimise``: optimise the pose graph (``pose_graph``), and reject loops that the rest of the graph contradicts.
6. ``_thin_out``: remove a keyframe in a place with enough older ones, and chain its edges.
7. ``_rebuild_map``: rebuild the occupancy map if poses have changed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import compose2, inverse2, relative2, wrap_angle
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.keyframes import LOCAL_KEYFRAMES, NO_SCAN, ScanKeyframe, grown_drift, turned
from instant_ic.slam.likelihood_field import FieldSurface, LikelihoodField
from instant_ic.slam.loop_search import MIN_PLACE_SCORE, Found, find_place, spread
from instant_ic.slam.occupancy import OccupancyMap
from instant_ic.slam.pose_graph import Edge, optimise, residuals
from instant_ic.slam.scan import FloatArray, ScanPoints

SPACING_M = 0.5
"""Distance driven between two searches for a loop."""
QUERY_KEYFRAMES = 10
"""Number of recent keyframes matched together against older ones, because some metres of track have a unique shape."""
QUERY_RANGE_M, QUERY_POINTS = 20.0, 250
"""Largest range of hits that are used, and maximum number of points of the recent keyframes."""
CHAIN_KEYFRAMES, MIN_CHAIN_KEYFRAMES = 20, 5
"""Number of consecutive older keyframes against which the recent ones are matched, and smallest reliable number."""
CHAINS = 2
"""Number of places searched at a time, lowest drift first."""
SIGMAS, MAX_REACH_M, MAX_REACH_RAD = 3.0, 10.0, 0.8
"""Search range in standard deviations of the drift, and its limits."""
MIN_SHAPE = 0.05
"""Minimum ratio of smallest to largest information over all directions; about 0 in a bare corridor."""
MIN_GAIN = 0.35
"""Share of the second best place's residual that the best place must explain."""
CONFIRMATIONS = 3
"""Number of keyframes whose loops must agree before a correction beyond `SURE_M` or `SURE_RAD`."""
SURE_M, SURE_RAD = 0.25, 0.06
"""Largest correction that needs no confirmation: a keyframe spacing, and three coarse heading steps."""
LOOP_SIGMA_M, LOOP_SIGMA_RAD = 0.03, 0.01
"""Standard deviation of a loop closure beyond its own covariance."""
SAME_PLACE, SAME_PLACE_M, SAME_PLACE_RAD = 3, 0.35, 0.35
"""Number of older keyframes within a distance and heading difference that make a new keyframe superfluous."""
OVERLAP_M = 3.0
"""Distance beyond the pose's uncertainty within which older keyframes are compared."""
SETTLED_M, SETTLED_RAD = 0.02, 0.004
"""Largest error at which a loop already fits the graph and needs no optimisation at once."""
SETTLED_EDGES = 20
"""Number of such loops at which the graph is optimised nevertheless."""
MAX_LOOPS_OF_ONE = 4
"""Maximum number of loops that a keyframe keeps when it inherits those of a removed one."""
PENDING_KEYFRAMES = 40
"""Number of keyframes after which an unconfirmed loop is dropped."""


@dataclass(frozen=True)
class LoopOutcome:
    """Result of an update.

    Attributes:
        count: number of keyframes processed.
        poses: poses of these keyframes, (count, 3); None if unchanged.
        alive: indices of the keyframes that have not been removed, ascending.
        drift: covariance of the last keyframe in the map, (3, 3).
        map: map rebuilt from all keyframes; None if it was not rebuilt.
        merged: removed keyframes, each with the one that replaces it and its pose relative to that one, (3,).
        edges: current edges of the graph.
    """

    count: int
    poses: FloatArray | None
    alive: NDArray[np.intp]
    drift: FloatArray
    map: OccupancyMap | None
    merged: list[tuple[int, int, FloatArray]]
    edges: list[Edge]

    def apply(self, keyframes: Sequence[ScanKeyframe]) -> FloatArray | None:
        """Move, merge and update the trajectory's keyframes, including those added since the update began.

        Returns:
            The transform (3,) by which the newest part of the map has moved; None if nothing moved.
        """
        moved = None
        newer = keyframes[self.count :]
        if self.poses is not None:
            moved = correction(keyframes[self.count - 1].map_from_base, self.poses[-1])
            for k in self.alive:
                keyframes[k].map_from_base = self.poses[k]
            for keyframe in newer:
                keyframe.map_from_base = compose2(moved, keyframe.map_from_base)
        for gone, heir, heir_from_gone in self.merged:
            keyframes[gone].merged_into = (keyframes[heir], heir_from_gone)
            keyframes[gone].scan = NO_SCAN
        drift = self.drift
        for before, keyframe in zip(keyframes[self.count - 1 :], newer, strict=False):
            way = keyframe.map_from_base[:2] - before.map_from_base[:2]
            drift = grown_drift(drift, way, float(before.map_from_base[2]), keyframe.step_covariance)
        keyframes[-1].drift = drift
        return moved


@dataclass(frozen=True)
class _Candidate:
    """A loop that has passed all individual checks and waits for other loops that agree."""

    edge: Edge
    travelled_m: float


class LoopClosure:
    """Loop closure and pose graph.

    Attributes:
        edges: edges of the graph; node ids are indices in the list of keyframes.
        closed: number of accepted loops.
        refused: number of loops that were rejected after optimisation, because the rest of the graph contradicts them.
    """

    def __init__(self, config: SlamConfig) -> None:
        self.config = config
        self.edges: list[Edge] = []
        self.closed = 0
        self.refused = 0
        self._keyframes: list[ScanKeyframe] = []
        self._poses: FloatArray = np.zeros((256, 3))
        self._drifts: list[FloatArray] = []
        self._travelled: list[float] = []
        self._pending: list[_Candidate] = []
        self._unsettled = 0
        self._searched_at_m = 0.0
        self._built: FloatArray = np.zeros((0, 3))
        self._alive = np.zeros(256, dtype=np.bool_)
        self._merged: list[tuple[int, int, FloatArray]] = []
        self._field = LikelihoodField(config.field.resolution_m, QUERY_RANGE_M + (MAX_REACH_M + OVERLAP_M))

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def poses(self) -> FloatArray:
        """Poses of all keyframes (n, 3)."""
        return self._poses[: len(self._keyframes)]

    def update(self, new: Sequence[ScanKeyframe], last: bool = False) -> LoopOutcome:
        """Add new keyframes, search for loops, and optimise if that improves the graph.

        Args:
            new: keyframes since the last call, in order.
            last: complete all pending work, because no more keyframes will follow.
        """
        changed = False
        for keyframe in new:
            self._add(keyframe)
            here = len(self._keyframes) - 1
            if self._travelled[here] - self._searched_at_m >= SPACING_M:
                self._searched_at_m = self._travelled[here]
                changed |= self._close(here)
            self._thin_out(here - LOCAL_KEYFRAMES - 2 * QUERY_KEYFRAMES)
        if last and self._unsettled:
            changed |= self._optimise(self.edges[len(self.edges) :])
        drift = self._drifts[-1] if self._drifts else np.zeros((3, 3))
        rebuilt = self._rebuild_map(last) if changed or last else None
        merged, self._merged = self._merged, []
        poses = self.poses.copy() if changed else None
        alive = np.flatnonzero(self._alive[: len(self)])
        return LoopOutcome(len(self), poses, alive, drift, rebuilt, merged, list(self.edges))

    def load(self, keyframes: Sequence[ScanKeyframe], edges: Sequence[Edge]) -> None:
        """Start with a saved graph, whose first keyframe stays fixed."""
        for keyframe in keyframes:
            self._add(keyframe)
        self.edges = list(edges)
        self._poses[: len(self)] = [keyframe.map_from_base for keyframe in keyframes]
        self._drifts = [keyframe.drift for keyframe in keyframes]
        self._built = self.poses.copy()

    def tie(self, here: int, pose: FloatArray, covariance: FloatArray) -> None:
        """Tie keyframe ``here``, which is added next, to the existing keyframes at ``pose`` (3,) in their map."""
        near = int(np.argmin(((self.poses[:, :2] - pose[:2]) ** 2).sum(axis=1)))
        yaw = float(self._poses[near, 2])
        self.edges.append(Edge(near, here, relative2(self._poses[near], pose), _loop_covariance(covariance, yaw)))

    # -- keyframes --------------------------------------------------------------------------------

    def _add(self, keyframe: ScanKeyframe) -> None:
        here = len(self._keyframes)
        if here == len(self._poses):
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
            self._alive = np.concatenate([self._alive, np.zeros_like(self._alive)])
        self._alive[here] = True
        if here == 0:
            self._poses[0] = keyframe.map_from_base
            self._drifts.append(keyframe.drift)
            self._travelled.append(0.0)
        else:
            before = self._poses[here - 1]
            pose = compose2(before, keyframe.step)
            self._poses[here] = pose
            self._drifts.append(
                grown_drift(self._drifts[-1], pose[:2] - before[:2], float(before[2]), keyframe.step_covariance)
            )
            # Turning reveals new surfaces too, so a radian counts as half a metre.
            way = math.hypot(keyframe.step[0], keyframe.step[1]) + 0.5 * abs(float(keyframe.step[2]))
            self._travelled.append(self._travelled[-1] + way)
            self.edges.append(Edge(here - 1, here, keyframe.step, keyframe.step_covariance))
        self._keyframes.append(keyframe)

    # -- loops ------------------------------------------------------------------------------------

    def _close(self, here: int) -> bool:
        """Search for loops that end at keyframe ``here``. Return True if poses have changed."""
        first = max(0, here - QUERY_KEYFRAMES + 1)
        old = first - LOCAL_KEYFRAMES
        if old < MIN_CHAIN_KEYFRAMES:
            return False
        pose, drift = self._poses[here], self._drifts[here]
        sigma_m = math.sqrt(max(np.linalg.eigvalsh(drift[:2, :2])[-1], 0.0))
        sigma_rad = math.sqrt(max(drift[2, 2], 0.0))
        reach_m = min(SIGMAS * sigma_m + 0.3, MAX_REACH_M)
        reach_rad = min(SIGMAS * sigma_rad + 0.1, MAX_REACH_RAD)
        chains = self._chains(pose, old, reach_m + OVERLAP_M)
        if not chains:
            return False
        query = self._query(first, here)
        accepted: list[Edge] = []
        for chain in chains[:CHAINS]:
            nearest = min(chain, key=lambda k: float(((self._poses[k, :2] - pose[:2]) ** 2).sum()))
            at = chain.index(nearest)
            half = CHAIN_KEYFRAMES // 2
            members = chain[max(0, at - half) : at + half + 1]
            surfaces = [
                FieldSurface(self._poses[k], self._keyframes[k].scan.points, self._keyframes[k].scan.joined)
                for k in members
            ]
            self._field.rebuild(pose, surfaces)
            found = find_place(self._field, query, pose, reach_m, reach_rad)
            if found is None or not self._good(found):
                continue
            edge = self._edge(nearest, here, found)
            correction = relative2(pose, found.pose)
            sure = math.hypot(correction[0], correction[1]) <= SURE_M and abs(correction[2]) <= SURE_RAD
            if sure and reach_m <= 4 * SURE_M:
                accepted.append(edge)
            else:
                accepted += self._confirm(_Candidate(edge, self._travelled[here]))
        if not accepted:
            return False
        self.edges += accepted
        for edge in accepted:
            self._anchor(edge)
        self._unsettled += len(accepted)
        if self._unsettled < SETTLED_EDGES and all(self._fits(edge, SETTLED_M, SETTLED_RAD) for edge in accepted):
            self.closed += len(accepted)
            return False
        return self._optimise(accepted)

    def _chains(self, pose: FloatArray, old: int, radius_m: float) -> list[list[int]]:
        """Return the runs of keyframes before ``old`` within ``radius_m`` of a pose, lowest drift first."""
        way = self._poses[:old, :2] - pose[:2]
        near = np.flatnonzero(((way**2).sum(axis=1) <= radius_m**2) & self._alive[:old])
        if len(near) == 0:
            return []
        runs = np.split(near, np.flatnonzero(np.diff(near) > 6) + 1)
        chains = [[int(k) for k in run] for run in runs if len(run) >= MIN_CHAIN_KEYFRAMES]
        return sorted(chains, key=lambda chain: float(np.trace(self._drifts[chain[0]][:2, :2])))

    def _query(self, first: int, here: int) -> FloatArray:
        """Return the points of the recent keyframes in the frame of the newest, (n, 2)."""
        members = range(first, here + 1)
        return gather([self._poses[k] for k in members], [self._keyframes[k].scan for k in members])

    def _good(self, found: Found) -> bool:
        # In a corridor, the two walls give a medium score anywhere along it. The criterion is therefore how much of the
        # residual of the second best pose the best pose explains.
        gain = (found.score - found.runner_up) / max(1.0 - found.runner_up, 1e-6)
        return found.score >= MIN_PLACE_SCORE and found.shape >= MIN_SHAPE and gain >= MIN_GAIN

    def _edge(self, there: int, here: int, found: Found) -> Edge:
        covariance = _loop_covariance(found.covariance, float(self._poses[there, 2]))
        return Edge(there, here, relative2(self._poses[there], found.pose), covariance, robust=True)

    def _confirm(self, candidate: _Candidate) -> list[Edge]:
        """Return this loop and those that agree with it, if there are enough. Otherwise, let the candidate wait."""
        here = candidate.edge.b
        # Drop loops whose keyframe has been removed from the graph in the meantime.
        self._pending = [
            other
            for other in self._pending
            if here - other.edge.b <= PENDING_KEYFRAMES and self._alive[[other.edge.a, other.edge.b]].all()
        ]
        agreeing = [other for other in self._pending if self._consistent(other.edge, candidate.edge)]
        self._pending.append(candidate)
        ends = {other.edge.b for other in agreeing} | {here}
        way = candidate.travelled_m - min((other.travelled_m for other in agreeing), default=candidate.travelled_m)
        if len(ends) < CONFIRMATIONS or way < (CONFIRMATIONS - 1) * SPACING_M:
            return []
        self._pending = [other for other in self._pending if other not in agreeing and other is not candidate]
        return [other.edge for other in agreeing] + [candidate.edge]

    def _consistent(self, one: Edge, two: Edge) -> bool:
        """Return whether two loops agree, so that the cycle through both and the graph closes without error."""
        start = relative2(self._poses[one.a], self._poses[two.a])
        end = relative2(self._poses[one.b], self._poses[two.b])
        rest = relative2(compose2(one.a_from_b, end), compose2(start, two.a_from_b))
        way = math.hypot(end[0], end[1]) + math.hypot(start[0], start[1])
        return math.hypot(rest[0], rest[1]) <= 0.15 + 0.03 * way and abs(wrap_angle(float(rest[2]))) <= 0.06

    def _anchor(self, edge: Edge) -> None:
        """Limit the drift at the end of a loop to the drift at its start plus the measured step."""
        pose = self._poses[edge.a]
        way = compose2(pose, edge.a_from_b)[:2] - pose[:2]
        drift = grown_drift(self._drifts[edge.a], way, float(pose[2]), edge.covariance)
        for k in range(edge.b, len(self._drifts)):
            if np.trace(drift) < np.trace(self._drifts[k]):
                self._drifts[k] = drift
            if k + 1 < len(self._drifts):
                step = self._poses[k + 1, :2] - self._poses[k, :2]
                drift = grown_drift(drift, step, float(self._poses[k, 2]), self._keyframes[k + 1].step_covariance)

    # -- removal of keyframes ---------------------------------------------------------------------

    def _thin_out(self, k: int) -> None:
        """Remove keyframe ``k`` if enough older ones cover its place, so that a known area has a constant cost."""
        if k < 1 or not self._alive[k]:
            return
        apart = self._poses[:k] - self._poses[k]
        near = np.hypot(apart[:, 0], apart[:, 1]) <= SAME_PLACE_M
        near &= np.abs(np.arctan2(np.sin(apart[:, 2]), np.cos(apart[:, 2]))) <= SAME_PLACE_RAD
        near &= self._alive[:k]
        # The robot's own recent track is not a return to a known place.
        near[max(0, k - 2 * LOCAL_KEYFRAMES) :] = False
        if int(near.sum()) < SAME_PLACE:
            return
        own = [edge for edge in self.edges if k in (edge.a, edge.b)]
        step = next((edge for edge in own if edge.b == k and not edge.robust), None)
        if step is None:
            return
        heir = step.a
        loops = sum(edge.robust and heir in (edge.a, edge.b) for edge in self.edges)
        kept = [edge for edge in self.edges if k not in (edge.a, edge.b)]
        for edge in own:
            if edge is step:
                continue
            if edge.robust:
                loops += 1
                if loops > MAX_LOOPS_OF_ONE:
                    continue
            outward = edge if edge.a == k else reversed_edge(edge)
            if outward.b != heir:
                kept.append(chained(step, outward))
        self.edges = kept
        self._alive[k] = False
        self._merged.append((k, heir, relative2(self._poses[heir], self._poses[k])))

    # -- graph ------------------------------------------------------------------------------------

    def _fits(self, edge: Edge, within_m: float, within_rad: float) -> bool:
        error = residuals(self._poses, np.array([edge.a]), np.array([edge.b]), edge.a_from_b[None])[0]
        return math.hypot(error[0], error[1]) <= within_m and abs(float(error[2])) <= within_rad

    def _optimise(self, accepted: Sequence[Edge]) -> bool:
        """Optimise the poses over all edges, and remove loops that the rest of the graph contradicts."""
        self._unsettled = 0
        alive = np.flatnonzero(self._alive[: len(self)])
        index = {int(k): row for row, k in enumerate(alive)}
        solution = optimise(self._poses[alive], self.edges, index)
        wrong = {id(edge) for edge, weight in zip(self.edges, solution.weights, strict=True) if weight < 0.5}
        if wrong:
            self.refused += len(wrong)
            self.edges = [edge for edge in self.edges if id(edge) not in wrong]
            solution = optimise(self._poses[alive], self.edges, index)
        self.closed += sum(id(edge) not in wrong for edge in accepted)
        self._poses[alive] = solution.poses
        return True

    def _rebuild_map(self, last: bool) -> OccupancyMap | None:
        """Rebuild the map if the keyframes have moved since it was built, at a limited rate."""
        count, built = len(self), len(self._built)
        if count == 0:
            return None
        moved = self.poses[:built] - self._built
        far = float(np.hypot(moved[:, 0], moved[:, 1]).max()) if built else math.inf
        turned = float(np.abs(np.arctan2(np.sin(moved[:, 2]), np.cos(moved[:, 2]))).max()) if built else math.inf
        if far < 0.5 * self.config.map.resolution_m and turned < 0.005:
            return None
        # The time of a rebuild is proportional to the number of keyframes. At this rate, the cost per new keyframe is
        # constant.
        if not last and far < 0.2 and turned < 0.05 and count - built < max(20, count // 10):
            return None
        rebuilt = OccupancyMap(self.config.map)
        for k in np.flatnonzero(self._alive[:count]):
            rebuilt.insert(self._poses[k], self._keyframes[k].scan)
        self._built = self.poses.copy()
        return rebuilt


def _loop_covariance(covariance: FloatArray, yaw: float) -> FloatArray:
    """Return the covariance of a loop in the frame of its start, whose heading in the map is ``yaw``."""
    return turned(covariance, -yaw) + np.diag(np.square([LOOP_SIGMA_M, LOOP_SIGMA_M, LOOP_SIGMA_RAD]))


def reversed_edge(edge: Edge) -> Edge:
    """Return an edge in the opposite direction."""
    b_from_a = inverse2(edge.a_from_b)
    carry = np.eye(3)
    carry[0, 2], carry[1, 2] = edge.a_from_b[1], -edge.a_from_b[0]
    covariance = turned(carry @ edge.covariance @ carry.T, -float(edge.a_from_b[2]))
    return Edge(edge.b, edge.a, b_from_a, covariance, edge.robust)


def chained(first: Edge, second: Edge) -> Edge:
    """Compose two edges, of which the second starts where the first ends."""
    a_from_c = compose2(first.a_from_b, second.a_from_b)
    way = a_from_c[:2] - first.a_from_b[:2]
    covariance = grown_drift(first.covariance, way, float(first.a_from_b[2]), second.covariance)
    return Edge(first.a, second.b, a_from_c, covariance, first.robust or second.robust)


def gather(poses: Sequence[FloatArray], scans: Sequence[ScanPoints]) -> FloatArray:
    """Return the points of scans at their poses (3,), in the frame of the last pose and evenly spread, (n, 2)."""
    parts = []
    for pose, scan in zip(poses, scans, strict=True):
        x, y, yaw = relative2(poses[-1], pose)
        points = scan.points[(scan.points**2).sum(axis=1) <= QUERY_RANGE_M**2]
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        parts.append(points @ np.array([[cos_yaw, sin_yaw], [-sin_yaw, cos_yaw]]) + (x, y))
    return spread(np.concatenate(parts), 0.1, QUERY_POINTS)


def correction(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the transform (3,) that moves ``before`` to ``after``: ``after ∘ before⁻¹``."""
    return compose2(after, inverse2(before))
