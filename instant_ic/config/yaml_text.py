"""Reading YAML whose errors are all of one type."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

import yaml

T = TypeVar("T")
# What PyYAML lets through for a value that does not fit its type, such as `!!int "_"`.
_STRAY = (ValueError, TypeError, AttributeError, IndexError, KeyError, OverflowError)
_MOST_FAST = 8192
"""Characters, and so levels of nesting, up to which the C parser's recursion is sure to fit into a stack."""


def read_yaml(text: str) -> object:
    """The plain value of a YAML document.

    Raises:
        yaml.YAMLError: the text is not YAML, a value does not fit its type, or it is nested too deeply.
    """
    return checked(lambda: yaml.safe_load(text))


def compose_yaml(text: str) -> yaml.Node | None:
    """Nodes of a YAML text, with their lines; None if it is empty.

    By the C parser where there is one: that takes a tenth of the time. What it refuses, the Python parser explains.

    Raises:
        yaml.YAMLError: the text is not YAML, or it is nested too deeply.
    """
    fast = getattr(yaml, "CSafeLoader", None)
    if fast is not None and len(text) <= _MOST_FAST:
        with suppress(yaml.YAMLError):
            return checked(lambda: yaml.compose(text, Loader=fast))
    return checked(lambda: yaml.compose(text, Loader=yaml.SafeLoader))


def checked(read: Callable[[], T]) -> T:
    """Call a function of PyYAML; its other exceptions become ``yaml.YAMLError``."""
    try:
        return read()
    except _STRAY as error:
        raise yaml.YAMLError(str(error)) from error
    except RecursionError:
        raise yaml.YAMLError("lists or mappings are nested too deeply, or an anchor contains itself") from None
