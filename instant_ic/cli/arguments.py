"""Argument types: numbers and durations on the command line."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence

from instant_ic.cli.errors import UserError


def positive(text: str) -> float:
    """A number > 0."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be > 0 (got {text})")
    return value


def positive_int(text: str) -> int:
    """A whole number > 0."""
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be > 0 (got {text})")
    return value


def not_negative(text: str) -> int:
    """A whole number >= 0."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be >= 0 (got {text})")
    return value


def seconds(text: str) -> float:
    """A duration in seconds: ``90``, ``90s``, ``10m``, ``2h``, ``1d``."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"must look like 90, 30s, 10m, 2h or 1d (got {text})")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86400}[match[2]]


def launch_values(words: Sequence[str]) -> dict[str, str]:
    """Values of a launch file's arguments, given as ``KEY:=VALUE``.

    Raises:
        UserError: an argument has another form.
    """
    values: dict[str, str] = {}
    for word in words:
        name, separator, value = word.partition(":=")
        if not separator or not name:
            raise UserError(f"{word!r}: expected KEY:=VALUE", 2)
        values[name] = value
    return values
