"""Worlds of the experiments: by name, with objects removed or moved, and the paths of a camera through them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import pose_matrix

if TYPE_CHECKING:
    from instant_ic.sim.building import Building, Zone
    from instant_ic.sim.contact import OccupancyMask
    from instant_ic.sim.world import World

KINDS = {
    "hall": "open hall",
    "furnished": "furnished room",
    "crossing": "crossing corridors",
    "windows": "corridor with windows side by side",
}
"""Kinds of worlds beside those of the simulator, each with seeds (``hall:3``)."""
GENERATED = ("corridor", "corridor-free", "random", "long", *KINDS)
"""Worlds that have seeds."""
OBJECT_M, WALL_M = (0.03, 1.6), (1.9, 2.2)
"""Height range in which an object has surfaces, and height range in which only walls have surfaces."""
_CELL_M = 0.05
_AWAY_M = 1000.0
"""Depth below the floor to which removed objects are moved."""
_PLANS = {"furnished": "room", "windows": "corridor"}
CAMERA_HEIGHT_M, LIDAR_HEIGHT_M = 1.2, 0.6
CLEARANCE_M = 0.3
_RADII_M = (2.5, 4.0, 6.0, 10.0, 16.0)


def named_world(name: str) -> World:
    """Make a world of ``KINDS`` with its seed, or any of ``sim.worlds.make_world``.

    Raises:
        ValueError: no such world.
    """
    from instant_ic.sim.worlds import decorate, interior, make_world

    kind, _, number = name.partition(":")
    if kind not in KINDS:
        return make_world(name)
    if number and not number.isdigit():
        raise ValueError(f"world {name!r}: the seed must be an integer")
    rng = np.random.default_rng([97, list(KINDS).index(kind), int(number or 0)])

    def fit_out(rng: np.random.Generator, building: Building, zone: Zone) -> None:
        if kind == "windows" and zone is building.zones[0]:
            glaze(rng, building, zone)
        else:
            decorate(rng, building, zone)

    return interior(rng, name, _PLANS.get(kind, kind), fit_out)


def glaze(rng: np.random.Generator, building: Building, zone: Zone) -> None:
    """Fill the free parts of a zone's walls with windows, 0.2 m apart."""
    for side in ("north", "south", "east", "west"):
        for low, high in building.free_runs(zone, side, 0.2):
            width = float(rng.uniform(1.0, 1.6))
            for number in range(int((high - low) / (width + 0.2))):
                at = low + 0.1 + 0.5 * width + number * (width + 0.2)
                building.window(zone, side, at, width, int(rng.integers(0, 12)), float(rng.uniform(1.2, 2.2)))


@dataclass(frozen=True)
class Obstacle:
    """A box on the floor: centre (m), length and width (m), yaw (rad), height (m)."""

    x: float
    y: float
    length: float
    width: float
    yaw: float
    height: float

    def corners(self) -> NDArray[np.float64]:
        """Return the corners (4, 2) of the outline."""
        along = np.array([math.cos(self.yaw), math.sin(self.yaw)])
        across = np.array([-along[1], along[0]])
        signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
        half = np.stack([0.5 * self.length * along, 0.5 * self.width * across])
        return np.array([self.x, self.y]) + signs @ half


