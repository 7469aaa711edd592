"""Grid maps of many particles with shared tiles: a tile is copied when one of its owners writes to it.

A cell counts how often beams passed or hit it, and sums the hit positions, as in Grisetti, Stachniss, Burgard (Improved
techniques for grid mapping with Rao-Blackwellized particle filters, 2007).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.slam.scan import FloatArray

TILE = 32
"""Cells along a side of a tile."""


@njit(cache=True)
def _own(table, row, column, references, free, counters, cells):  # type: ignore[no-untyped-def]
    """Return a writable tile at a place of one particle's table, copied if shared; −1 when no tile is free."""
    tile = table[row, column]
    if tile >= 0 and references[tile] == 1:
        return tile
    if counters[0] == 0:
        return -1
    counters[0] -= 1
    new = free[counters[0]]
    references[new] = 1
    if tile >= 0:
        references[tile] -= 1
        cells[new] = cells[tile]
    else:
        cells[new] = 0.0
    table[row, column] = new
    return new


@njit(cache=True)
def _touch(table, ix, iy, references, free, counters, cells, hit, x, y):  # type: ignore[no-untyped-def]
    size = table.shape[0] * TILE
    if ix < 0 or iy < 0 or ix >= size or iy >= size:
        counters[1] += 1
        return
    tile = _own(table, iy // TILE, ix // TILE, references, free, counters, cells)
    if tile < 0:
        counters[1] += 1
        return
    v, u = iy % TILE, ix % TILE
    cells[tile, v, u, 0] += 1.0
    if hit:
        cells[tile, v, u, 1] += 1.0
        cells[tile, v, u, 2] += x
        cells[tile, v, u, 3] += y


@njit(cache=True)
def register(table, references, free, counters, cells, delta, pose, laser, points, usable):  # type: ignore[no-untyped-def]
    """Add a scan to one particle's map.

    Args:
        table: int32 (n, n) tiles of this particle, −1 where there is none; the map's origin is its middle.
        references: int32 (t,) number of tables that hold each tile.
        free: int32 (t,) stack of free tiles.
        counters: int64 (2,) height of that stack; number of cells that could not be added.
        cells: float32 (t, TILE, TILE, 4) visits, hits, sum of the hits' x and y.
        delta: metres per cell.
        pose: map_from_base (3,).
        laser: (2,) the laser's centre in the base frame.
        points: (k, 2) hits in the base frame.
        usable: maximum range of a hit, metres; farther hits only clear cells up to this range.
    """
    half = table.shape[0] * TILE // 2
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    lx = pose[0] + cos_yaw * laser[0] - sin_yaw * laser[1]
    ly = pose[1] + sin_yaw * laser[0] + cos_yaw * laser[1]
    for i in range(points.shape[0]):
        x = pose[0] + cos_yaw * points[i, 0] - sin_yaw * points[i, 1]
        y = pose[1] + sin_yaw * points[i, 0] + cos_yaw * points[i, 1]
        length = math.hypot(x - lx, y - ly)
        hit = length <= usable
        if not hit:
            x, y = lx + (x - lx) * usable / length, ly + (y - ly) * usable / length
        ix, iy = math.floor(lx / delta) + half, math.floor(ly / delta) + half
        end_x, end_y = math.floor(x / delta) + half, math.floor(y / delta) + half
        dx, dy = (x - lx) / delta, (y - ly) / delta
        fx, fy = lx / delta + half, ly / delta + half
        step_x = 1 if dx > 0 else -1
        step_y = 1 if dy > 0 else -1
        delta_x = abs(1.0 / dx) if dx != 0 else 1e30
        delta_y = abs(1.0 / dy) if dy != 0 else 1e30
        next_x = ((ix + 1 - fx) if dx > 0 else (fx - ix)) * delta_x if dx != 0 else 1e30
        next_y = ((iy + 1 - fy) if dy > 0 else (fy - iy)) * delta_y if dy != 0 else 1e30
        for _ in range(abs(end_x - ix) + abs(end_y - iy)):
            _touch(table, ix, iy, references, free, counters, cells, False, 0.0, 0.0)
            if next_x < next_y:
                next_x += delta_x
                ix += step_x
            else:
                next_y += delta_y
                iy += step_y
        _touch(table, end_x, end_y, references, free, counters, cells, hit, x, y)


@njit(cache=True)
def _full(table, cells, ix, iy):  # type: ignore[no-untyped-def]
    """Tile of a cell if the cell is occupied; −1 if it is free or unknown."""
    size = table.shape[0] * TILE
    if ix < 0 or iy < 0 or ix >= size or iy >= size:
        return -1
    tile = table[iy // TILE, ix // TILE]
    if tile < 0:
        return -1
    visits = cells[tile, iy % TILE, ix % TILE, 0]
    hits = cells[tile, iy % TILE, ix % TILE, 1]
    return tile if visits > 0 and hits > 0.1 * visits else -1


@njit(cache=True)
def score(table, cells, delta, pose, laser, points, kernel, sigma, lsigma):  # type: ignore[no-untyped-def]
    """Score of hits (k, 2) at a pose (3,) on the map: the matcher's score and the scan's log-likelihood.

    A hit counts if a cell within ``kernel`` cells of it is occupied and the previous cell on the beam is not.
    """
    half = table.shape[0] * TILE // 2
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    lx = pose[0] + cos_yaw * laser[0] - sin_yaw * laser[1]
    ly = pose[1] + sin_yaw * laser[0] + cos_yaw * laser[1]
    nothing = -0.5 / lsigma
    total = 0.0
    likelihood = 0.0
    for i in range(points.shape[0]):
        x = pose[0] + cos_yaw * points[i, 0] - sin_yaw * points[i, 1]
        y = pose[1] + sin_yaw * points[i, 0] + cos_yaw * points[i, 1]
        length = max(math.hypot(x - lx, y - ly), 1e-6)
        back_x, back_y = (lx - x) / length * delta * 1.4142, (ly - y) / length * delta * 1.4142
        ix, iy = math.floor(x / delta) + half, math.floor(y / delta) + half
        fx, fy = math.floor((x + back_x) / delta) + half, math.floor((y + back_y) / delta) + half
        best = 1e30
        for v in range(-kernel, kernel + 1):
            for u in range(-kernel, kernel + 1):
                tile = _full(table, cells, ix + u, iy + v)
                if tile < 0 or _full(table, cells, fx + u, fy + v) >= 0:
                    continue
                cell = cells[tile, (iy + v) % TILE, (ix + u) % TILE]
                dx, dy = x - cell[2] / cell[1], y - cell[3] / cell[1]
                best = min(best, dx * dx + dy * dy)
        if best < 1e29:
            total += math.exp(-best / (sigma * sigma))
            likelihood += max(-best / lsigma, nothing)
        else:
            likelihood += nothing
    return total, likelihood


@njit(cache=True)
def climb(table, cells, delta, start, laser, points, kernel, sigma, lsigma, lstep, astep, iterations):  # type: ignore[no-untyped-def]
    """Hill climbing of the score from ``start`` (3,): six neighbours, steps halved ``iterations`` times.

    Returns:
        pose (3,), score, log-likelihood.
    """
    pose = start.copy()
    best, likelihood = score(table, cells, delta, pose, laser, points, kernel, sigma, lsigma)
    step, turn = lstep, astep
    trial = np.empty(3)
    halved = 0
    while halved <= iterations:
        better = False
        cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
        top = pose.copy()
        for move in range(6):
            trial[:] = pose
            if move < 4:
                ahead = step if move == 0 else -step if move == 1 else 0.0
                left = step if move == 2 else -step if move == 3 else 0.0
                trial[0] += cos_yaw * ahead - sin_yaw * left
                trial[1] += sin_yaw * ahead + cos_yaw * left
            else:
                trial[2] += turn if move == 4 else -turn
            value, trial_likelihood = score(table, cells, delta, trial, laser, points, kernel, sigma, lsigma)
            if value > best:
                best, likelihood, better = value, trial_likelihood, True
                top[:] = trial
        if better:
            pose[:] = top
        else:
            halved += 1
            step *= 0.5
            turn *= 0.5
    return pose, best, likelihood


class TileMaps:
    """Maps of all particles; ``delta``: metres per cell, ``size_m``: side of the square that a map can cover.

    Attributes:
        tables: int32 (particles, n, n).
        cells: float32 (t, TILE, TILE, 4).
    """

    def __init__(self, particles: int, delta: float, size_m: float) -> None:
        self.delta = delta
        side = 2 * math.ceil(size_m / 2 / delta / TILE)
        self.tables = np.full((particles, side, side), -1, dtype=np.int32)
        self.cells = np.zeros((256, TILE, TILE, 4), dtype=np.float32)
        self.references = np.zeros(256, dtype=np.int32)
        self.free = np.arange(256, dtype=np.int32)
        self.counters = np.array([256, 0], dtype=np.int64)

    @property
    def tiles(self) -> int:
        """Number of tiles in use."""
        return len(self.references) - int(self.counters[0])

    def register(self, particle: int, pose: FloatArray, laser: FloatArray, points: FloatArray, usable: float) -> None:
        """Add a scan to one map; see the kernel."""
        self._reserve((math.ceil(2 * usable / self.delta / TILE) + 2) ** 2)
        register(
            self.tables[particle], self.references, self.free, self.counters, self.cells, self.delta, pose, laser,
            points, usable,
        )  # fmt: skip

    def resample(self, parents: NDArray[np.intp]) -> None:
        """Give particle ``i`` the map of particle ``parents[i]``; only the tables are copied."""
        self.tables = self.tables[parents]
        held = self.tables[self.tables >= 0]
        self.references[:] = np.bincount(held, minlength=len(self.references)).astype(np.int32)
        empty = np.flatnonzero(self.references == 0).astype(np.int32)
        self.free[: len(empty)] = empty
        self.counters[0] = len(empty)

    def grid(self, particle: int) -> tuple[NDArray[np.float32], NDArray[np.float32], FloatArray]:
        """Visits and hits (H, W) of one map, and the corner (2,) of cell (0, 0) in metres; 0×0 when it is empty."""
        table = self.tables[particle]
        rows, columns = np.nonzero(table >= 0)
        if len(rows) == 0:
            return np.zeros((0, 0), np.float32), np.zeros((0, 0), np.float32), np.zeros(2)
        low, high = (rows.min(), columns.min()), (rows.max() + 1, columns.max() + 1)
        shape = ((high[0] - low[0]) * TILE, (high[1] - low[1]) * TILE)
        visits, hits = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        for row, column in zip(rows, columns, strict=True):
            y, x = (row - low[0]) * TILE, (column - low[1]) * TILE
            tile = self.cells[table[row, column]]
            visits[y : y + TILE, x : x + TILE] = tile[..., 0]
            hits[y : y + TILE, x : x + TILE] = tile[..., 1]
        half = table.shape[0] * TILE // 2
        corner = (np.array([low[1], low[0]]) * TILE - half) * self.delta
        return visits, hits, corner.astype(np.float64)

    def _reserve(self, tiles: int) -> None:
        if self.counters[0] >= tiles:
            return
        old = len(self.references)
        new = old + max(old, tiles)
        self.cells = np.concatenate([self.cells, np.zeros((new - old, TILE, TILE, 4), dtype=np.float32)])
        self.references = np.concatenate([self.references, np.zeros(new - old, dtype=np.int32)])
        free = np.zeros(new, dtype=np.int32)
        count = int(self.counters[0])
        free[:count] = self.free[:count]
        free[count : count + new - old] = np.arange(old, new)
        self.free = free
        self.counters[0] += new - old
