"""A buffer of time-stamped transforms between named frames, like tf2's."""

from __future__ import annotations

import bisect
import threading
from dataclasses import dataclass, field

import numpy as np

from instant_ic.geometry.poses import Matrix, interpolate, inverse


class TransformError(LookupError):
    """A frame is unknown, two frames have no path between them, or no value exists at the requested time."""


_TOLERANCE_NS = 200_000_000
"""Largest time after a frame's newest value at which a look-up still returns that value. Drivers stamp data a little
later than the last odometry that has arrived."""


@dataclass
class _Edge:
    """A child frame's parent, and its poses over time."""

    parent: str
    static: bool
    stamps_ns: list[int] = field(default_factory=list)
    matrices: list[Matrix] = field(default_factory=list)


class TransformBuffer:
    """The last seconds of a tree of frames, with the pose between any two of them.

    Args:
        cache_s: time in seconds for which the values of moving frames are kept.
    """

    def __init__(self, cache_s: float = 30.0) -> None:
        self._cache_ns = int(cache_s * 1e9)
        self._edges: dict[str, _Edge] = {}
        self._lock = threading.Lock()

    def set(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        parent_from_child: Matrix,
        static: bool = False,
        now_ns: int | None = None,
    ) -> None:
        """Add a value, in the order of stamps; it replaces a value with the same stamp.

        If the frame's newest value is ahead of the present time ``now_ns``, the clock was set back and the frame's
        values are dropped. Otherwise that value would stay the newest until the clock has caught up, and the robot
        would seem to stand.

        Raises:
            TransformError: the matrix is not a finite (4, 4) array, or a frame would be its own ancestor.
        """
        matrix = np.array(parent_from_child, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise TransformError(f"transform {parent} → {child} is not a finite 4×4 matrix")
        with self._lock:
            ancestor: str | None = parent
            while ancestor is not None:
                if ancestor == child:
                    raise TransformError(f"transform {parent} → {child} would make a loop")
                edge = self._edges.get(ancestor)
                ancestor = edge.parent if edge else None
            edge = self._edges.get(child)
            other = edge is None or edge.parent != parent or edge.static != static or static
            latest_ns = None if now_ns is None else max(now_ns, stamp_ns) + _TOLERANCE_NS
            if edge is None or other or (latest_ns is not None and edge.stamps_ns[-1] > latest_ns):
                edge = self._edges[child] = _Edge(parent, static)
            if not edge.stamps_ns or stamp_ns > edge.stamps_ns[-1]:
                edge.stamps_ns.append(stamp_ns)
                edge.matrices.append(matrix)
            else:
                at = bisect.bisect_left(edge.stamps_ns, stamp_ns)
                if edge.stamps_ns[at] == stamp_ns:
                    edge.matrices[at] = matrix
                else:
                    edge.stamps_ns.insert(at, stamp_ns)
                    edge.matrices.insert(at, matrix)
            oldest = edge.stamps_ns[-1] - self._cache_ns
            keep = bisect.bisect_left(edge.stamps_ns, oldest)
            if keep > 64:  # in blocks: deleting from the front of a list is linear
                del edge.stamps_ns[:keep], edge.matrices[:keep]

    def forget_moving(self) -> None:
        """Drop the values of moving frames, for example when time goes back. Fixed frames are kept."""
        with self._lock:
            self._edges = {child: edge for child, edge in self._edges.items() if edge.static}

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Matrix:
        """Return ``target_from_source``, interpolated at ``stamp_ns``; without a time, from each frame's newest value.

        Raises:
            TransformError: a frame is unknown, there is no path, or the time is outside the stored range.
        """
        with self._lock:
            up_source = self._chain(source)
            up_target = self._chain(target)
            common = next((frame for frame in up_source if frame in up_target), None)
            if common is None:
                known = ", ".join(sorted(self._frames())) or "none"
                raise TransformError(f"no path from {source} to {target} (frames known: {known})")
            common_from_source = self._product(up_source[: up_source.index(common)], stamp_ns)
            if up_target[0] == common:  # the usual case: the target is the common ancestor
                return common_from_source.copy()
            common_from_target = self._product(up_target[: up_target.index(common)], stamp_ns)
        return inverse(common_from_target) @ common_from_source

    def frames(self) -> frozenset[str]:
        with self._lock:
            return self._frames()

    def newest_ns(self, child: str) -> int | None:
        """Return the stamp of a frame's newest value; None for an unknown frame."""
        with self._lock:
            edge = self._edges.get(child)
            return edge.stamps_ns[-1] if edge else None

    def _frames(self) -> frozenset[str]:
        return frozenset(self._edges) | {edge.parent for edge in self._edges.values()}

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while (edge := self._edges.get(chain[-1])) is not None:
            chain.append(edge.parent)
        return chain

    def _product(self, chain: list[str], stamp_ns: int | None) -> Matrix:
        if not chain:
            return np.eye(4)
        ancestor_from_frame = self._at(chain[0], stamp_ns)
        for frame in chain[1:]:
            ancestor_from_frame = self._at(frame, stamp_ns) @ ancestor_from_frame
        return ancestor_from_frame

    def _at(self, frame: str, stamp_ns: int | None) -> Matrix:
        edge = self._edges[frame]
        if edge.static or stamp_ns is None:
            return edge.matrices[-1]
        at = bisect.bisect_left(edge.stamps_ns, stamp_ns)
        if at < len(edge.stamps_ns) and edge.stamps_ns[at] == stamp_ns:
            return edge.matrices[at]
        if at == 0:
            late = (edge.stamps_ns[0] - stamp_ns) / 1e9
            if late * 1e9 <= _TOLERANCE_NS:
                return edge.matrices[0]
            raise TransformError(f"{edge.parent} → {frame}: asked for {late:.3f} s before the oldest value")
        if at == len(edge.stamps_ns):
            ahead_ns = stamp_ns - edge.stamps_ns[-1]
            if ahead_ns <= _TOLERANCE_NS:
                return edge.matrices[-1]
            raise TransformError(f"{edge.parent} → {frame}: asked for {ahead_ns / 1e9:.3f} s after the newest value")
        before, after = edge.stamps_ns[at - 1], edge.stamps_ns[at]
        return interpolate(edge.matrices[at - 1], edge.matrices[at], (stamp_ns - before) / (after - before))
