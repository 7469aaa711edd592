"""Ranges declared at the field: one place for the check, the error, `ic param describe` and the reference."""

import math
from dataclasses import dataclass
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.bus import ParameterError
from instant_ic.config import params
from instant_ic.config.params import ProcessParameters
from instant_ic.config.ranges import NotNegative, Positive, Range, Share, check_ranges


@dataclass(frozen=True)
class Ranged:
    rate: Positive = 1.0
    share: Share = 0.5
    angle: Annotated[float, Range(0, below=360)] = 0.0
    margins: tuple[NotNegative, ...] = (0.0,)
    limit: Annotated[float, Range(above=0, high=2)] | None = None

    def __post_init__(self):
        check_ranges(self)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"rate": 0.0}, r"rate must be > 0 \(got 0.0\)"),
        ({"rate": math.nan}, r"rate must be > 0 \(got nan\)"),
        ({"rate": math.inf}, r"rate must be > 0 \(got inf\)"),
        ({"share": 1.01}, r"share must lie in 0..1 \(got 1.01\)"),
        ({"angle": 360.0}, r"angle must be >= 0 and < 360 \(got 360.0\)"),
        ({"margins": (1.0, -1.0)}, r"margins must be >= 0 \(got -1.0\)"),
        ({"limit": 3.0}, r"limit must be > 0 and <= 2 \(got 3.0\)"),
    ],
)
def test_value_outside_is_refused_in_words(values, words):
    with pytest.raises(ValueError, match=words):
        Ranged(**values)


def test_values_on_the_edge_are_taken():
    Ranged(rate=1e-9, share=1.0, angle=359.9, margins=(0.0, 5.0), limit=2.0)


@given(st.floats(), st.floats(-10, 10), st.floats(0, 10))
def test_closed_range_holds_exactly_its_values(value, low, width):
    assert (value in Range(low, low + width)) == (math.isfinite(value) and low <= value <= low + width)


def test_file_and_line_of_a_value_outside(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("node:\n  ros__parameters:\n    nice: 33\n    margins: [1, -2]\n")
    values = params.load_file(path, "node")
    with pytest.raises(ParameterError, match=r"x\.yaml:3: nice must lie in 0\.\.19 \(got 33\)"):
        params.build(ProcessParameters, {"nice": values["nice"]})
    with pytest.raises(ParameterError, match=r"x\.yaml:4: margins\[1\] must be >= 0 \(got -2\)"):
        params.build(Ranged, {"margins": values["margins"]})
