"""Reading YAML whose errors are all of one type."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import yaml

T = TypeVar("T")
# What PyYAML lets through for a value that does not fit its type, such as `!!int "_"`.
_STRAY = (ValueError, TypeError, AttributeError, IndexError, KeyError, OverflowError)


def read_yaml(text: str) -> object:
    """The plain value of a YAML document.

    Raises:
        yaml.YAMLError: the text is not YAML, a value does not fit its type, or it is nested too deeply.
    """
    return checked(lambda: yaml.safe_load(text))


def checked(read: Callable[[], T]) -> T:
    """Call a function of PyYAML; its other exceptions become ``yaml.YAMLError``."""
    try:
        return read()
    except _STRAY as error:
        raise yaml.YAMLError(str(error)) from error
    except RecursionError:
        raise yaml.YAMLError("lists or mappings are nested too deeply") from None
