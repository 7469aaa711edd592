"""YAML values with their file and line."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import yaml

from instant_ic.config.yaml_text import compose_yaml, spelled

_KINDS = {yaml.ScalarNode: "single value", yaml.SequenceNode: "list", yaml.MappingNode: "mapping"}


class YamlProblem(ValueError):
    """One mistake in a file, printed as ``file:line: text``, which editors and terminals recognise."""

    def __init__(self, file: Path, line: int, text: str) -> None:
        super().__init__(f"{_shortened(file)}:{line}: {text}")
        self.file, self.line, self.text = file, line, text


@dataclass(frozen=True)
class YamlPlace:
    """A scalar, mapping or list in a YAML file. Reading it as another kind raises :class:`YamlProblem`."""

    file: Path
    node: yaml.Node

    @property
    def line(self) -> int:
        """Line in the file, from 1."""
        return int(self.node.start_mark.line) + 1

    @property
    def place(self) -> str:
        """File and line, ``file:line``."""
        return f"{_shortened(self.file)}:{self.line}"

    @property
    def is_single(self) -> bool:
        """True for a value that is neither a list nor a mapping."""
        return isinstance(self.node, yaml.ScalarNode)

    @property
    def is_quoted(self) -> bool:
        """True for quoted or block text, which is never a number or a boolean."""
        return isinstance(self.node, yaml.ScalarNode) and bool(self.node.style)

    @property
    def is_mapping(self) -> bool:
        """True for a mapping of keys to values."""
        return isinstance(self.node, yaml.MappingNode)

    @property
    def _is_null(self) -> bool:
        return bool(self.node.tag == "tag:yaml.org,2002:null")

    def problem(self, text: str) -> YamlProblem:
        """Return the error for a mistake at this place."""
        return YamlProblem(self.file, self.line, text)

    def text(self) -> str:
        """Return the scalar as it is written; empty text for null."""
        if not self.is_single:
            raise self._unexpected("a single value")
        return "" if self._is_null else str(self.node.value)

    def items(self) -> list[YamlPlace]:
        """Return the entries of a list."""
        if not isinstance(self.node, yaml.SequenceNode):
            raise self._unexpected("a list")
        return [YamlPlace(self.file, entry) for entry in self.node.value]

    def fields(self, known: Collection[str] = (), required: Collection[str] = ()) -> dict[str, YamlPlace]:
        """Return the entries of a mapping; null counts as an empty mapping.

        A missing or repeated key raises :class:`YamlProblem`. So does an unknown key, if ``known`` is given.
        """
        if not self.is_mapping and not self._is_null:
            raise self._unexpected("keys and values")
        found: dict[str, YamlPlace] = {}
        for key_node, value_node in self.node.value if self.is_mapping else ():
            key = YamlPlace(self.file, key_node)
            name = key.text()
            if name in found:
                raise key.problem(f"{name!r} is given twice (first in line {found[name].line})")
            if known and name not in known:
                raise key.problem(f"unknown key {name!r} (supported: {', '.join(sorted(known))})")
            found[name] = YamlPlace(self.file, value_node)
        if missing := [name for name in required if name not in found]:
            raise self.problem(f"{missing[0]!r} is missing")
        return found

    def spelled(self) -> object:
        """Return the value with the spelling of its scalars."""
        try:
            return spelled(self.node)
        except yaml.YAMLError as error:
            raise self.problem(f"not YAML: {error}") from None

    def _unexpected(self, wanted: str) -> YamlProblem:
        return self.problem(f"expected {wanted}, got a {_KINDS.get(type(self.node), 'value of another kind')}")


def load(file: Path) -> YamlPlace:
    """Read a YAML file. An empty file is null.

    Raises:
        YamlProblem: the file cannot be read or is not YAML.
    """
    try:
        node = compose_yaml(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise YamlProblem(file, 1, f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise YamlProblem(file, 1, f"cannot be read: {error}") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        line = mark.line + 1 if mark else 1
        raise YamlProblem(file, line, f"not YAML: {getattr(error, 'problem', None) or error}") from None
    start = yaml.Mark(str(file), 0, 0, 0, None, 0)
    return YamlPlace(file, node or yaml.ScalarNode("tag:yaml.org,2002:null", "", start))


def _shortened(file: Path) -> Path:
    return file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file
