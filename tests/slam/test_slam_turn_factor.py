"""The turn factor, which calibrates the effective track width."""

import math

import numpy as np
import pytest

from instant_ic.slam.turn_factor import TurnFactor


def test_the_turn_factor_is_learnt_and_a_stuck_robot_does_not_spoil_it() -> None:
    factor = TurnFactor()
    assert factor.value == 1.0 and math.isinf(factor.sigma)
    rng = np.random.default_rng(1)
    for k in range(1500):
        seen = 0.05 * math.copysign(1.0, math.sin(k / 40))
        factor.update(1.3 * seen * (1 + 0.1 * rng.standard_normal()), seen)
    # Encoders say 1.3 times the turn: the effective track is that much wider than assumed.
    assert factor.value == pytest.approx(1.3, abs=0.03) and 0 < factor.sigma < 0.05
    for _ in range(100):
        factor.update(0.1, 0.001)
    assert factor.value == pytest.approx(1.3, abs=0.03)