def things(world: World) -> tuple[NDArray[np.int32], OccupancyMask, NDArray[np.int32]]:
    """Find the free-standing objects of a world.

    An object is a connected region of the floor plan of ``OBJECT_M`` without the walls. Its surfaces lie completely in
    its cells, above the floor and below ``WALL_M``. Posters and skirting boards are on a wall and are no objects.

    Returns:
        Number of the object of each surface, (S,), 0 for none; the floor plan; the number of the object of each cell.
    """
    plan, walls = (world.occupied(low, high, _CELL_M) for low, high in (OBJECT_M, WALL_M))
    beside_walls = cv2.dilate(walls.cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, labels = cv2.connectedComponents((plan.cells & ~beside_walls).astype(np.uint8), connectivity=8)
    around = cv2.dilate(labels.astype(np.float32), np.ones((5, 5), np.uint8)).astype(np.int32)
    vertices = world.vertices.reshape(len(world.normal), -1, 3)
    row, column = plan.index(world.vertices[:, :2]).T
    inside = (row >= 0) & (row < around.shape[0]) & (column >= 0) & (column < around.shape[1])
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    own = np.where(inside, around[row, column], 0).reshape(vertices.shape[:2])
    on_wall = (inside & beside_walls[row, column]).reshape(own.shape).all(axis=1)
    high = vertices[..., 2].max(axis=1)
    # A box's sides begin on the floor; the floor itself does not rise.
    whole = (own == own[:, :1]).all(axis=1) & (high > 0.01) & (high < WALL_M[0]) & ~on_wall
    return np.where(whole, own[:, 0], 0), plan, labels


def moved_by(world: World, surfaces: NDArray[np.bool_], shift_m: NDArray[np.float64]) -> World:
    """Return the world with surfaces (S,) displaced by (3,) metres, together with their texture and light."""
    changed = {name: getattr(world, name).copy() for name in ("vertices", "offset", "uv", "light_uv", "light_linear")}
    by = shift_m.astype(np.float32)
    changed["vertices"].reshape(len(world.normal), -1, 3)[surfaces] += by
    changed["offset"][surfaces] += world.normal[surfaces] @ by
    for name in ("uv", "light_uv", "light_linear"):
        changed[name][surfaces, ..., 3] -= changed[name][surfaces, ..., :3] @ by
    return replace(world, **changed)


def without(world: World, obstacle: Obstacle) -> World:
    """Return the world without the object that stands at an obstacle's place; its shadow remains."""
    owner, plan, labels = things(world)
    outline = np.fliplr(plan.index(obstacle.corners())).astype(np.int32)
    place = cv2.dilate(cv2.fillConvexPoly(np.zeros(labels.shape, np.uint8), outline, 1), np.ones((3, 3), np.uint8))
    found = np.setdiff1d(np.unique(labels[place > 0]), [0])
    return moved_by(world, np.isin(owner, found), np.array([0.0, 0.0, -_AWAY_M]))


def path_poses(world: World, start: tuple[float, float, float], path: str, distances: Iterable[float]) -> list[Any]:
    """Return camera poses (4, 4) at straight-line distances from the start, looking along the path.

    The path ends at an obstacle. ``curve`` is an arc: the tightest free one of the radii and sides tried, else the one
    that reaches furthest.
    """
    mask = world.occupied(0.03, 1.9, 0.05)
    clearance = mask.distance_m()

    def free(pose: NDArray[np.float64]) -> bool:
        row, column = mask.index(pose[None, :2, 3])[0]
        inside = 0 <= row < clearance.shape[0] and 0 <= column < clearance.shape[1]
        return bool(inside and clearance[row, column] >= CLEARANCE_M)

    x, y, yaw = start
    origin = pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw)
    wanted = list(distances)

    def along(curvature: float) -> list[Any]:
        poses: list[Any] = []
        for distance in wanted:
            if curvature and abs(distance * curvature) >= 2:
                break
            turn = 2 * math.asin(distance * curvature / 2)
            ahead = math.sin(turn) / curvature if curvature else distance
            aside = (1 - math.cos(turn)) / curvature if curvature else 0.0
            pose = origin @ pose_matrix(ahead, aside, yaw=turn)
            if not free(pose):
                break
            poses.append(pose)
        return poses

    if path == "straight":
        return along(0.0)
    return max((along(side / radius) for radius in _RADII_M for side in (1, -1)), key=len)


def start_pose(world: World, seed: int = 0) -> tuple[float, float, float]:
    """Return the world's own start, or with a seed above 0 a random free one, facing the longest straight path.

    Raises:
        ValueError: the start is not free.
    """
    starts = [world.spawn]
    if seed:
        starts = [tuple(pose) for pose in world.sample_free_poses(np.random.default_rng([79, seed]), 4, 0.5).tolist()]
    candidates = [(x, y, yaw + k * math.pi / 4) for x, y, yaw in starts for k in range(8)]
    steps = np.arange(0, 4.01, 0.25)
    best = max(candidates, key=lambda pose: len(path_poses(world, pose, "straight", steps)))
    if not path_poses(world, best, "straight", [0.0]):
        raise ValueError(f"the world's own start ({best[0]:g}, {best[1]:g}) is not free: choose another world")
    return best
