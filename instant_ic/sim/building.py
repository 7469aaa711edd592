"""Worlds built from zones: rectangles of free space get floors, ceilings, walls, doorways and fittings."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from instant_ic.sim.lighting import bake
from instant_ic.sim.world import Material, World, WorldBuilder

Point = tuple[float, float]

#: Height of doorways and closed doors.
DOOR_M = 2.05


@dataclass(frozen=True)
class Finish:
    """Materials of a zone."""

    wall: Material = field(default_factory=lambda: Material("paint", 1.6))
    floor: Material = field(default_factory=lambda: Material("lino", 2.0))
    ceiling: Material = field(default_factory=lambda: Material("ceiling_tiles", 2.4))
    skirting: Material | None = field(default_factory=lambda: Material("wood", 1.0, (0.5, 0.5, 0.5)))
    trim: Material = field(default_factory=lambda: Material("wood", 1.0))


@dataclass(frozen=True)
class Zone:
    """A rectangle of free space from the floor to ``height``. Zones that touch have an opening between them."""

    x0: float
    y0: float
    x1: float
    y1: float
    height: float = 2.7
    finish: Finish = field(default_factory=Finish)
    doorway: bool = False

    @property
    def centre(self) -> Point:
        return 0.5 * (self.x0 + self.x1), 0.5 * (self.y0 + self.y1)

    def side(self, name: str) -> tuple[Point, Point]:
        """Return the ends of a wall, left to right as seen from inside; ``north`` is the wall at y1, ``east`` at x1."""
        return {
            "north": ((self.x0, self.y1), (self.x1, self.y1)),
            "south": ((self.x1, self.y0), (self.x0, self.y0)),
            "east": ((self.x1, self.y1), (self.x1, self.y0)),
            "west": ((self.x0, self.y0), (self.x0, self.y1)),
        }[name]

    def beyond(self, side: str, low: float, high: float, depth: float) -> tuple[float, float, float, float]:
        """Return the rectangle x0, y0, x1, y1 behind a wall, from ``low`` to ``high`` in x (north, south) or y."""
        return {
            "north": (low, self.y1, high, self.y1 + depth),
            "south": (low, self.y0 - depth, high, self.y0),
            "east": (self.x1, low, self.x1 + depth, high),
            "west": (self.x0 - depth, low, self.x0, high),
        }[side]


SIDES = ("north", "south", "east", "west")
INWARD_YAW = {"north": -math.pi / 2, "south": math.pi / 2, "east": math.pi, "west": 0.0}
"""Heading of a thing with its back to a wall."""


@dataclass
class Building:
    """Zones and their contents; ``world()`` builds the mesh."""

    zones: list[Zone] = field(default_factory=list)
    builder: WorldBuilder = field(default_factory=WorldBuilder)

    def add(self, zone: Zone) -> Zone:
        """Add a zone and return it."""
        self.zones.append(zone)
        return zone

    def door(self, room: Zone, side: str, at: float, thickness: float, width: float = 0.95) -> Zone:
        """Add a doorway through the wall on one side of ``room``; ``at`` is its centre in x (north, south) or y."""
        rect = room.beyond(side, at - width / 2, at + width / 2, thickness)
        trim = room.finish.trim
        finish = Finish(trim, room.finish.floor, trim, None, trim)
        return self.add(Zone(*rect, height=DOOR_M, finish=finish, doorway=True))

    def openings(self, zone: Zone, side: str) -> list[tuple[float, float, Zone]]:
        """Return the parts of a wall, in metres from its start, where another zone touches it."""
        start, end = zone.side(side)
        found = []
        along = np.sign(np.asarray(end) - np.asarray(start))
        length = math.dist(start, end)
        opposite = {"north": "south", "south": "north", "east": "west", "west": "east"}[side]
        axis = 1 if side in ("north", "south") else 0
        for other in self.zones:
            if other is zone:
                continue
            a, b = other.side(opposite)
            if abs(a[axis] - start[axis]) > 1e-6:
                continue
            s = sorted(float(np.dot(np.asarray(p) - np.asarray(start), along)) for p in (a, b))
            low, high = max(s[0], 0.0), min(s[1], length)
            if high - low > 1e-6:
                found.append((low, high, other))
        return sorted(found, key=lambda o: o[0])

    def free_runs(self, zone: Zone, side: str, margin: float = 0.15) -> list[tuple[float, float]]:
        """Return the parts of a wall without openings, shortened by ``margin`` at each end."""
        length = math.dist(*zone.side(side))
        runs, at = [], 0.0
        for low, high, _ in self.openings(zone, side):
            runs.append((at, low))
            at = high
        runs.append((at, length))
        return [(a + margin, b - margin) for a, b in runs if b - a > 2 * margin + 0.2]

    def relief(
        self,
        start: Point,
        end: Point,
        along: tuple[float, float],
        heights: tuple[float, float],
        depth: float,
        front: Material,
        edge: Material | None = None,
    ) -> None:
        """Add a board that protrudes by ``depth`` from the wall start → end, at the given lengths and heights."""
        edge = edge or front
        a, b = np.asarray(start, float), np.asarray(end, float)
        right = (b - a) / np.linalg.norm(b - a)
        # Inward is towards the viewer who sees the start of the wall on the left.
        inward = np.asarray([right[1], -right[0]])
        low, high = heights
        p, q = a + right * along[0], a + right * along[1]
        pf, qf = p + inward * depth, q + inward * depth
        z = np.asarray([0.0, 0.0, low - high])

        def at(point: np.ndarray, height: float) -> np.ndarray:
            return np.asarray([point[0], point[1], height])

        build = self.builder
        build.panel(at(pf, high), at(qf - pf, 0), z, front)
        build.panel(at(p, high), at(pf - p, 0), z, edge)
        build.panel(at(qf, high), at(q - qf, 0), z, edge)
        build.panel(at(p, high), at(q - p, 0), at(pf - p, 0), edge)
        if low > 0.005:
            build.panel(at(pf, low), at(qf - pf, 0), at(p - pf, 0), edge)

    def picture(
        self, zone: Zone, side: str, at: float, centre_m: float, size: tuple[float, float], material: Material
    ) -> None:
        """Add a poster or board to a wall, with its centre ``at`` metres from the wall's start."""
        start, end = zone.side(side)
        heights = (centre_m - size[1] / 2, centre_m + size[1] / 2)
        edge = Material("wood", 0.5, (0.4, 0.4, 0.4))
        self.relief(start, end, (at - size[0] / 2, at + size[0] / 2), heights, 0.012, replace(material, size_m=0), edge)

    def window(self, zone: Zone, side: str, at: float, width: float, variant: int, shine: float = 1.6) -> None:
        """Add a window with frame and sill, and a luminous image as the view outside."""
        start, end = zone.side(side)
        frame = Material("white", 1.0, (0.95, 0.95, 0.95))
        low, high = 0.9, min(zone.height - 0.3, 2.2)
        a, b = at - width / 2, at + width / 2
        self.relief(start, end, (a, b), (low, high), 0.02, Material(f"window:{variant}", 0, emission=shine), frame)
        self.relief(start, end, (a - 0.07, b + 0.07), (low - 0.05, low), 0.14, frame)
        self.relief(start, end, (a - 0.06, a), (low, high), 0.05, frame)
        self.relief(start, end, (b, b + 0.06), (low, high), 0.05, frame)
        self.relief(start, end, (a - 0.06, b + 0.06), (high, high + 0.06), 0.05, frame)

    def closed_door(self, zone: Zone, side: str, at: float, variant: int = 0, tint: Material | None = None) -> None:
        """Add a closed door: leaf and frame on the wall."""
        start, end = zone.side(side)
        leaf = replace(tint or Material("door"), texture=f"door:{variant}", size_m=0)
        self.relief(start, end, (at - 0.46, at + 0.46), (0.0, 2.02), 0.015, leaf, zone.finish.trim)
        self._frame(start, end, at - 0.46, at + 0.46, 2.02, zone.finish.trim)

    def _frame(self, start: Point, end: Point, low: float, high: float, top: float, trim: Material) -> None:
        self.relief(start, end, (low - 0.08, low), (0.0, top), 0.03, trim)
        self.relief(start, end, (high, high + 0.08), (0.0, top), 0.03, trim)
        self.relief(start, end, (low - 0.08, high + 0.08), (top, top + 0.08), 0.03, trim)

    def lamps(self, zone: Zone, spacing: float = 2.4, shine: float = 4.5, square: bool = False) -> None:
        """Add ceiling lights on a grid."""
        w, h = zone.x1 - zone.x0, zone.y1 - zone.y0
        nx, ny = max(1, round(w / spacing)), max(1, round(h / spacing))
        lx, ly = (0.6, 0.6) if square else ((1.2, 0.3) if w >= h else (0.3, 1.2))
        lx, ly = min(lx, 0.7 * w), min(ly, 0.7 * h)
        lamp = Material("lamp", 0.6, (1.0, 0.97, 0.90), emission=shine)
        for i in range(nx):
            for j in range(ny):
                x, y = zone.x0 + (i + 0.5) * w / nx, zone.y0 + (j + 0.5) * h / ny
                low = zone.height - 0.04
                self.builder.box((x, y), (lx + 0.04, ly + 0.04, 0.035), low, side=Material("metal", 0.5))
                self.builder.panel((x - lx / 2, y - ly / 2, low - 0.002), (lx, 0, 0), (0, ly, 0), lamp)

    def open_leaf(self, door: Zone, towards: str, hinge_high: bool, angle_deg: float, variant: int) -> None:
        """Add an open door leaf in the zone on the side ``towards`` (``north``...) of the doorway."""
        width = (door.x1 - door.x0) if towards in ("north", "south") else (door.y1 - door.y0)
        if towards in ("north", "south"):
            hinge = np.asarray([door.x1 if hinge_high else door.x0, door.y1 if towards == "north" else door.y0])
            closed = np.asarray([-1.0, 0.0]) if hinge_high else np.asarray([1.0, 0.0])
            open_to = np.asarray([0.0, 1.0 if towards == "north" else -1.0])
        else:
            hinge = np.asarray([door.x1 if towards == "east" else door.x0, door.y1 if hinge_high else door.y0])
            closed = np.asarray([0.0, -1.0]) if hinge_high else np.asarray([0.0, 1.0])
            open_to = np.asarray([1.0 if towards == "east" else -1.0, 0.0])
        angle = math.radians(angle_deg)
        direction = math.cos(angle) * closed + math.sin(angle) * open_to
        across = np.asarray([-direction[1], direction[0]])
        centre = hinge + direction * width / 2 + 0.045 * open_to
        yaw = math.atan2(across[1], across[0])
        face = Material(f"door:{variant}", 0)
        self._two_faced_box(centre, (0.04, width, DOOR_M - 0.03), yaw, face, door.finish.trim)

    def _two_faced_box(
        self, centre: np.ndarray, size: tuple[float, float, float], yaw: float, face: Material, edge: Material
    ) -> None:
        at = (float(centre[0]), float(centre[1]))
        self.builder.box(at, size, 0.0, yaw, side=edge, front=face)
        # The back also gets the door texture, on a panel just in front of the box.
        c, s = math.cos(yaw), math.sin(yaw)
        x, y = np.asarray([c, s, 0.0]), np.asarray([-s, c, 0.0])
        corner = np.asarray([*at, size[2]]) - x * (size[0] / 2 + 0.001) + y * size[1] / 2
        self.builder.panel(corner, -y * size[1], (0, 0, -size[2]), face)

    def world(self, name: str, spawn: tuple[float, float, float], light_cell_m: float = 0.1, rays: int = 48) -> World:
        """Build the world: mesh, textures and baked light."""
        for zone in self.zones:
            self._shell(zone)
        world = self.builder.build(name, light_cell_m, spawn)
        world.zones = [(z.x0, z.y0, z.x1, z.y1, z.height) for z in self.zones]
        bake(world, rays)
        return world

    def _shell(self, zone: Zone) -> None:
        f, build = zone.finish, self.builder
        w, h = zone.x1 - zone.x0, zone.y1 - zone.y0
        build.panel((zone.x0, zone.y1, 0), (w, 0, 0), (0, -h, 0), f.floor)
        build.panel((zone.x0, zone.y0, zone.height), (w, 0, 0), (0, h, 0), f.ceiling)
        for side in SIDES:
            self._wall(zone, side)

    def _wall(self, zone: Zone, side: str) -> None:
        start, end = zone.side(side)
        length = math.dist(start, end)
        right = (np.asarray(end) - np.asarray(start)) / length
        at = 0.0
        pieces: list[tuple[float, float, float]] = []
        for low, high, other in self.openings(zone, side):
            if low - at > 1e-6:
                pieces.append((at, low, 0.0))
            if other.height < zone.height - 1e-6:
                pieces.append((low, high, other.height))
            if other.doorway and not zone.doorway:
                self._frame(start, end, low, high, other.height, other.finish.trim)
            at = high
        if length - at > 1e-6:
            pieces.append((at, length, 0.0))
        for low, high, bottom in pieces:
            a, b = (np.asarray(start) + right * at for at in (low, high))
            self.builder.wall((a[0], a[1]), (b[0], b[1]), bottom, zone.height, zone.finish.wall)
            if bottom == 0.0 and zone.finish.skirting is not None:
                self.relief(start, end, (low, high), (0.0, 0.09), 0.014, zone.finish.skirting)
