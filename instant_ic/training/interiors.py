"""Generated interiors of many kinds for depth training.

``instant_ic.sim.worlds.random_world`` generates rooms and corridors with some furniture. This module adds the places
where a network trained on those alone fails: halls with pillars, glass fronts, display cases, rows of shelves, offices,
shops, and homes with plain walls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from instant_ic.sim import furniture, worlds
from instant_ic.sim.building import INWARD_YAW, SIDES, Building, Finish, Zone
from instant_ic.sim.world import Material, World, WorldBuilder

# Relative frequency of each kind.
KINDS: dict[str, float] = {
    "random": 0.30, "corridor": 0.12, "library": 0.10, "exhibition": 0.10, "canteen": 0.06, "office": 0.11,
    "store": 0.06, "home": 0.15,
}  # fmt: skip
_HALLS = ("library", "exhibition", "canteen", "office", "store")


def interior_world(seed: int, kind: str = "", light_cell_m: float = 0.45, rays: int = 12) -> World:
    """Return an interior of one of :data:`KINDS`; the same seed gives the same world.

    Args:
        seed: seed of the world.
        kind: one of :data:`KINDS`; empty: chosen at random by frequency.
        light_cell_m: size of a texel of the baked light, in metres.
        rays: number of rays per texel of the baked light.

    Raises:
        ValueError: unknown kind.
    """
    rng = np.random.default_rng([29, seed])
    drawn = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    kind = kind or drawn
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose one of {', '.join(KINDS)}")
    if kind == "random":
        return worlds.random_world(seed, light_cell_m, rays)
    building = Building()
    if kind in _HALLS:
        zones = _hall(rng, building, kind)
    elif kind == "home":
        zones = _home(rng, building)
    else:
        zones = worlds.plan(rng, building, str(rng.choice(["corridor", "corner", "crossing"])))
    glassy = rng.random() < (0.15 if kind == "home" else 0.35)
    for number, zone in enumerate(zones):
        floor = _Floor(building, zone)
        if number == 0 and glassy:
            _glass_front(rng, building, zone)
        _ceiling(rng, building, zone)
        worlds.decorate(rng, building, zone)
        theme = _THEMES[kind] if number == 0 or kind == "home" else _THEMES[str(rng.choice(["home", "office"]))]
        theme(rng, building.builder, floor)
        _clutter(rng, building.builder, floor)
    x, y = zones[0].centre
    world = building.world(f"{kind}:{seed}", (x, y, 0.0), light_cell_m, rays)
    world.light *= np.float32(rng.uniform(0.55, 1.3))
    return world


@dataclass
class _Floor:
    """Occupied parts of a zone's floor; the middle and the doorways stay free."""

    building: Building
    zone: Zone
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        zone = self.zone
        x, y = zone.centre
        self.taken.append((x - 0.7, y - 0.7, x + 0.7, y + 0.7))
        for side in SIDES:
            start, end = zone.side(side)
            for low, high, _ in self.building.openings(zone, side):
                share = np.asarray([low, high]) / math.dist(start, end)
                (x0, x1), (y0, y1) = (np.sort(a + share * (b - a)) for a, b in zip(start, end, strict=True))
                self.taken.append((x0 - 0.5, y0 - 0.5, x1 + 0.5, y1 + 0.5))

    def take(self, centre: tuple[float, float], size: tuple[float, float], margin: float = 0.0) -> bool:
        """Reserve a rectangle if it lies inside the zone and is free; return whether it was reserved.

        Args:
            centre: x and y in metres.
            size: extent along x and y in metres.
            margin: distance from occupied parts in metres.
        """
        x0, y0, x1, y1 = (centre[0] - size[0] / 2, centre[1] - size[1] / 2,
                          centre[0] + size[0] / 2, centre[1] + size[1] / 2)  # fmt: skip
        z = self.zone
        if x0 < z.x0 + 0.02 or y0 < z.y0 + 0.02 or x1 > z.x1 - 0.02 or y1 > z.y1 - 0.02:
            return False
        if any(x0 - margin < b and a < x1 + margin and y0 - margin < d and c < y1 + margin
               for a, c, b, d in self.taken):  # fmt: skip
            return False
        self.taken.append((x0, y0, x1, y1))
        return True

    def wall_place(
        self, rng: np.random.Generator, size: tuple[float, float], gap: float = 0.04
    ) -> tuple[tuple[float, float], float] | None:
        """Find a free place with its back to a wall: centre, yaw. ``size`` is (depth from the wall, width along it)."""
        z = self.zone
        for _ in range(6):
            side = str(rng.choice(SIDES))
            along_x = side in ("north", "south")
            width = z.x1 - z.x0 if along_x else z.y1 - z.y0
            if width < size[1] + 0.2:
                continue
            at = rng.uniform(size[1] / 2 + 0.05, width - size[1] / 2 - 0.05)
            away = size[0] / 2 + gap
            x = z.x0 + at if along_x else (z.x0 + away if side == "west" else z.x1 - away)
            y = z.y0 + at if not along_x else (z.y0 + away if side == "south" else z.y1 - away)
            extent = (size[1], size[0]) if along_x else size
            if self.take((x, y), extent):
                return (float(x), float(y)), INWARD_YAW[side]
        return None


