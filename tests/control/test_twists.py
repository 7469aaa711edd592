"""One rule for twists that are too fast or no numbers."""

import math

import pytest

from instant_ic.geometry.twists import clip_twist


def test_too_fast_a_twist_keeps_its_curvature() -> None:
    assert clip_twist(1.0, 1.0, 0.5, 1.0) == pytest.approx((0.5, 0.5))
    assert clip_twist(0.5, -2.0, 0.5, 1.0) == pytest.approx((0.25, -1.0))
    assert clip_twist(0.2, 0.1, 0.5, 1.0) == (0.2, 0.1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_twist_that_is_not_finite_is_zero(bad: float) -> None:
    assert clip_twist(bad, 0.1, 0.5, 1.0) == (0.0, 0.0)
    assert clip_twist(0.1, bad, 0.5, 1.0) == (0.0, 0.0)
