"""Conversion of YAML scalars to the type of the parameter that they are for.

YAML derives the type from the spelling alone: ``5e-06`` is text, ``0123`` is 83, ``1:30`` is 90, ``no`` is false, and
``1_000``, dates and nulls have types too. A :class:`Scalar` keeps the spelling until the wanted type is known. Each
function here takes a Scalar or a typed value (quoted text, a value from JSON), and raises ValueError with the wanted
type.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_BOOLS = {"yes": True, "true": True, "on": True, "no": False, "false": False, "off": False}
_NULLS = ("", "~", "null")
_NOT_FINITE = (".inf", ".nan")
_NUMBER_LIKE = re.compile(r"[-+.\d][\w.:+-]*", re.ASCII)


@dataclass(frozen=True)
class Scalar:
    """An unquoted scalar without a tag, in its spelling."""

    text: str

    def __str__(self) -> str:
        """Return the spelling."""
        return self.text

    def __repr__(self) -> str:
        """Return the spelling, in quotes unless it looks like a number."""
        return self.text if _NUMBER_LIKE.fullmatch(self.text) else repr(self.text)


def is_null(value: Any) -> bool:
    """Return whether a value is null: ``null``, ``~`` or nothing, unquoted."""
    return value is None or (isinstance(value, Scalar) and value.text.lower() in _NULLS)


def to_bool(value: Any) -> bool:
    """Return a boolean from ``true``, ``yes``, ``on`` or their opposites, as in YAML 1.1 and ROS 2."""
    found = _BOOLS.get(value.text.lower()) if isinstance(value, Scalar) else value
    if not isinstance(found, bool):
        raise ValueError("must be bool")
    return found


def to_whole_number(value: Any) -> int:
    """Return an integer of any size. ``1_000``, ``0x1F`` and ``0b11`` are accepted, but no leading zeros."""
    number = value
    if isinstance(value, Scalar):
        with suppress(ValueError):
            number = int(value.text, 0)
        if re.fullmatch(r"[-+]?0\d+", value.text):
            raise ValueError("must be int, without a leading zero")  # 0123 is 83 to YAML 1.1 and 123 to YAML 1.2
    if not isinstance(number, int) or isinstance(number, bool):
        raise ValueError("must be int")
    return number


def to_int(value: Any) -> int:
    """Return an integer of at most 64 bits."""
    number = to_whole_number(value)
    if not -(1 << 63) <= number < 1 << 63:
        raise ValueError("must have at most 64 bits, as in ROS 2")
    return number


def to_float(value: Any) -> float:
    """Return a finite number from any spelling: ``5e-06``, ``.5``, ``1_000``, ``0123`` (123), ``0x10``."""
    number = _number(value.text) if isinstance(value, Scalar) else value
    if not isinstance(number, (int, float)) or isinstance(number, bool):
        raise ValueError("must be float")
    with suppress(OverflowError):  # raised for a huge int
        if math.isfinite(found := float(number)):
            return found
    raise ValueError("must be a finite number")


def _number(text: str) -> int | float | None:
    if text.lower().lstrip("+-") in _NOT_FINITE:
        return math.nan
    for read in (float, lambda word: int(word, 0)):
        with suppress(ValueError):
            return read(text)
    return None


def to_text(value: Any) -> str:
    """Return a text in its spelling, even ``no`` and ``0123``. Null is refused; empty text is ``""``."""
    if isinstance(value, Scalar) and value.text:
        return value.text
    if isinstance(value, (str, int, float)) and not isinstance(value, bool):
        return str(value)
    raise ValueError('must be str ("" for empty text)' if is_null(value) else "must be str")


READERS: Mapping[type, Callable[[Any], Any]] = {
    bool: to_bool,
    int: to_int,
    float: to_float,
    str: to_text,
    Path: lambda value: Path(to_text(value)),
}
"""Conversion function by type."""