def _tinted(rng: np.random.Generator, names: tuple[str, ...], lowest: float = 0.3, size: float = 0.9) -> Material:
    return Material(str(rng.choice(names)), size, worlds.tint(rng, lowest))


def _plain_finish(rng: np.random.Generator) -> Finish:
    """Return nearly white walls and ceiling with little texture, as in most real interiors."""
    shade = float(rng.uniform(0.85, 1.12))
    wall = Material(str(rng.choice(["white", "paint", "paint:4"])), float(rng.uniform(1.5, 3)), (shade,) * 3)
    base = worlds.random_finish(rng)
    return replace(base, wall=wall, ceiling=replace(wall, tint=(min(shade * 1.05, 1.15),) * 3))


def _finish(rng: np.random.Generator, plain: float) -> Finish:
    return _plain_finish(rng) if rng.random() < plain else worlds.random_finish(rng)


def _hall(rng: np.random.Generator, building: Building, kind: str) -> list[Zone]:
    """Add a large room, often with pillars, sometimes open to a second one of different height."""
    u = rng.uniform
    width, depth = float(u(7, 22)), float(u(6, 16))
    height = float(u(2.6, 6.0) if kind == "store" or rng.random() < 0.3 else u(2.5, 3.6))
    finish = _finish(rng, 0.6)
    first = building.add(Zone(-width / 2, -depth / 2, width / 2, depth / 2, height, finish))
    zones = [first]
    if rng.random() < 0.4:
        low = float(u(-depth / 2, 0))
        high = float(u(low + 2, depth / 2 + 3))
        zones.append(building.add(Zone(width / 2, low, width / 2 + float(u(3, 9)), high,
                                       float(max(2.3, height + u(-0.8, 0.8))), finish)))  # fmt: skip
    for side in rng.permutation(["north", "south", "west"])[: int(rng.integers(0, 3))]:
        zones.append(worlds.side_room(rng, building, first, str(side), float(u(0.1, 0.3))))
    if rng.random() < 0.5 and min(width, depth) > 6:
        _pillars(rng, building.builder, first)
    return zones


def _home(rng: np.random.Generator, building: Building) -> list[Zone]:
    """Add a living room with up to three rooms behind doors."""
    u = rng.uniform
    finish = _finish(rng, 0.75)
    w, d, h = float(u(3, 8)), float(u(3, 6.5)), float(u(2.3, 3.0))
    first = building.add(Zone(-w / 2, -d / 2, w / 2, d / 2, h, finish))
    zones = [first]
    for side in rng.permutation(list(SIDES))[: int(rng.integers(1, 4))]:
        zones.append(worlds.side_room(rng, building, first, str(side), float(u(0.08, 0.25))))
    return zones


