"""Descriptions of a node's parameters: type, range, default, meaning, and whether they can be changed live."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from instant_ic.config.params import field_default
from instant_ic.config.ranges import ranges
from instant_ic.util.safe_text import masked


@dataclass(frozen=True)
class ParameterInfo:
    """One parameter of one node.

    Attributes:
        name: key, with dots between groups.
        type: type of the value, in Python notation.
        value: present value, as plain JSON.
        default: default value, as plain JSON.
        range: allowed range as text; empty if there is none.
        live: true if the parameter can be changed while the node runs.
    """

    name: str
    type: str
    value: Any
    default: Any
    range: str = ""
    live: bool = False
    description: str = ""


def is_live(key: str, live: Iterable[str]) -> bool:
    """Return whether a key is live. ``live`` holds keys, groups of keys, or ``*`` for everything."""
    return any(entry in ("*", key) or key.startswith(f"{entry}.") for entry in live)


def parameter_infos(config_class: type[Any], config: Any = None, live: Iterable[str] = ()) -> list[ParameterInfo]:
    """Return all parameters of a configuration, in the order of its fields.

    Args:
        config_class: the configuration's class.
        config: source of the present values; None uses the defaults.
        live: keys and groups that can be changed while the node runs; see :func:`is_live`.
    """
    return [dataclasses.replace(info, live=is_live(info.name, live)) for info in _infos(config_class, config, None, "")]


def _infos(config_class: type[Any], config: Any, defaults: Any, prefix: str) -> list[ParameterInfo]:
    """Return the parameters of one group. ``defaults`` is the default value of the group; None at the top."""
    infos: list[ParameterInfo] = []
    meanings = attributes(config_class)  # type: ignore[arg-type]
    hints, bounds = get_type_hints(config_class), ranges(config_class)  # type: ignore[arg-type]
    for field in dataclasses.fields(config_class):
        hint, key = hints[field.name], f"{prefix}{field.name}"
        default = field_default(field) if defaults is None else getattr(defaults, field.name)
        value = default if config is None else getattr(config, field.name)
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            infos += _infos(hint, value, default, f"{key}.")
            continue
        limits = str(bounds[field.name]) if field.name in bounds else ""
        infos.append(
            ParameterInfo(
                key, _type_words(hint), plain(value), plain(default), limits, description=meanings.get(field.name, "")
            )
        )
    return infos


def _type_words(hint: Any) -> str:
    words = hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)
    return words.replace("typing.", "").replace("pathlib.", "")


def plain(value: Any) -> Any:
    """Return a value as plain JSON: tuples as lists, paths as strings, passwords in addresses masked."""
    if isinstance(value, (tuple, list)):
        return [plain(part) for part in value]
    return masked(str(value)) if isinstance(value, str | Path) else value


@functools.cache
def attributes(config_class: type[Any]) -> Mapping[str, str]:
    """Return the "Attributes:" entries of a class and its bases by name; ``a, b: text`` describes both names."""
    found: dict[str, str] = {}
    for kind in reversed(config_class.__mro__):
        part = inspect.cleandoc(kind.__dict__.get("__doc__") or "").partition("Attributes:\n")[2].split("\n\n")[0]
        names: list[str] = []
        for line in part.splitlines():
            if match := re.match(r"    (\w+(?:, \w+)*): (.*)", line):
                names = match[1].split(", ")
                found.update(dict.fromkeys(names, match[2]))
            else:
                found.update({name: f"{found[name]} {line.strip()}" for name in names})
    return found
