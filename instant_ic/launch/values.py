"""Values of a launch file after substitution; mistakes are noted at their line, never raised."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping

import yaml

from instant_ic.config.scalars import Scalar, is_null
from instant_ic.config.yaml_text import read_spelled
from instant_ic.launch.source import Value
from instant_ic.launch.substitutions import MOST_TEXT, Context, SubstitutionError, has_substitution, substitute, truth

CONDITION = ("if", "unless")
"""Keys that every action may have."""


def text_of(value: Value | None, context: Context) -> str | None:
    """The text after substitution; None if it is missing or wrong."""
    text = value.text() if value is not None else None
    return replaced(text, value, context) if value is not None and text is not None else None


def plain_text(value: Value | None) -> str | None:
    return value.text() if value is not None else None


def replaced(text: str, value: Value, context: Context) -> str | None:
    """A text from this place, after substitution."""
    try:
        return substitute(text, context)
    except SubstitutionError as error:
        value.problem(str(error))
    except RecursionError:
        value.problem("substitutions or parentheses are nested too deeply")
    return None


def flag_of(value: Value | None, context: Context, default: bool = False) -> bool:
    text = text_of(value, context)
    if value is None or text is None:
        return default
    try:
        return truth(text)
    except SubstitutionError as error:
        value.problem(str(error))
        return default


def holds(fields: Mapping[str, Value], context: Context) -> bool:
    """Whether ``if`` and ``unless`` let the action run."""
    return flag_of(fields.get("if"), context, default=True) and not flag_of(fields.get("unless"), context)


def seconds_of(value: Value | None, context: Context) -> float | None:
    """A number of seconds >= 0; None if it is missing or wrong."""
    text = text_of(value, context)
    if value is None or text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        value.problem(f"expected a number, got {text!r}")
        return None
    if not 0 <= number < math.inf:
        value.problem(f"must be a number of seconds >= 0, got {text!r}")
        return None
    return number


def integer_of(value: Value | None, context: Context, default: int) -> int:
    text = text_of(value, context)
    if value is None or text is None:
        return default
    try:
        return int(text)
    except ValueError:
        value.problem(f"expected a whole number, got {text!r}")
        return default


def words_of(value: Value | None, context: Context) -> list[str]:
    text = text_of(value, context)
    if value is None or not text:
        return []
    try:
        return shlex.split(text)
    except ValueError as error:
        value.problem(f"{text!r}: {error}")
        return []


def pair_of(entry: Value, first: str, second: str, context: Context) -> tuple[str, str] | None:
    """Two keys that belong together; None if either is missing."""
    fields = entry.fields(known=(first, second, *CONDITION), required=(first, second))
    one, two = text_of(fields.get(first), context), text_of(fields.get(second), context)
    return (one, two) if one and two is not None and holds(fields, context) else None


def pairs_of(value: Value | None, first: str, second: str, context: Context) -> list[tuple[str, str]]:
    found = [pair_of(entry, first, second, context) for entry in value.items()] if value is not None else []
    return [pair for pair in found if pair is not None]


def parameter_value(value: Value, kind: str, context: Context) -> object:
    """The value of a parameter, of the given type, or with the spelling of its unquoted scalars."""
    if value.is_list or value.is_mapping:
        return _texts_replaced(value, context)
    text = text_of(value, context)
    if text is None:
        return None
    readers: dict[str, Callable[[str], object]] = {
        "str": str,
        "int": int,
        "float": float,
        "bool": truth,
        "": read_spelled,
    }
    if kind not in readers:
        value.problem(f"unknown type {kind!r} (types: str, int, float, bool)")
        return None
    # Quoted and empty text stays text; everything else is read as YAML.
    if kind == "" and ((value.is_quoted and not has_substitution(value.text() or "")) or not text):
        return text
    try:
        return readers[kind](text)
    except (ValueError, yaml.YAMLError):
        value.problem(f"{text!r} is not of type {kind or 'YAML'}")
        return None


def _texts_replaced(value: Value, context: Context) -> object:
    """A list or mapping with its texts after substitution; None, with the problem noted, if they are too long."""
    length = 0

    def read(plain: object) -> object:
        nonlocal length
        if isinstance(plain, (str, Scalar)) and not is_null(plain):
            text = replaced(str(plain), value, context) or ""
            length += len(text)
            if length > MOST_TEXT:  # 300 bytes of aliases can stand for 100 000 uses of a long text
                raise OverflowError
            return Scalar(text) if text and isinstance(plain, Scalar) else text
        if isinstance(plain, list):
            return [read(entry) for entry in plain]
        if isinstance(plain, dict):
            return {key: read(entry) for key, entry in plain.items()}
        return plain

    try:
        return read(value.spelled())
    except OverflowError:
        value.problem(f"its texts have more than {MOST_TEXT} characters, each alias counted where it is used")
        return None
