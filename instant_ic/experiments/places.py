"""Places of ``ic experiment environments`` (V.F) that the simulator has no world for: one kind each, and people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from instant_ic.experiments.illusion_truth import moved_by

if TYPE_CHECKING:
    from instant_ic.sim.building import Building, Zone
    from instant_ic.sim.world import World

KINDS = {
    "hall": "open hall",
    "furnished": "furnished room",
    "crossing": "crossing corridors",
    "windows": "corridor with windows side by side",
    "people": "corridor in which people walk",
}
"""Kinds of worlds, each with seeds (``hall:3``)."""
GENERATED = ("corridor", "corridor-free", "random", "long", *KINDS)
"""Worlds that have seeds."""
_PLANS = {"furnished": "room", "windows": "corridor", "people": "corridor"}
_PEOPLE = (2, 4)
_AHEAD_M = (1.5, 7.0)
_PACE_M_S = (0.5, 1.4)
_SHOULDER_M = 0.23


@dataclass(frozen=True)
class Walker:
    """A person who walks along x between two ends and turns round there.

    Attributes:
        surfaces: first and last number + 1 of the person's surfaces in the world.
        x: metres, at first.
        pace: m/s along x, signed.
        ends: lowest and highest x, metres.
    """

    surfaces: tuple[int, int]
    x: float
    pace: float
    ends: tuple[float, float]

    def moved_m(self, seconds: float) -> float:
        """Displacement along x after some time."""
        low, high = self.ends
        length = high - low
        at = (self.x - low + self.pace * seconds) % (2 * length)
        return low + min(at, 2 * length - at) - self.x


def make_place_world(name: str) -> tuple[World, tuple[Walker, ...]]:
    """World of a kind of ``KINDS`` with its seed, or any of ``sim.worlds.make_world``, and who walks in it.

    Raises:
        ValueError: no such world.
    """
    from instant_ic.sim.worlds import decorate, interior, make_world

    kind, _, number = name.partition(":")
    if kind not in KINDS:
        return make_world(name), ()
    if number and not number.isdigit():
        raise ValueError(f"world {name!r}: the seed must be an integer")
    rng = np.random.default_rng([97, list(KINDS).index(kind), int(number or 0)])
    walkers: list[Walker] = []

    def fit_out(rng: np.random.Generator, building: Building, zone: Zone) -> None:
        first = zone is building.zones[0]
        if kind == "windows" and first:
            glaze(rng, building, zone)
            return
        decorate(rng, building, zone)
        if kind == "people" and first:
            walkers.extend(add_people(rng, building, zone))

    return interior(rng, name, _PLANS.get(kind, kind), fit_out), tuple(walkers)


def glaze(rng: np.random.Generator, building: Building, zone: Zone) -> None:
    """Fill the free parts of a zone's walls with windows, 0.2 m apart."""
    for side in ("north", "south", "east", "west"):
        for low, high in building.free_runs(zone, side, 0.2):
            width = float(rng.uniform(1.0, 1.6))
            for number in range(int((high - low) / (width + 0.2))):
                at = low + 0.1 + 0.5 * width + number * (width + 0.2)
                building.window(zone, side, at, width, int(rng.integers(0, 12)), float(rng.uniform(1.2, 2.2)))


def add_people(rng: np.random.Generator, building: Building, zone: Zone) -> list[Walker]:
    """Add people on either side of a corridor's middle, ahead of the origin."""
    from instant_ic.sim.world import Material
    from instant_ic.sim.worlds import tint

    found = []
    aside = 0.5 * (zone.y1 - zone.y0) - _SHOULDER_M - 0.02
    ends = zone.x0 + 0.5, zone.x1 - 0.5
    for number in range(int(rng.integers(_PEOPLE[0], _PEOPLE[1] + 1))):
        x = float(rng.uniform(_AHEAD_M[0], min(_AHEAD_M[1], ends[1])))
        y = (-1) ** number * min(aside, float(rng.uniform(0.55, 0.9)))
        begin = len(building.builder.panels)
        cloth, legs = (Material("fabric", 0.5, tint(rng, 0.15)) for _ in range(2))
        skin = Material("paint", 0.5, (0.75, 0.55, 0.42))
        for size, low, look in (
            ((0.24, 0.34, 0.85), 0.0, legs),
            ((0.26, 2 * _SHOULDER_M, 0.6), 0.85, cloth),
            ((0.2, 0.17, 0.26), 1.46, skin),
        ):
            building.builder.box((x, y), size, low, side=look)
        pace = float(rng.uniform(*_PACE_M_S) * rng.choice([-1, 1]))
        found.append(Walker((begin, len(building.builder.panels)), x, pace, ends))
    return found


def world_after(world: World, walkers: tuple[Walker, ...], seconds: float) -> World:
    """The world when its people have walked for some time."""
    for walker in walkers:
        surfaces = np.zeros(len(world.normal), bool)
        surfaces[slice(*walker.surfaces)] = True
        world = moved_by(world, surfaces, np.array([walker.moved_m(seconds), 0.0, 0.0]))
    return world