def _pillars(rng: np.random.Generator, build: WorldBuilder, zone: Zone) -> None:
    pitch = float(rng.uniform(3.0, 6.0))
    material = zone.finish.wall if rng.random() < 0.7 else _tinted(rng, ("concrete", "white", "metal"), 0.5, 1.5)
    round_one, radius = rng.random() < 0.5, float(rng.uniform(0.15, 0.4))
    off_x, off_y = rng.uniform(0.8, pitch, 2)
    for x in np.arange(zone.x0 + off_x, zone.x1 - 0.6, pitch):
        for y in np.arange(zone.y0 + off_y, zone.y1 - 0.6, pitch):
            if math.hypot(x - zone.centre[0], y - zone.centre[1]) < 1.2:
                continue
            if not round_one:
                build.box((float(x), float(y)), (2 * radius, 2 * radius, zone.height), side=material)
                continue
            angle = np.linspace(0, 2 * math.pi, 13)
            ring = [(float(x + radius * math.cos(a)), float(y + radius * math.sin(a))) for a in angle]
            for a, b in pairwise(ring):
                build.wall(a, b, 0.0, zone.height, material)


def _glass_front(rng: np.random.Generator, building: Building, zone: Zone) -> None:
    """Add one or two walls of panes from near the floor to near the ceiling, often brighter than the image range."""
    frame = _tinted(rng, ("white", "metal"), 0.2, 0.6)
    variant, shine = int(rng.integers(0, 24)), float(rng.uniform(0.9, 4.0))
    bottom, top = float(rng.choice([0.05, 0.4, 0.9])), zone.height - float(rng.uniform(0.08, 0.7))
    pane = float(rng.uniform(0.9, 2.6))
    for side in rng.permutation(list(SIDES))[: int(rng.integers(1, 3))]:
        start, end = zone.side(str(side))
        for low, high in building.free_runs(zone, str(side), 0.1):
            count = max(1, round((high - low) / pane))
            edges = np.linspace(low, high, count + 1)
            for index, (a, b) in enumerate(pairwise(edges.tolist())):
                glass = Material(f"window:{(variant + index) % 24}", 0, emission=shine)
                building.relief(start, end, (a + 0.03, b - 0.03), (bottom, top), 0.01, glass, frame)
                building.relief(start, end, (a - 0.03, a + 0.03), (bottom, top), 0.06, frame)
            building.relief(start, end, (low, high), (bottom - 0.05, bottom), 0.08, frame)


def _ceiling(rng: np.random.Generator, building: Building, zone: Zone) -> None:
    """Add lamps in the ceiling, rows of strips or pendants; sometimes beams and ducts below it."""
    build, u = building.builder, rng.uniform
    w, d = zone.x1 - zone.x0, zone.y1 - zone.y0
    style, shine = rng.random(), float(u(2.0, 7.0))
    lamp = Material("lamp", 0.6, (1.0, float(u(0.9, 1.0)), float(u(0.75, 1.0))), emission=shine)
    if style < 0.5:
        building.lamps(zone, float(u(1.8, 4.0)), shine, bool(rng.random() < 0.5))
    elif style < 0.75:
        width, low = float(u(0.08, 0.25)), zone.height - float(u(0.03, 0.5))
        for y in np.arange(zone.y0 + u(0.5, 1.5), zone.y1 - 0.3, u(1.5, 3.5)):
            build.panel(np.asarray([zone.x0 + 0.1 * w, y, low]), np.asarray([0.8 * w, 0, 0]),
                        np.asarray([0, width, 0]), lamp)  # fmt: skip
            build.box((0.5 * (zone.x0 + zone.x1), float(y) + width / 2), (0.8 * w, width, 0.04), low + 0.002,
                      side=Material("white", 0.5))  # fmt: skip
    else:
        for _ in range(max(1, int(w * d / 10))):
            x, y = float(u(zone.x0 + 0.3, zone.x1 - 0.3)), float(u(zone.y0 + 0.3, zone.y1 - 0.3))
            low = max(2.0, zone.height - float(u(0.2, 0.9)))
            if low < zone.height - 0.2:
                build.box((x, y), (0.3, 0.3, 0.15), low, side=replace(lamp, emission=0.6 * shine))
                build.box((x, y), (0.02, 0.02, zone.height - low - 0.15), low + 0.15, side=Material("metal", 0.3))
    if rng.random() < 0.25 and zone.height > 2.6:
        thick, deep = float(u(0.15, 0.4)), float(u(0.15, 0.45))
        material = _tinted(rng, ("concrete", "wood", "white", "metal"), 0.4, 1.2)
        along_x = rng.random() < 0.5
        for s in np.arange(u(0.5, 2.0), (d if along_x else w) - 0.4, u(1.5, 4.0)):
            at = (zone.centre[0], zone.y0 + float(s)) if along_x else (zone.x0 + float(s), zone.centre[1])
            size = (w - 0.02, thick, deep) if along_x else (thick, d - 0.02, deep)
            build.box(at, size, zone.height - deep, side=material)


