"""Worlds: the corridor of the experiments, random interiors for training, and meshes from files."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from instant_ic.sim import furniture
from instant_ic.sim.building import INWARD_YAW, SIDES, Building, Finish, Point, Zone
from instant_ic.sim.mesh_files import load_world
from instant_ic.sim.world import Material, World, WorldBuilder

__all__ = ["World", "corridor_world", "load_world", "long_world", "make_world", "random_world"]

_WALL_M = 0.16


def corridor_world(seed: int = 0, obstacle: bool = True, light_cell_m: float = 0.1) -> World:
    """Make an L-shaped office corridor with side rooms, and the white obstacle of the experiments.

    The corridor is 2.4 m wide and 2.7 m high. It runs 14 m along x from x = -2, then 9 m along +y at its far end. The
    robot starts at the origin and faces +x. The obstacle is a box of 0.5 x 0.5 x 0.8 m, nearly in the colour of the
    walls. It is in the middle with its front 4 m ahead, which leaves 0.95 m free on either side.

    Args:
        seed: seed of the posters on the walls and the contents of the rooms; the floor plan is always the same.
        obstacle: include the obstacle.
        light_cell_m: resolution of the baked light.
    """
    rng = np.random.default_rng([11, seed])
    trim = Material("wood", 1.2, (0.95, 0.95, 0.95))
    hall = Finish(
        Material("paint", 1.6, (1.0, 0.985, 0.95)), Material("lino", 2.4), skirting=Material("wood", 1.0, (0.45,) * 3),
        trim=trim,
    )  # fmt: skip
    building = Building()
    arm = building.add(Zone(-2.0, -1.2, 12.0, 1.2, finish=hall))
    turn = building.add(Zone(9.6, 1.2, 12.0, 10.2, finish=hall))

    office = replace(hall, wall=Material("paint:1", 1.6, (0.90, 0.95, 1.0)), floor=Material("carpet", 2.0))
    library = replace(hall, wall=Material("paint:2", 1.6, (1.0, 0.90, 0.74)), floor=Material("planks", 2.4))
    store = replace(hall, wall=Material("blocks", 2.2), floor=Material("concrete", 2.4))
    kitchen = replace(hall, wall=Material("paint:3", 1.6, (0.84, 0.96, 0.82)), floor=Material("floor_tiles", 2.4))
    lounge = replace(hall, wall=Material("wallpaper", 1.6, (1.0, 0.94, 0.86)), floor=Material("planks:1", 2.4))

    rooms = {
        "office": building.add(Zone(-1.6, -5.4, 3.6, -1.2 - _WALL_M, finish=office)),
        "store": building.add(Zone(4.2, -4.9, 9.4, -1.2 - _WALL_M, finish=store)),
        "library": building.add(Zone(0.6, 1.2 + _WALL_M, 6.2, 5.4, finish=library)),
        "lounge": building.add(Zone(12.0 + _WALL_M, 3.6, 16.8, 8.6, finish=lounge)),
        "kitchen": building.add(Zone(5.0, 6.0, 9.6 - _WALL_M, 10.0, finish=kitchen)),
    }
    doors = (
        (building.door(arm, "south", 1.7, _WALL_M), "south", True, 98.0),
        (building.door(arm, "south", 6.9, _WALL_M), "south", False, 105.0),
        (building.door(arm, "north", 3.0, _WALL_M), "north", False, 94.0),
        (building.door(turn, "east", 5.6, _WALL_M), "east", True, 100.0),
        (building.door(turn, "west", 8.2, _WALL_M), "west", False, 97.0),
    )
    for number, (door, towards, high, angle) in enumerate(doors):
        building.open_leaf(door, towards, high, angle, number % 3)

    _fit_out_corridor(building, arm, turn, rng, seed)
    for zone in (arm, turn):
        building.lamps(zone, 2.4)
    for zone in rooms.values():
        building.lamps(zone, 2.2, square=True)
    _radiator(building, arm, "north", 11.1)
    _bin(building, (-1.6, 0.95))
    _bin(building, (11.75, -0.9))

    _furnish_corridor_rooms(building, rooms, rng, seed)
    if obstacle:
        building.builder.box((4.25, 0.0), (0.5, 0.5, 0.8), side=Material("white", 0.7, (1.0, 0.99, 0.965)))
    return building.world("corridor", (0.0, 0.0, 0.0), light_cell_m)


def _fit_out_corridor(building: Building, arm: Zone, turn: Zone, rng: np.random.Generator, seed: int) -> None:
    """Add closed doors along the corridor, windows at its ends, and posters between them."""
    building.closed_door(arm, "north", 8.7, 1)
    building.closed_door(arm, "north", 10.2, 2)
    building.closed_door(arm, "south", 2.2, 0)
    building.closed_door(turn, "east", 7.6, 1)
    building.closed_door(turn, "west", 1.6, 2)
    building.window(turn, "north", 1.2, 1.4, seed)
    building.window(arm, "west", 1.2, 1.3, seed + 1)
    for side, at, size in (
        ("north", 1.3, (0.5, 0.7)), ("north", 3.5, (0.6, 0.85)), ("north", 6.9, (0.6, 0.85)),
        ("south", 12.6, (0.6, 0.85)), ("south", 8.2, (0.5, 0.7)), ("south", 6.6, (0.6, 0.85)),
    ):  # fmt: skip
        variant = int(rng.integers(0, 24))
        building.picture(arm, side, at, 1.5, size, Material(f"poster:{variant}"))
    building.picture(arm, "south", 4.0, 1.5, (1.4, 0.8), Material(f"notices:{seed % 4}"))
    building.picture(arm, "east", 1.2, 1.55, (0.85, 1.2), Material(f"poster:{int(rng.integers(24, 40))}"))
    for side, at in (("east", 2.2), ("west", 3.6), ("west", 5.4), ("east", 6.2)):
        building.picture(turn, side, at, 1.5, (0.6, 0.85), Material(f"poster:{int(rng.integers(0, 24))}"))
    building.picture(turn, "east", 3.4, 1.5, (1.2, 0.7), Material(f"notices:{(seed + 1) % 4}"))


def _radiator(building: Building, zone: Zone, side: str, at: float) -> None:
    start, end = zone.side(side)
    white = Material("white", 0.6)
    building.relief(start, end, (at - 0.5, at + 0.5), (0.15, 0.7), 0.05, white)
    for k in range(10):
        low = at - 0.48 + k * 0.1
        building.relief(start, end, (low, low + 0.06), (0.17, 0.68), 0.075, white)


def _bin(building: Building, centre: tuple[float, float]) -> None:
    grey = Material("metal", 0.4, (0.35, 0.42, 0.5))
    building.builder.box(centre, (0.28, 0.28, 0.55), side=grey, top=Material("white", 0.4, (0.1, 0.1, 0.1)))


def _furnish_corridor_rooms(building: Building, rooms: dict[str, Zone], rng: np.random.Generator, seed: int) -> None:
    build = building.builder
    half = math.pi / 2
    office, store, library = rooms["office"], rooms["store"], rooms["library"]
    building.window(office, "south", 2.6, 1.8, seed + 2)
    building.window(store, "south", 2.6, 1.4, seed + 3)
    building.window(library, "north", 2.8, 2.2, seed + 4)
    building.window(rooms["lounge"], "east", 2.5, 2.4, seed + 5)
    building.window(rooms["kitchen"], "north", 2.2, 1.6, seed + 6)
    furniture.table(build, (0.2, -4.4), 0.0, (1.6, 0.8))
    furniture.chair(build, (0.2, -3.75), -half)
    furniture.table(build, (-0.9, -2.6), half, (1.4, 0.7), Material("white", 0.8, (0.9, 0.9, 0.9)))
    furniture.cabinet(build, (3.3, -3.6), math.pi, (0.45, 1.2, 1.7), Material("metal", 0.8))
    building.picture(office, "west", 2.0, 1.5, (1.2, 0.8), Material("notices:2"))
    for y in (-4.3, -3.2, -2.1):
        furniture.boxes(build, (8.9, y), rng)
    furniture.boxes(build, (4.7, -4.3), rng)
    furniture.cabinet(build, (4.5, -3.0), 0.0, (0.5, 1.0, 1.9), Material("metal", 0.8, (0.6, 0.75, 0.7)))
    for number, y in enumerate((2.4, 3.4, 4.4)):
        furniture.bookcase(build, (6.02, y), math.pi, number)
    for number, x in enumerate((1.2, 2.2)):
        furniture.bookcase(build, (x, 5.2), -half, 3 + number)
    furniture.table(build, (3.6, 4.2), 0.15, (1.6, 0.9))
    furniture.chair(build, (3.5, 3.5), half)
    furniture.sofa(build, (13.0, 8.1), -half, Material("fabric", 0.5, (0.75, 0.3, 0.25)))
    furniture.table(build, (14.2, 6.4), 0.0, (1.0, 0.6))
    building.picture(rooms["lounge"], "north", 2.6, 1.6, (1.1, 0.8), Material("poster:33"))
    furniture.cabinet(build, (6.4, 9.65), -half, (0.6, 2.2, 0.9), Material("white", 0.8, (0.85, 0.9, 0.95)))
    furniture.cabinet(build, (5.35, 7.2), 0.0, (0.65, 0.7, 1.85), Material("white", 0.8))
    furniture.table(build, (7.2, 7.4), 0.0, (1.2, 0.8), Material("wood:1", 0.8))
    furniture.chair(build, (7.2, 6.75), half, Material("wood", 0.5))


# --- random interiors -----------------------------------------------------------------------------------------------

_WALLS = ("paint", "paint:1", "paint:2", "roughcast", "wallpaper", "brick", "blocks", "concrete")
_FLOORS = ("lino", "lino:1", "planks", "planks:1", "carpet", "floor_tiles", "floor_tiles:1", "concrete")
_CEILINGS = ("ceiling_tiles", "paint", "white", "roughcast")


def tint(rng: np.random.Generator, lowest: float) -> tuple[float, float, float]:
    base = rng.uniform(lowest, 1.1)
    colour = np.clip(base * (1 + rng.normal(0, 0.08, 3)), 0.05, 1.15)
    return float(colour[0]), float(colour[1]), float(colour[2])


def random_finish(rng: np.random.Generator) -> Finish:
    trim = Material("wood", 1.0, tint(rng, 0.4)) if rng.random() < 0.6 else Material("white", 1.0, tint(rng, 0.5))
    return Finish(
        Material(str(rng.choice(_WALLS)), rng.uniform(1.2, 2.6), tint(rng, 0.55)),
        Material(str(rng.choice(_FLOORS)), rng.uniform(1.6, 3.0), tint(rng, 0.5)),
        Material(str(rng.choice(_CEILINGS)), rng.uniform(1.8, 3.0), tint(rng, 0.8)),
        replace(trim, tint=tint(rng, 0.3)) if rng.random() < 0.75 else None,
        trim,
    )


def plan(rng: np.random.Generator, building: Building, kind: str = "") -> list[Zone]:
    """Add the zones of one of five kinds of floor plan (empty: random). The first zone's centre is the spawn point."""
    drawn = rng.choice(["room", "hall", "corridor", "corner", "crossing"], p=[0.28, 0.12, 0.26, 0.18, 0.16])
    kind = kind or str(drawn)
    finish, height = random_finish(rng), rng.uniform(2.3, 3.4)
    wall = rng.uniform(0.1, 0.25)
    u = rng.uniform

    def zone(x0: float, y0: float, x1: float, y1: float, f: Finish = finish, h: float = height) -> Zone:
        return building.add(Zone(float(x0), float(y0), float(x1), float(y1), h, f))

    if kind in ("room", "hall"):
        if kind == "hall":
            height = float(u(3.0, 5.0))
            w, d = u(8, 16), u(6, 12)
        else:
            w, d = u(3.0, 7.5), u(3.0, 6.5)
        first = zone(-w / 2, -d / 2, w / 2, d / 2, h=height)
        zones = [first]
        for side in rng.permutation(list(SIDES))[: int(rng.integers(0, 3))]:
            zones.append(side_room(rng, building, first, str(side), wall))
        return zones
    width, length = u(1.6, 3.2), u(7, 18)
    start = u(-length + 2.0, -2.0)
    first = zone(start, -width / 2, start + length, width / 2)
    zones = [first]
    if kind == "corner":
        arm = u(4, 10)
        if rng.random() < 0.5:
            zones.append(zone(first.x1 - width, first.y1, first.x1, first.y1 + arm))
        else:
            zones.append(zone(first.x1 - width, first.y0 - arm, first.x1, first.y0))
    elif kind == "crossing":
        across = u(1.6, 3.0)
        at = u(first.x0 + 1.0, first.x1 - 1.0 - across)
        zones.append(zone(at, first.y1, at + across, first.y1 + u(3, 9)))
        if rng.random() < 0.7:
            zones.append(zone(at, first.y0 - u(3, 9), at + across, first.y0))
    for side in ("north", "south"):
        for low, high in building.free_runs(first, side, 0.4):
            if high - low > 2.5 and rng.random() < 0.6:
                zones.append(side_room(rng, building, first, side, wall, (low, high)))
    return zones


