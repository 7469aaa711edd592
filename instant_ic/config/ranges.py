"""Ranges of configuration values, declared with the field: ``rate_hz: Positive = 20.0``.

>>> from dataclasses import dataclass
>>> @dataclass(frozen=True)
... class Config:
...     nice: Annotated[int, Range(0, 19)] = 0
...     def __post_init__(self) -> None:
...         check_ranges(self)
>>> Config(nice=33)
Traceback (most recent call last):
    ...
ValueError: nice must lie in 0..19 (got 33)
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Annotated, Any, TypeAlias, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Range:
    """Allowed range of a finite number.

    Attributes:
        low: smallest allowed value.
        high: largest allowed value.
        above: the value must be larger than this.
        below: the value must be smaller than this.
    """

    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None

    def __contains__(self, value: float) -> bool:
        return (
            (isinstance(value, int) or math.isfinite(value))  # isfinite() raises for a huge int
            and (self.low is None or value >= self.low)
            and (self.high is None or value <= self.high)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def __str__(self) -> str:
        """Return the short form for display: ``0..19``, ``> 0``."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g}..{self.high:g}"
        bounds = ((">=", self.low), (">", self.above), ("<=", self.high), ("<", self.below))
        return ", ".join(f"{sign} {bound:g}" for sign, bound in bounds if bound is not None)

    @property
    def words(self) -> str:
        """Text for error messages: ``must lie in 0..19``, ``must be > 0``."""
        return f"must lie in {self}" if ".." in str(self) else f"must be {str(self).replace(', ', ' and ')}"

    def refusal(self, value: float, shown: object = None) -> str:
        """Return the error text for a value outside the range: ``must lie in 0..19 (got 33)``.

        Args:
            value: the value.
            shown: the value as it was spelled; None uses Python's notation.
        """
        return f"{self.words} (got {value if shown is None else shown})"


@dataclass(frozen=True)
class Plausible(Range):
    """Values that make sense for a tracked robot. The error suggests a value with the decimal point moved.

    >>> print(Plausible(0.05, 3).refusal(3.8))
    must lie in 0.05..3 (got 3.8); did you mean 0.38?
    """

    def refusal(self, value: float, shown: object = None) -> str:
        text = super().refusal(value, shown)
        powers = (-1, -2, -3) if self.high is not None and value > self.high else (1, 2, 3)
        # Decimal, because 0.1 times 3.8 is not exactly 0.38 in floating point.
        guesses = (float(Decimal(str(value)).scaleb(power)) for power in powers) if abs(value) < 1e15 else ()
        meant = next((guess for guess in guesses if guess in self), None)
        return text if meant is None else f"{text}; did you mean {meant:g}?"


Positive: TypeAlias = Annotated[float, Range(above=0)]
NotNegative: TypeAlias = Annotated[float, Range(low=0)]
PositiveInt: TypeAlias = Annotated[int, Range(low=1)]
NotNegativeInt: TypeAlias = Annotated[int, Range(low=0)]
Share: TypeAlias = Annotated[float, Range(0, 1)]
Percent: TypeAlias = Annotated[int, Range(1, 100)]


def range_of(hint: Any) -> Range | None:
    """Return the range in a type's annotation, even inside ``X | None``; None if it has none."""
    if get_origin(hint) is Annotated:
        return next((extra for extra in get_args(hint)[1:] if isinstance(extra, Range)), None)
    found = (range_of(part) for part in get_args(hint) if get_origin(hint) is not tuple)
    return next((inner for inner in found if inner is not None), None)


@functools.cache
def ranges(config_class: type[Any]) -> dict[str, Range]:
    """Return the ranges of a dataclass's own fields, without nested groups, by field name."""
    hints = get_type_hints(config_class, include_extras=True)
    return {f.name: bounds for f in dataclasses.fields(config_class) if (bounds := _element(hints[f.name])) is not None}


def _element(hint: Any) -> Range | None:
    """Return the range of a value, or of every element of a sequence."""
    return range_of(hint) or next((r for part in get_args(hint) if (r := range_of(part)) is not None), None)


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, (tuple, list)):
        for part in value:
            yield from _numbers(part)
    elif value is not None:
        yield value


def check_ranges(config: Any) -> None:
    """Check every field of a dataclass against its range; for ``__post_init__``.

    Raises:
        ValueError: a value is out of range; the text names field, range and value.
    """
    for name, bounds in ranges(type(config)).items():  # type: ignore[arg-type]
        for value in _numbers(getattr(config, name)):
            if value not in bounds:
                raise ValueError(f"{name} {bounds.refusal(value)}")


class Checked:
    """Base class of a configuration dataclass whose fields are checked against their ranges."""

    def __post_init__(self) -> None:
        check_ranges(self)


def require_protection(unprotected: bool, off: Sequence[str], danger: str) -> None:
    """Refuse parameters that switch a protection off, unless ``unprotected`` is set.

    Args:
        unprotected: true if the missing protection is intended.
        off: names of the parameters that switch a protection off.
        danger: consequence, for the error.
    """
    if off and not unprotected:
        raise ValueError(f"{', '.join(off)}: protection is off, so {danger}. Switch it on, or set unprotected: true")


def require(config: Any, name: str, condition: bool, rule: str) -> None:
    """Check a condition between fields, for ``__post_init__`` after :func:`check_ranges`."""
    if not condition:
        raise ValueError(f"{name} must be {rule} (got {getattr(config, name)!r})")
