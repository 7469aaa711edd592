"""Compilation of the kernels before the robot moves, because the first call of each takes up to seconds."""

from __future__ import annotations

import math

import numpy as np

from instant_ic.control.costmap import CostmapConfig, RollingCostmap, scan_rays
from instant_ic.control.footprint import Footprint
from instant_ic.control.heights import sort_points
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.planner import HybridPlanner
from instant_ic.control.prediction import PredictionConfig, Predictor
from instant_ic.control.safety import CollisionMonitor, CollisionMonitorConfig
from instant_ic.util.jit import leave_out_blas


def warm_up() -> None:
    """Run each numba kernel of this folder once on a small room."""
    leave_out_blas()
    config, footprint = CostmapConfig(width=4.0), Footprint()
    ranges = np.full(90, 1.5, dtype=np.float64)
    rays = scan_rays(ranges, -math.pi, 2 * math.pi / 90, 0.1, 10.0, np.eye(4), config)
    points = np.array([[1.0, 0.5, -0.3], [1.0, 0.5, -0.55]] * 3, dtype=np.float32)
    mount = np.eye(4)
    mount[2, 3] = 0.6
    sweep = sort_points(points, np.zeros(6, dtype=np.float32), mount[None], 0.0, config.points)
    costmap = RollingCostmap(config, footprint).update(np.zeros(3), None, rays, sweep)
    Predictor(PredictionConfig(), MotionLimits(), footprint).predict(np.zeros(3), (0.0, 0.0), (0.4, 0.0), costmap)
    HybridPlanner(footprint).plan(costmap, np.zeros(3), np.array([0.5, 0.5, 0.0]))
    CollisionMonitor(CollisionMonitorConfig(), footprint).limit((0.4, 0.0), np.array([[0.5, 0.0], [0.5, 0.1]]))