def side_room(
    rng: np.random.Generator, building: Building, zone: Zone, side: str, wall: float, run: Point | None = None
) -> Zone:
    """Add a room with an open doorway behind a wall of ``zone``."""
    start, end = zone.side(side)
    length = math.dist(start, end)
    low, high = run or (0.4, length - 0.4)
    sign_x, sign_y = np.sign(np.asarray(end) - np.asarray(start))
    at = rng.uniform(low + 0.5, high - 0.5)
    centre = start[0] + sign_x * at if side in ("north", "south") else start[1] + sign_y * at
    width = rng.uniform(0.85, 1.2)
    door = building.door(zone, side, centre, wall, width)
    # The room is at most as wide as its share of the wall, so that neighbouring side rooms do not overlap.
    left, right = min(at - low, 3.0) + 0.15, min(high - at, 3.0) + 0.15
    ends = sorted((centre - left, centre + right) if sign_x + sign_y > 0 else (centre + left, centre - right))
    rect = door.beyond(side, ends[0], ends[1], rng.uniform(2.2, 5.0))
    finish = random_finish(rng) if rng.random() < 0.7 else zone.finish
    return building.add(Zone(*rect, height=rng.uniform(2.3, max(2.4, zone.height)), finish=finish))


def decorate(rng: np.random.Generator, building: Building, zone: Zone) -> None:
    """Add posters, windows and closed doors to the free parts of a zone's walls."""
    for side in SIDES:
        for low, high in building.free_runs(zone, side, 0.2):
            at = low
            while high - at > 1.1:
                room = high - at
                choice = rng.random()
                if choice < 0.18 and room > 1.4:
                    width = rng.uniform(0.8, min(2.2, room - 0.3))
                    building.window(
                        zone, side, at + width / 2 + 0.1, width, int(rng.integers(0, 12)), rng.uniform(0.8, 2.2)
                    )
                    at += width + 0.3
                elif choice < 0.33 and zone.height > 2.2:
                    building.closed_door(
                        zone, side, at + 0.55, int(rng.integers(0, 4)), Material("door", 0, tint(rng, 0.5))
                    )
                    at += 1.15
                elif choice < 0.6:
                    w = rng.uniform(0.35, 0.95)
                    kind, variants = ("poster", 40) if rng.random() < 0.8 else ("notices", 4)
                    name = f"{kind}:{int(rng.integers(0, variants))}"
                    height = rng.uniform(1.2, 1.7)
                    building.picture(
                        zone, side, at + w / 2 + 0.05, height, (w, w * rng.uniform(0.6, 1.4)), Material(name)
                    )
                    at += w + 0.2
                at += rng.uniform(0.3, 1.5)


