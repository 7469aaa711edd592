"""Mutated inputs of every parser of outside data, the same each time. ``make fuzz`` gives a thousand times as many."""

import os

import pytest

from tests.fuzz.harness import run
from tests.fuzz.targets import TARGETS


@pytest.mark.parametrize("name", TARGETS)
def test_parser_takes_mutated_input(name: str) -> None:
    make, count = TARGETS[name]
    run(name, make(), count * int(os.environ.get("FUZZ", "1")))