def _show_case(rng: np.random.Generator, build: WorldBuilder, at: tuple[float, float], yaw: float,
               size: tuple[float, float]) -> None:  # fmt: skip
    """Add a glass case on a base: its posts and contents are visible, and so is the room behind it."""
    base, top = float(rng.uniform(0.2, 0.9)), float(rng.uniform(1.1, 2.2))
    wood, post = _tinted(rng, ("wood", "white", "metal"), 0.3), _tinted(rng, ("metal", "white"), 0.3, 0.4)
    build.box(at, (*size, base), 0.0, yaw, side=wood, top=_tinted(rng, ("white", "fabric"), 0.3, 0.5))
    c, s = math.cos(yaw), math.sin(yaw)

    def placed(x: float, y: float) -> tuple[float, float]:
        return at[0] + c * x - s * y, at[1] + s * x + c * y

    for i in (-1, 1):
        for j in (-1, 1):
            build.box(placed(i * (size[0] / 2 - 0.015), j * (size[1] / 2 - 0.015)), (0.03, 0.03, top - base), base, yaw,
                      side=post)  # fmt: skip
        build.box(placed(i * (size[0] / 2 - 0.015), 0.0), (0.03, size[1], 0.03), top, yaw, side=post)
        build.box(placed(0.0, i * (size[1] / 2 - 0.015)), (size[0], 0.03, 0.031), top, yaw, side=post)
    for _ in range(int(rng.integers(1, 5))):
        tall = float(rng.uniform(0.05, 0.8 * (top - base)))
        a = placed(*(rng.uniform(-0.35, 0.35, 2) * size))
        thing = (float(rng.uniform(0.05, 0.25)), float(rng.uniform(0.05, 0.25)), tall)
        material = _tinted(rng, ("wood", "metal", "fabric", "white"), 0.1, 0.4)
        build.box(a, thing, base + 0.002, float(rng.uniform(0, 3)), side=material)


def _desk(rng: np.random.Generator, build: WorldBuilder, at: tuple[float, float], yaw: float) -> None:
    """Add a desk with a screen, and its chair at the desk's own +x."""
    furniture.table(build, at, yaw + math.pi / 2, (float(rng.uniform(1.2, 1.8)), 0.75), _tinted(rng, ("wood", "white")))
    c, s = math.cos(yaw), math.sin(yaw)
    dark = Material("metal", 0.4, (0.12, 0.12, 0.13))
    build.box((at[0] - 0.18 * c, at[1] - 0.18 * s), (0.05, float(rng.uniform(0.4, 0.7)), 0.38), 0.82, yaw, side=dark)
    build.box((at[0] - 0.18 * c, at[1] - 0.18 * s), (0.15, 0.2, 0.08), 0.741, yaw, side=dark)
    if rng.random() < 0.8:
        furniture.chair(build, (at[0] + 0.65 * c, at[1] + 0.65 * s), yaw + math.pi + float(rng.normal(0, 0.4)),
                        _tinted(rng, ("fabric",), 0.1, 0.5))  # fmt: skip