def _furnish(rng: np.random.Generator, building: Building, zone: Zone, keep: tuple[float, float] | None) -> None:
    """Add furniture, mostly along the walls; ``keep`` (x, y) stays free."""
    w, d = zone.x1 - zone.x0, zone.y1 - zone.y0
    build = building.builder
    narrow = min(w, d) < 2.0
    placed: list[tuple[float, float, float]] = [(keep[0], keep[1], 0.6)] if keep else []
    for side in SIDES:
        for low, high, _ in building.openings(zone, side):
            start, end = zone.side(side)
            s = 0.5 * (low + high) / math.dist(start, end)
            x, y = start[0] + s * (end[0] - start[0]), start[1] + s * (end[1] - start[1])
            placed.append((x, y, 0.9))
    for _ in range(int(rng.poisson(0.16 * w * d if not narrow else 0.06 * w * d))):
        against = rng.random() < 0.75
        side = str(rng.choice(SIDES))
        gap = 0.45
        if against:
            x = {"east": zone.x1 - gap, "west": zone.x0 + gap}.get(side, rng.uniform(zone.x0 + 0.7, zone.x1 - 0.7))
            y = {"north": zone.y1 - gap, "south": zone.y0 + gap}.get(side, rng.uniform(zone.y0 + 0.7, zone.y1 - 0.7))
        elif narrow:
            continue
        else:
            x, y = rng.uniform(zone.x0 + 0.9, zone.x1 - 0.9), rng.uniform(zone.y0 + 0.9, zone.y1 - 0.9)
        if not (zone.x0 + 0.3 < x < zone.x1 - 0.3 and zone.y0 + 0.3 < y < zone.y1 - 0.3):
            continue
        radius = 0.7
        if any(math.hypot(x - px, y - py) < radius + pr for px, py, pr in placed):
            continue
        placed.append((x, y, radius))
        _piece(rng, build, (x, y), INWARD_YAW[side] if against else rng.uniform(-math.pi, math.pi), zone.height)


