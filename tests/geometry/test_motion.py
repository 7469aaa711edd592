"""The arc of a constant twist."""

import math

import pytest

from instant_ic.geometry.motion import along_arc, step_towards

QUARTER = math.pi / 2


@pytest.mark.parametrize(
    ("start", "forward", "turn", "sideways", "end"),
    [
        ((0, 0, 0), QUARTER, QUARTER, 0, (1, 1, QUARTER)),  # a quarter of a circle of 1 m to the left
        ((0, 0, 0), QUARTER, -QUARTER, 0, (1, -1, -QUARTER)),
        ((0, 0, 0), -QUARTER, QUARTER, 0, (-1, -1, QUARTER)),
        ((2, 3, QUARTER), 1, 0, 0, (2, 4, QUARTER)),
        ((0, 0, 0), 0, QUARTER, QUARTER, (-1, 1, QUARTER)),  # the same circle, driven sideways
        ((0, 0, 0), 1, 1e-12, 0, (1, 5e-13, 1e-12)),
    ],
)
def test_a_constant_twist_is_an_arc(start, forward, turn, sideways, end):
    assert along_arc(*start, forward, turn, sideways) == pytest.approx(end, abs=1e-12)


def test_a_step_reaches_the_target_and_no_further():
    assert [step_towards(1.0, target, 0.5) for target in (3.0, 1.2, -3.0)] == [1.5, 1.2, 0.5]
