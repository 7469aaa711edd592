"""A bus in a run directory of its own, with a path short enough for sockets."""

import pytest
from local_bus import Bus


@pytest.fixture
def bus(tmp_path_factory: pytest.TempPathFactory):
    bus = Bus(tmp_path_factory.mktemp("r"))
    yield bus
    bus.close()