def _piece(rng: np.random.Generator, build: WorldBuilder, at: Point, yaw: float, height: float) -> None:
    cloth = Material("fabric", 0.5, tint(rng, 0.15))
    wood = Material("wood", rng.uniform(0.6, 1.2), tint(rng, 0.4))
    choice = rng.choice(["table", "chair", "bookcase", "cabinet", "sofa", "boxes", "block"])
    if choice == "table":
        furniture.table(build, at, yaw + math.pi / 2, (rng.uniform(0.8, 1.3), rng.uniform(0.5, 0.8)), wood)
    elif choice == "chair":
        furniture.chair(build, at, yaw, cloth)
    elif choice == "bookcase":
        furniture.bookcase(build, at, yaw, int(rng.integers(0, 10)), min(height - 0.1, rng.uniform(1.0, 2.2)))
    elif choice == "cabinet":
        size = (rng.uniform(0.35, 0.6), rng.uniform(0.6, 1.2), min(height - 0.1, rng.uniform(0.7, 2.0)))
        furniture.cabinet(build, at, yaw, size, wood if rng.random() < 0.5 else Material("metal", 0.8, tint(rng, 0.4)))
    elif choice == "sofa":
        furniture.sofa(build, at, yaw, cloth, rng.uniform(0.9, 1.4))
    elif choice == "boxes":
        furniture.boxes(build, at, rng)
    else:
        size = (rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6), rng.uniform(0.3, min(height - 0.1, 2.4)))
        texture = str(rng.choice(["white", "concrete", "metal", "wood", "brick"]))
        build.box(at, size, 0.0, yaw, side=Material(texture, 1.0, tint(rng, 0.4)))


