"""Description of a node's parameters: type, range, default, meaning, and whether they can be changed live."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from instant_ic import paths
from instant_ic.config.params import field_default
from instant_ic.config.ranges import ranges


@dataclass(frozen=True)
class ParameterInfo:
    """One parameter of one node.

    Attributes:
        name: key, with dots between groups.
        type: type of the value, in Python notation.
        value: present value, as plain JSON.
        default: default value, as plain JSON.
        range: allowed range as text; empty without a range.
        live: whether it can be changed while the node runs.
        description: its meaning.
    """

    name: str
    type: str
    value: Any
    default: Any
    range: str = ""
    live: bool = False
    description: str = ""


def is_live(key: str, live: Iterable[str]) -> bool:
    """Whether a key is live; ``live`` may also name whole groups, or everything by ``*``."""
    return any(entry in ("*", key) or key.startswith(f"{entry}.") for entry in live)


def parameter_infos(
    config_class: type[Any], config: Any = None, live: Iterable[str] = (), node: str = ""
) -> list[ParameterInfo]:
    """All parameters of a configuration, in the order of its fields.

    Args:
        config_class: dataclass of the configuration.
        config: configuration that gives the present values; None uses the defaults.
        live: keys and groups that can be changed while the node runs.
        node: section of ``config/*.yaml`` whose comments take precedence over the docstring as descriptions.
    """
    described = shipped_comments().get(node, {})
    return [
        dataclasses.replace(
            info, live=is_live(info.name, live), description=described.get(info.name) or info.description
        )
        for info in _infos(config_class, config, None, "")
    ]


def _infos(config_class: type[Any], config: Any, defaults: Any, prefix: str) -> list[ParameterInfo]:
    """Parameters of one group; ``defaults`` is the group as its parent creates it, None at the top."""
    infos: list[ParameterInfo] = []
    meanings = {name: text for base in reversed(config_class.__mro__) for name, text in attributes(base).items()}
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
    """A value as JSON: tuples become lists, paths become strings."""
    if isinstance(value, (tuple, list)):
        return [plain(part) for part in value]
    return str(value) if isinstance(value, Path) else value


def attributes(config_class: type[Any]) -> dict[str, str]:
    """Entries of the "Attributes:" section of a docstring; ``a, b: text`` describes both."""
    doc = inspect.cleandoc(config_class.__doc__ or "")
    part = doc.partition("Attributes:\n")[2].split("\n\n")[0]
    found: dict[str, str] = {}
    names: list[str] = []
    for line in part.splitlines():
        if match := re.match(r"    (\w+(?:, \w+)*): (.*)", line):
            names = match[1].split(", ")
            found.update(dict.fromkeys(names, match[2]))
        else:
            found.update({name: f"{found[name]} {line.strip()}" for name in names})
    return found


def comments(path: Path) -> dict[str, dict[str, str]]:
    """Comment of each key of a parameter file: node → dotted key → text."""
    result: dict[str, dict[str, str]] = {}
    stack: list[tuple[int, str]] = []
    above: list[str] = []
    for line in path.read_text().splitlines():
        bare = line.strip()
        if bare.startswith("#"):
            above.append(bare.lstrip("# ").strip())
            continue
        match = re.match(r"^(\s*)([\w/*]+):(.*)$", line)
        if not match:
            above = []
            continue
        indent, key, rest = len(match[1]), match[2], match[3]
        while stack and stack[-1][0] >= indent:
            stack.pop()
        stack.append((indent, key))
        names = [name for _, name in stack]
        beside = re.search(r"(?:^|\s)#\s*(.*)$", rest)
        text = " ".join([*above, *([beside[1].strip()] if beside else [])])
        if len(names) > 2 and text:
            result.setdefault(names[0], {})[".".join(names[2:])] = text
        above = []
    return result


@functools.cache
def shipped_comments() -> dict[str, dict[str, str]]:
    """Comments of all shipped parameter files: node → dotted key → text."""
    described: dict[str, dict[str, str]] = {}
    for path in sorted(paths.share_dir("config").glob("*.yaml")):
        for node, keys in comments(path).items():
            described.setdefault(node, {}).update(keys)
    return described
