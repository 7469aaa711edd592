"""Worlds that the simulator's tests share."""

import pytest

from instant_ic.sim.building import Building, Finish, Zone
from instant_ic.sim.world import World
from instant_ic.sim.worlds import corridor_world


@pytest.fixture(scope="session")
def box_room() -> World:
    """Empty room without skirting boards: x -3..3, y -2..2, z 0..3."""
    building = Building()
    building.add(Zone(-3.0, -2.0, 3.0, 2.0, 3.0, Finish(skirting=None)))
    return building.world("box", (0.0, 0.0, 0.0), light_cell_m=0.3, rays=8)


@pytest.fixture(scope="session")
def corridor() -> World:
    return corridor_world(light_cell_m=0.3)