def random_world(seed: int, light_cell_m: float = 0.25, rays: int = 20) -> World:
    """Generate a random interior: room, hall, corridor, corner or crossing, with side rooms and furniture.

    Args:
        seed: seed of the world; the same seed gives the same world.
        light_cell_m: resolution of the baked light.
        rays: rays per light texel.
    """
    return interior(np.random.default_rng([23, seed]), f"random:{seed}", light_cell_m=light_cell_m, rays=rays)


def interior(
    rng: np.random.Generator,
    name: str,
    kind: str = "",
    fit_out: Callable[[np.random.Generator, Building, Zone], None] = decorate,
    light_cell_m: float = 0.25,
    rays: int = 20,
) -> World:
    """Generate an interior with one of the floor plans of ``plan``; ``fit_out`` decorates each zone's walls."""
    building = Building()
    zones = plan(rng, building, kind)
    first = zones[0]
    along = first.x1 - first.x0 > 6.5 and first.y1 - first.y0 < 3.5
    spawn = (0.0, 0.0, 0.0) if along else (*first.centre, 0.0)
    for zone in zones:
        building.lamps(zone, rng.uniform(1.8, 3.6), rng.uniform(2.5, 6.0), bool(rng.random() < 0.5))
        fit_out(rng, building, zone)
        _furnish(rng, building, zone, (spawn[0], spawn[1]) if zone is first else None)
    world = building.world(name, spawn, light_cell_m, rays)
    # Exposure varies between worlds, as with a real camera.
    world.light *= np.float32(rng.uniform(0.75, 1.25))
    return world


