"""Rao-Blackwellised particle filter: the paper's method (GMapping), with GMapping's parameter names.

Each particle is a path with its own map. Odometry moves a particle with added noise, and hill climbing on its map
improves the pose. The scan likelihood at that pose is the particle's weight. The filter resamples when the weights
become too unequal (Grisetti, Stachniss, Burgard, 2007). Between two updates the pose follows odometry.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from instant_ic.experiments.tile_maps import TileMaps, climb
from instant_ic.geometry.poses import compose2, inverse2, relative2, wrap_angle
from instant_ic.slam.config import SlamConfig
from instant_ic.slam.front_end import MIN_POINTS
from instant_ic.slam.grid_slam import GridSlam, SlamResult, SlamStatus
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.slam.scan import FloatArray, Scan, ScanPoints, scan_points

OCCUPIED = 0.25
"""Minimum share of hits among the beams at a cell for it to be occupied (slam_gmapping's occ_thresh)."""


@dataclass(frozen=True)
class ParticleConfig:
    """Parameters, with GMapping's names and defaults.

    Attributes:
        particles: number of paths, each with its own map.
        linearUpdate: translation after which a scan is used, metres.
        angularUpdate: rotation after which a scan is used, radians.
        resampleThreshold: resample when the share of effective particles falls below this.
        maxUrange: farther hits are ignored, metres.
        sigma: standard deviation of a hit for matching, metres.
        kernelSize: number of cells searched around a hit.
        lstep: first translation step of the hill climbing, metres.
        astep: first rotation step of the hill climbing, radians.
        iterations: number of times that the steps are halved.
        lsigma: standard deviation of a hit for the weight.
        ogain: smooths the weights.
        lskip: number of beams skipped after each used beam.
        minimumScore: a match with a lower score is rejected.
        srr: odometry error in translation from translation.
        srt: odometry error in rotation from translation.
        str: odometry error in translation from rotation.
        stt: odometry error in rotation from rotation.
        delta: cell size of the particles' maps, metres.
        seed: seed of all random numbers.
    """

    particles: int = 30
    linearUpdate: float = 1.0
    angularUpdate: float = 0.5
    resampleThreshold: float = 0.5
    maxUrange: float = 20.0
    sigma: float = 0.05
    kernelSize: int = 1
    lstep: float = 0.05
    astep: float = 0.05
    iterations: int = 5
    lsigma: float = 0.075
    ogain: float = 3.0
    lskip: int = 0
    minimumScore: float = 0.0
    srr: float = 0.1
    srt: float = 0.2
    str: float = 0.1
    stt: float = 0.2
    delta: float = 0.05
    seed: int = 0


@dataclass(frozen=True)
class _Update:
    """Poses of all particles after an update (n, 3), and the parent index of each (n,)."""

    poses: FloatArray
    parents: NDArray[np.intp]


@dataclass(frozen=True)
class _PathAnchor:
    """An update on the path of the particle that is best when the pose is read."""

    slam: ParticleSlam
    index: int

    def pose(self) -> FloatArray:
        """map_from_base (3,) at that update."""
        return self.slam.path()[self.index]


class ParticleSlam:
    """Particle filter with the interface of `GridSlam`."""

    def __init__(self, particles: ParticleConfig | None = None, config: SlamConfig | None = None) -> None:
        self.config = config = config or SlamConfig()
        self.particle_config = particles or ParticleConfig()
        count = self.particle_config.particles
        self.maps = TileMaps(count, self.particle_config.delta, config.map.max_size_m)
        self.map_from_base: FloatArray = np.zeros(3)
        self.map_from_odom: FloatArray = np.zeros(3)
        self.odom_from_base: FloatArray = np.zeros(3)
        self.resampled = 0
        self._rng = np.random.default_rng(self.particle_config.seed)
        self._poses: FloatArray = np.zeros((count, 3))
        self._log_weights: FloatArray = np.zeros(count)
        self._best = 0
        self._parents: NDArray[np.intp] = np.arange(count)
        self._updates: list[_Update] = []
        self._path: tuple[int, FloatArray] = (0, np.zeros((0, 3)))
        self._stamp_ns: int | None = None
        self._at_update: FloatArray = np.zeros(3)
        self._way = self._turn = 0.0
        self._lidar = GridSlam(replace(config, loop=replace(config.loop, enabled=False)))
        self._wheels: bool | None = None

    def process(
        self, scan: Scan, odom_pose: ArrayLike | None = None, base_from_laser: ArrayLike = (0.0, 0.0, 0.0)
    ) -> SlamResult:
        """Estimate the pose of a scan by odometry, or by the filter once the robot has moved far enough.

        Without odometry, scan matching against recent scans (the front end of the graph method) is the fallback.
        """
        if self._stamp_ns is not None and scan.stamp_ns <= self._stamp_ns:
            return self._result(SlamStatus.TIME_BACKWARDS, 0.0, False)
        odometry = None if odom_pose is None else np.asarray(odom_pose, dtype=np.float64)
        if odometry is not None and not np.isfinite(odometry).all():
            raise ValueError(f"odometry at {scan.stamp_ns} ns is not finite: {odometry}")
        wheels = odometry is not None
        if odometry is None:
            odometry = self._lidar.process(scan, None, base_from_laser).map_from_base
        mount = np.asarray(base_from_laser, dtype=np.float64)
        points = scan_points(scan, mount, 0.0)
        empty = len(points.points) < MIN_POINTS
        if self._stamp_ns is None:
            if empty:
                return SlamResult(self.map_from_base, np.zeros((3, 3)), 0.0, SlamStatus.NO_POINTS, False)
            self._poses[:] = self._at_update = odometry
        elif wheels == self._wheels:
            step = relative2(self.odom_from_base, odometry)
            self._way += math.hypot(step[0], step[1])
            self._turn += abs(float(step[2]))
        else:
            self._at_update = compose2(odometry, relative2(self.odom_from_base, self._at_update))
        self._stamp_ns, self._wheels, self.odom_from_base = scan.stamp_ns, wheels, odometry
        gmapping = self.particle_config
        moved = self._way >= gmapping.linearUpdate or self._turn >= gmapping.angularUpdate
        if empty or (self._updates and not moved):
            if self._updates:
                self.map_from_base = compose2(self._best_pose(), relative2(self._at_update, odometry))
                self.map_from_odom = compose2(self.map_from_base, inverse2(odometry))
            return self._result(SlamStatus.NO_POINTS if empty else SlamStatus.TRACKED, 0.0, False)
        status = SlamStatus.TRACKED if self._updates else SlamStatus.FIRST
        score = self._update(points, relative2(self._at_update, odometry))
        self._at_update, self._way, self._turn = odometry, 0.0, 0.0
        self.map_from_base = self._best_pose()
        self.map_from_odom = compose2(self.map_from_base, inverse2(odometry))
        return self._result(status, score, True)

    def path(self) -> FloatArray:
        """Poses of the best particle at every update, (n, 3)."""
        count = len(self._updates)
        if self._path[0] != count:
            poses = np.zeros((count, 3))
            particle = int(self._parents[self._best])
            for k in range(count - 1, -1, -1):
                poses[k] = self._updates[k].poses[particle]
                particle = int(self._updates[k].parents[particle])
            self._path = (count, poses)
        return self._path[1]

    def grid(self) -> OccupancyGrid:
        """Map of the best particle: −1, 0 or 100."""
        visits, hits, corner = self.maps.grid(self._best)
        values = np.where(hits > OCCUPIED * visits, 100, 0).astype(np.int8)
        values[visits == 0] = -1
        return OccupancyGrid(values, self.maps.delta, corner)

    def background_job(self) -> Callable[[], Any] | None:
        """Return None: this method has no background jobs."""
        return None

    def take_over(self, outcome: Any) -> None:
        """Do nothing: there are no background jobs."""

    def finish(self) -> None:
        """Do nothing: no work is pending."""

    def figures(self) -> dict[str, object]:
        """Counts of updates, effective particles, resamplings and map tiles."""
        return {
            "updates": len(self._updates),
            "neff": round(self._effective(), 1),
            "resampled": self.resampled,
            "tiles": self.maps.tiles,
        }

    # -- the filter -------------------------------------------------------------------------------

    def _update(self, scan: ScanPoints, step: FloatArray) -> float:
        """Move, match, weigh, map, resample; return the best particle's mean score per beam."""
        gmapping, maps = self.particle_config, self.maps
        ranges = np.hypot(*(scan.points - scan.origin).T)
        near = np.ascontiguousarray(scan.points[ranges <= gmapping.maxUrange][:: gmapping.lskip + 1])
        scores = np.ones(gmapping.particles)
        if self._updates:
            self._draw_motion(step)
            for k in range(gmapping.particles):
                pose, value, likelihood = climb(
                    maps.tables[k], maps.cells, maps.delta, self._poses[k], scan.origin, near, gmapping.kernelSize,
                    gmapping.sigma, gmapping.lsigma, gmapping.lstep, gmapping.astep, gmapping.iterations,
                )  # fmt: skip
                if value > gmapping.minimumScore:
                    self._poses[k] = pose
                self._log_weights[k] += likelihood
                scores[k] = value / max(len(near), 1)
            self._poses[:, 2] = np.arctan2(np.sin(self._poses[:, 2]), np.cos(self._poses[:, 2]))
        self._updates.append(_Update(self._poses.copy(), self._parents))
        self._parents = np.arange(gmapping.particles)
        self._best = int(np.argmax(self._log_weights))
        best = float(scores[self._best])
        if self._effective() < gmapping.resampleThreshold * gmapping.particles:
            self._resample()
        for k in range(gmapping.particles):
            maps.register(k, self._poses[k], scan.origin, scan.points, gmapping.maxUrange)
        return best

    def _draw_motion(self, step: FloatArray) -> None:
        """Move each particle by the odometry step plus its own noise (GMapping's motion model)."""
        noise = self.particle_config
        dx, dy, turn = abs(float(step[0])), abs(float(step[1])), abs(float(step[2]))
        cross = 0.3 * noise.srr
        sigma = np.array(
            [
                noise.srr * dx + noise.str * turn + cross * dy,
                noise.srr * dy + noise.str * turn + cross * dx,
                noise.stt * turn + noise.srt * math.hypot(dx, dy),
            ]
        )
        for k, draw in enumerate(self._rng.standard_normal(self._poses.shape)):
            self._poses[k] = compose2(self._poses[k], step + sigma * draw)

    def _weights(self) -> FloatArray:
        """Normalised weights (n,) from the log-likelihoods, smoothed by ``ogain``."""
        config = self.particle_config
        weights = np.exp((self._log_weights - self._log_weights.max()) / (config.ogain * config.particles))
        normalised: FloatArray = weights / weights.sum()
        return normalised

    def _effective(self) -> float:
        return float(1.0 / (self._weights() ** 2).sum())

    def _resample(self) -> None:
        """Systematic resampling; all particles have the same weight afterwards."""
        count = self.particle_config.particles
        places = (self._rng.random() + np.arange(count)) / count
        parents = np.minimum(np.searchsorted(np.cumsum(self._weights()), places), count - 1)
        survivors = np.flatnonzero(parents == self._best)
        self._best = int(survivors[0]) if len(survivors) else 0
        self._poses = self._poses[parents]
        self._log_weights = np.zeros(count)
        self._parents = parents
        self.maps.resample(parents)
        self.resampled += 1

    def _best_pose(self) -> FloatArray:
        return self._poses[self._best].copy()

    def _result(self, status: SlamStatus, score: float, updated: bool) -> SlamResult:
        weights, poses = self._weights(), self._poses
        error = poses - poses[self._best]
        error[:, 2] = [wrap_angle(float(turn)) for turn in error[:, 2]]
        covariance = (weights[:, None] * error).T @ error + np.diag([1e-4, 1e-4, 1e-5])
        anchor = _PathAnchor(self, len(self._updates) - 1) if self._updates else None
        return SlamResult(self.map_from_base, covariance, score, status, updated, anchor)