def _grid(rng: np.random.Generator, floor: _Floor, pitch: tuple[float, float]) -> list[tuple[float, float]]:
    zone = floor.zone
    xs = np.arange(zone.x0 + rng.uniform(0.6, 1.6), zone.x1 - 0.6, pitch[0])
    ys = np.arange(zone.y0 + rng.uniform(0.6, 1.6), zone.y1 - 0.6, pitch[1])
    return [(float(x), float(y)) for x in xs for y in ys]


def _library(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    along_x = rng.random() < 0.5
    pitch, length, height = float(rng.uniform(1.9, 3.0)), int(rng.integers(2, 6)), float(rng.uniform(1.1, 2.3))
    variant, fill = int(rng.integers(0, 30)), float(rng.uniform(0.3, 0.9))
    steps = (length + 1.5, pitch) if along_x else (pitch, length + 1.5)
    for x, y in _grid(rng, floor, steps):
        size = (float(length), 0.68) if along_x else (0.68, float(length))
        if rng.random() > fill or not floor.take((x, y), size, 0.1):
            continue
        for k in range(length):
            s = k + 0.5 - length / 2
            for sign in (-1, 1):
                variant += 1
                at = (x + s, y + sign * 0.17) if along_x else (x + sign * 0.17, y + s)
                yaw = sign * math.pi / 2 if along_x else (0.0 if sign > 0 else math.pi)
                furniture.bookcase(build, at, yaw, variant % 30, min(height, floor.zone.height - 0.1))
    _office(rng, build, floor, 0.3)


def _exhibition(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    for x, y in _grid(rng, floor, (float(rng.uniform(2.0, 3.6)), float(rng.uniform(2.0, 3.6)))):
        if rng.random() < 0.45:
            continue
        w, d = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.6, 2.0))
        turned = rng.random() < 0.5
        if floor.take((x, y), (w, d) if not turned else (d, w), 0.3):
            _show_case(rng, build, (x, y), math.pi / 2 if turned else 0.0, (w, d))
    for _ in range(int(rng.integers(0, 5))):
        place = floor.wall_place(rng, (0.6, 1.4))
        if place:
            _show_case(rng, build, *place, (0.6, 1.4))


