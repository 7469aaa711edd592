"""Furniture built from boxes."""

import math

import numpy as np

from instant_ic.sim.world import Material, WorldBuilder

Point = tuple[float, float]


def _turned(centre: Point, yaw: float, offset: Point) -> Point:
    c, s = math.cos(yaw), math.sin(yaw)
    return centre[0] + c * offset[0] - s * offset[1], centre[1] + s * offset[0] + c * offset[1]


def table(
    build: WorldBuilder, centre: Point, yaw: float, size: Point = (1.4, 0.7), top: Material | None = None
) -> None:
    """Add a table: a top 40 mm thick at 0.74 m height on four legs."""
    top = top or Material("wood", 0.8)
    leg = Material("metal", 0.5)
    build.box(centre, (size[0], size[1], 0.04), 0.70, yaw, side=top)
    for sx in (-1, 1):
        for sy in (-1, 1):
            at = _turned(centre, yaw, (sx * (size[0] / 2 - 0.06), sy * (size[1] / 2 - 0.06)))
            build.box(at, (0.05, 0.05, 0.70), 0.0, yaw, side=leg)


def chair(build: WorldBuilder, centre: Point, yaw: float, seat: Material | None = None) -> None:
    """Add a chair that faces along its own x axis: seat, back, four legs."""
    seat = seat or Material("fabric", 0.5, (0.4, 0.5, 0.8))
    leg = Material("metal", 0.5, (0.5, 0.5, 0.5))
    build.box(centre, (0.44, 0.44, 0.06), 0.42, yaw, side=seat)
    build.box(_turned(centre, yaw, (-0.20, 0.0)), (0.05, 0.42, 0.42), 0.50, yaw, side=seat)
    for sx in (-1, 1):
        for sy in (-1, 1):
            at = _turned(centre, yaw, (sx * 0.19, sy * 0.19))
            build.box(at, (0.035, 0.035, 0.42 if sx > 0 else 0.5), 0.0, yaw, side=leg)


def bookcase(build: WorldBuilder, centre: Point, yaw: float, variant: int, height: float = 2.0) -> None:
    """Add a bookcase whose books face along its own x axis."""
    wood = Material("wood", 0.8, (0.7, 0.7, 0.7))
    build.box(centre, (0.32, 1.0, height), 0.0, yaw, side=wood, front=Material(f"books:{variant}", 0))


def cabinet(build: WorldBuilder, centre: Point, yaw: float, size: tuple[float, float, float], body: Material) -> None:
    """Add a cupboard with two doors and handles, which face along its own x axis."""
    build.box(centre, size, 0.0, yaw, side=body)
    handle = Material("metal", 0.3, (0.4, 0.4, 0.4))
    gap = Material("white", 0.5, (0.15, 0.15, 0.15))
    front = size[0] / 2
    build.box(_turned(centre, yaw, (front, 0.0)), (0.004, 0.008, size[2] - 0.08), 0.04, yaw, side=gap)
    for side in (-1, 1):
        at = _turned(centre, yaw, (front + 0.012, side * 0.06))
        build.box(at, (0.025, 0.02, 0.14), size[2] * 0.55, yaw, side=handle)


def sofa(build: WorldBuilder, centre: Point, yaw: float, cloth: Material, width: float = 1.8) -> None:
    """Add a sofa that faces along its own x axis."""
    build.box(centre, (0.85, width, 0.42), 0.0, yaw, side=cloth)
    build.box(_turned(centre, yaw, (-0.33, 0.0)), (0.2, width, 0.4), 0.42, yaw, side=cloth)
    for side in (-1, 1):
        build.box(_turned(centre, yaw, (0.0, side * (width / 2 - 0.1))), (0.85, 0.2, 0.2), 0.42, yaw, side=cloth)


def boxes(build: WorldBuilder, centre: Point, rng: np.random.Generator) -> None:
    """Add a stack of one to three cardboard boxes."""
    low = 0.0
    for _ in range(int(rng.integers(1, 4))):
        size = (rng.uniform(0.3, 0.5), rng.uniform(0.3, 0.5), rng.uniform(0.22, 0.4))
        at = (centre[0] + rng.uniform(-0.05, 0.05), centre[1] + rng.uniform(-0.05, 0.05))
        build.box(at, size, low, rng.uniform(-0.3, 0.3), side=Material("cardboard", 0))
        low += size[2] + 0.001