def long_world(seed: int, light_cell_m: float = 0.4, rays: int = 12) -> World:
    """Generate a corridor (even seeds) or a hall (odd seeds) of 20 to 40 m, with open doors to side rooms.

    Args:
        seed: seed of the world; the same seed gives the same world.
        light_cell_m: resolution of the baked light.
        rays: rays per light texel.
    """
    rng = np.random.default_rng([29, seed])
    building = Building()
    finish, wall = random_finish(rng), rng.uniform(0.1, 0.25)
    length = rng.uniform(20, 40)
    width = float(rng.uniform(8, 15) if seed % 2 else rng.uniform(1.8, 3.2))
    height = float(rng.uniform(3.0, 5.0) if seed % 2 else rng.uniform(2.4, 3.2))
    start = float(rng.uniform(-0.7, -0.1) * length)
    first = building.add(Zone(start, -width / 2, start + length, width / 2, height, finish))
    zones = [first]
    for side in ("north", "south"):
        for share in range(3):
            if rng.random() < 0.7:
                low, high = (0.4 + (length - 0.8) * part / 3 for part in (share, share + 1))
                zones.append(side_room(rng, building, first, side, wall, (low, high)))
    for zone in zones:
        building.lamps(zone, rng.uniform(2.4, 4.0), rng.uniform(2.5, 6.0), bool(rng.random() < 0.5))
        decorate(rng, building, zone)
        _furnish(rng, building, zone, (0.0, 0.0) if zone is first else None)
    return building.world(f"long:{seed}", (0.0, 0.0, 0.0), light_cell_m, rays)


def make_world(name_or_path: str) -> World:
    """Make a world from its name, or from a mesh file.

    Names: ``corridor``, ``corridor:SEED``, ``corridor-free`` (no obstacle), ``random:SEED``, ``long:SEED``.

    Raises:
        ValueError: the text is neither a known name nor an existing file.
    """
    name, _, argument = name_or_path.partition(":")
    if name in ("corridor", "corridor-free", "random", "long"):
        try:
            seed = int(argument or 0)
        except ValueError as error:
            raise ValueError(f"world {name_or_path!r}: the seed must be an integer") from error
        if name == "random":
            return random_world(seed)
        if name == "long":
            return long_world(seed)
        return corridor_world(seed, obstacle=name == "corridor")
    if Path(name_or_path).is_file():
        return load_world(name_or_path)
    raise ValueError(
        f"world {name_or_path!r} is neither corridor, corridor:SEED, corridor-free, random:SEED, long:SEED nor a mesh "
        "file"
    )