def _canteen(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    top, seat = _tinted(rng, ("wood", "white")), _tinted(rng, ("fabric", "wood"), 0.2, 0.5)
    for x, y in _grid(rng, floor, (float(rng.uniform(2.0, 3.2)), float(rng.uniform(1.8, 3.0)))):
        if rng.random() < 0.2 or not floor.take((x, y), (1.5, 1.7), 0.1):
            continue
        furniture.table(build, (x, y), 0.0, (1.4, 0.7), top)
        for dx, dy in ((-0.35, 0.6), (0.35, 0.6), (-0.35, -0.6), (0.35, -0.6)):
            if rng.random() < 0.8:
                turn = -math.copysign(math.pi / 2, dy) + float(rng.normal(0, 0.2))
                furniture.chair(build, (x + dx, y + dy), turn, seat)


def _office(rng: np.random.Generator, build: WorldBuilder, floor: _Floor, share: float = 0.8) -> None:
    partition = rng.random() < 0.4
    cloth = _tinted(rng, ("fabric", "white"), 0.3)
    for x, y in _grid(rng, floor, (float(rng.uniform(2.2, 3.4)), float(rng.uniform(1.9, 2.8)))):
        if rng.random() > share or not floor.take((x, y), (2.0, 1.8), 0.05):
            continue
        _desk(rng, build, (x, y), float(rng.choice([0.0, math.pi])))
        if partition:
            build.box((x, y + 0.95), (1.7, 0.05, float(rng.uniform(1.1, 1.6))), side=cloth)
    for _ in range(int(rng.integers(0, 4))):
        place = floor.wall_place(rng, (0.45, 1.2))
        if place:
            furniture.cabinet(build, *place, (0.45, 1.2, float(rng.uniform(0.7, 2.0))),
                              _tinted(rng, ("metal", "wood", "white"), 0.4))  # fmt: skip


def _store(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    metal = _tinted(rng, ("metal",), 0.3)
    height = min(float(rng.uniform(1.8, 4.5)), floor.zone.height - 0.2)
    for x, y in _grid(rng, floor, (float(rng.uniform(3.4, 5.0)), float(rng.uniform(2.2, 3.4)))):
        if rng.random() < 0.3:
            if floor.take((x, y), (1.2, 1.2), 0.2):
                furniture.boxes(build, (x - 0.25, y), rng)
                furniture.boxes(build, (x + 0.3, y + 0.2), rng)
            continue
        if not floor.take((x, y), (2.4, 0.8), 0.2):
            continue
        for i in (-1.17, 1.17):
            for j in (-0.37, 0.37):
                build.box((x + i, y + j), (0.06, 0.06, height), side=metal)
        for low in np.arange(0.1, height - 0.3, float(rng.uniform(0.5, 0.9))):
            build.box((x, y), (2.4, 0.8, 0.04), float(low), side=metal)
            for s in np.arange(-0.95, 1.0, 0.48):
                if rng.random() < 0.6:
                    size = (
                        float(rng.uniform(0.25, 0.44)),
                        float(rng.uniform(0.3, 0.6)),
                        float(rng.uniform(0.15, 0.42)),
                    )
                    box = Material("cardboard", 0) if rng.random() < 0.7 else _tinted(rng, ("white", "metal", "wood"))
                    build.box((x + float(s), y), size, float(low) + 0.041, side=box)


def _room(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    """Add furniture of homes, mostly along the walls: bed, sofa, wardrobe, kitchen row, table."""
    height = floor.zone.height
    if rng.random() < 0.5:
        x, y = floor.zone.centre
        size = rng.uniform(0.8, 2.4, 2)
        build.box((x + float(rng.uniform(-0.5, 0.5)), y), (float(size[0]), float(size[1]), 0.008),
                  side=_tinted(rng, ("carpet", "fabric"), 0.2))  # fmt: skip
    for name in rng.permutation(["bed", "sofa", "wardrobe", "kitchen", "screen", "shelf", "table", "dresser"])[:6]:
        cloth, wood = _tinted(rng, ("fabric",), 0.2, 0.6), _tinted(rng, ("wood", "white"), 0.4)
        if name == "bed" and (place := floor.wall_place(rng, (2.0, 1.5))):
            (x, y), yaw = place
            c, s = math.cos(yaw), math.sin(yaw)
            build.box((x, y), (2.0, 1.5, float(rng.uniform(0.35, 0.6))), 0.0, yaw, side=cloth)
            build.box((x - 0.97 * c, y - 0.97 * s), (0.06, 1.5, float(rng.uniform(0.7, 1.2))), 0.0, yaw, side=wood)
            build.box((x - 0.7 * c, y - 0.7 * s), (0.4, 1.2, 0.14), 0.55, yaw, side=Material("white", 0.5))
        elif name == "sofa" and (place := floor.wall_place(rng, (0.9, 2.0))):
            furniture.sofa(build, *place, cloth, float(rng.uniform(1.2, 2.0)))
        elif name == "wardrobe" and (place := floor.wall_place(rng, (0.6, 1.8))):
            furniture.cabinet(build, *place, (0.6, float(rng.uniform(0.9, 1.8)), min(2.1, height - 0.1)), wood)
        elif name == "kitchen" and (place := floor.wall_place(rng, (0.62, 2.4))):
            (x, y), yaw = place
            c, s = math.cos(yaw), math.sin(yaw)
            build.box(
                (x, y), (0.6, 2.4, 0.9), 0.0, yaw, side=wood, top=_tinted(rng, ("concrete", "white", "wood"), 0.2)
            )
            build.box((x - 0.14 * c, y - 0.14 * s), (0.33, 2.4, 0.65), 1.45, yaw, side=wood)
        elif name == "screen" and (place := floor.wall_place(rng, (0.45, 1.6))):
            (x, y), yaw = place
            build.box((x, y), (0.4, 1.6, 0.5), 0.0, yaw, side=wood)
            build.box((x, y), (0.06, 1.2, 0.7), 0.55, yaw, side=Material("metal", 0.5, (0.06, 0.06, 0.07)))
        elif name == "shelf" and (place := floor.wall_place(rng, (0.34, 1.02))):
            furniture.bookcase(build, *place, int(rng.integers(0, 30)), min(height - 0.1, float(rng.uniform(0.9, 2.2))))
        elif name == "dresser" and (place := floor.wall_place(rng, (0.5, 1.2))):
            furniture.cabinet(build, *place, (0.48, 1.2, float(rng.uniform(0.6, 1.1))), wood)
        elif name == "table":
            z = floor.zone
            at = float(rng.uniform(z.x0, z.x1)), float(rng.uniform(z.y0, z.y1))
            if floor.take(at, (1.6, 1.8), 0.1):
                furniture.table(build, at, 0.0, (1.3, 0.8), wood)
                for side in (-1, 1):
                    furniture.chair(build, (at[0], at[1] + 0.62 * side), -side * math.pi / 2, cloth)


def _corridor(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    """Add benches, machines, radiators and pipes along the walls."""
    zone = floor.zone
    for _ in range(int(rng.integers(0, 6))):
        size = (float(rng.uniform(0.1, 0.45)), float(rng.uniform(0.3, 1.6)))
        if (place := floor.wall_place(rng, size, 0.01)) is None:
            continue
        tall = float(rng.choice([0.45, 0.8, 1.2, 1.9]))
        build.box(place[0], (*size, min(tall, zone.height - 0.3)), 0.0, place[1],
                  side=_tinted(rng, ("wood", "metal", "white", "fabric"), 0.15))  # fmt: skip
    if rng.random() < 0.3:
        w, d = zone.x1 - zone.x0, zone.y1 - zone.y0
        duct = (w - 0.02, 0.2, 0.12) if w > d else (0.2, d - 0.02, 0.12)
        build.box((zone.centre[0] + 0.3 * (w < d), zone.centre[1] + 0.3 * (w > d)), duct, zone.height - 0.3,
                  side=_tinted(rng, ("metal", "white"), 0.3))  # fmt: skip


def _clutter(rng: np.random.Generator, build: WorldBuilder, floor: _Floor) -> None:
    """Add bins, plants, boxes, bags and person-high objects at random free places."""
    zone = floor.zone
    area = (zone.x1 - zone.x0) * (zone.y1 - zone.y0)
    for _ in range(int(rng.poisson(0.04 * area + 0.3))):
        at = float(rng.uniform(zone.x0, zone.x1)), float(rng.uniform(zone.y0, zone.y1))
        if not floor.take(at, (0.5, 0.5), 0.35):
            continue
        yaw, kind = float(rng.uniform(0, 6.3)), rng.random()
        if kind < 0.3:
            furniture.boxes(build, at, rng)
        elif kind < 0.5:  # a plant
            build.box(at, (0.3, 0.3, 0.3), 0.0, yaw, side=_tinted(rng, ("brick", "white", "concrete"), 0.2, 0.4))
            leaf = Material("fabric", 0.2, (0.18, 0.4, 0.14))
            for k in range(4):
                build.box(at, (0.03, 0.5, float(rng.uniform(0.4, 1.1))), 0.3, yaw + 0.8 * k, side=leaf)
        elif kind < 0.7:  # a standing person
            build.box(at, (0.22, 0.32, 0.85), 0.0, yaw, side=_tinted(rng, ("fabric",), 0.05, 0.5))
            build.box(at, (0.25, 0.48, 0.6), 0.851, yaw, side=_tinted(rng, ("fabric",), 0.05, 0.5))
            build.box(at, (0.2, 0.16, 0.25), 1.48, yaw, side=Material("white", 0.4, (0.8, 0.6, 0.5)))
        else:
            size = (float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.2, 1.3)))
            build.box(
                at, size, 0.0, yaw, side=_tinted(rng, ("metal", "white", "wood", "fabric", "cardboard"), 0.1, 0.5)
            )


_THEMES: dict[str, Callable[[np.random.Generator, WorldBuilder, _Floor], None]] = {
    "library": _library, "exhibition": _exhibition, "canteen": _canteen, "office": _office, "store": _store,
    "home": _room, "corridor": _corridor,
}  # fmt: skip
