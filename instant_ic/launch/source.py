"""YAML with line numbers, and a list of everything that is wrong with it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from instant_ic.config.yaml_text import compose_yaml, spelled

_NO_VALUE = "tag:yaml.org,2002:null"


@dataclass(frozen=True)
class Problem:
    """One mistake: file, line (from 1) and text."""

    file: Path
    line: int
    text: str

    def __str__(self) -> str:
        """``file:line: text``, the format that editors and terminals understand."""
        return f"{_shorten(self.file)}:{self.line}: {self.text}"


class LaunchFileError(ValueError):
    """A launch file or its includes have mistakes; ``problems`` lists all of them."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("\n".join(str(problem) for problem in problems))
        self.problems = problems


@dataclass
class Value:
    """A place in a YAML file (scalar, mapping or list), with accessors that note problems instead of raising.

    Attributes:
        problems: list where mistakes are noted; shared by the whole launch description.
    """

    file: Path
    node: yaml.Node
    problems: list[Problem] = field(repr=False)

    @property
    def line(self) -> int:
        """Line in the file, from 1."""
        return int(self.node.start_mark.line) + 1

    @property
    def place(self) -> str:
        """``file:line``."""
        return f"{_shorten(self.file)}:{self.line}"

    def problem(self, text: str) -> None:
        self.problems.append(Problem(self.file, self.line, text))

    @property
    def is_null(self) -> bool:
        return isinstance(self.node, yaml.ScalarNode) and self.node.tag == _NO_VALUE

    @property
    def is_list(self) -> bool:
        return isinstance(self.node, yaml.SequenceNode)

    @property
    def is_mapping(self) -> bool:
        return isinstance(self.node, yaml.MappingNode)

    @property
    def is_quoted(self) -> bool:
        """Whether it is quoted (or block) text, and so never a number or a boolean."""
        return isinstance(self.node, yaml.ScalarNode) and bool(self.node.style)

    def text(self) -> str | None:
        """The scalar as written; None, with a problem noted, for lists and mappings."""
        if isinstance(self.node, yaml.ScalarNode):
            return "" if self.is_null else str(self.node.value)
        self.problem(f"expected a single value, got a {_kind(self.node)}")
        return None

    def items(self) -> list[Value]:
        """The entries of a list; empty, with a problem noted, for anything else."""
        if isinstance(self.node, yaml.SequenceNode):
            return [Value(self.file, entry, self.problems) for entry in self.node.value]
        self.problem(f"expected a list, got a {_kind(self.node)}")
        return []

    def fields(self, known: Collection[str] = (), required: Collection[str] = ()) -> dict[str, Value]:
        """Entries of a mapping; unknown (if ``known`` is given), duplicate and missing keys are noted as problems."""
        if not isinstance(self.node, yaml.MappingNode):
            self.problem(f"expected keys and values, got a {_kind(self.node)}")
            return {}
        found: dict[str, Value] = {}
        for key_node, value_node in self.node.value:
            key = Value(self.file, key_node, self.problems)
            name = key.text()
            if name is None:
                continue
            if name in found:
                key.problem(f"{name!r} is given twice (first in line {found[name].line})")
            elif known and name not in known:
                key.problem(f"unknown key {name!r} (known: {', '.join(sorted(known))})")
            else:
                found[name] = Value(self.file, value_node, self.problems)
        for name in required:
            if name not in found:
                self.problem(f"{name!r} is missing")
        return found

    def spelled(self) -> object:
        """The value with the spelling of its scalars; None, with the problem noted, if it does not fit its tag."""
        try:
            return spelled(self.node)
        except yaml.YAMLError as error:
            self.problem(f"not YAML: {error}")
            return None


def load(file: Path, problems: list[Problem]) -> Value | None:
    """Read a YAML file; None, with the problem noted, if it cannot be read."""
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        problems.append(Problem(file, 1, f"cannot be read: {reason}"))
        return None
    try:
        node = compose_yaml(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problems.append(Problem(file, mark.line + 1 if mark else 1, f"not YAML: {error.problem}"))
        return None
    except yaml.YAMLError as error:
        problems.append(Problem(file, 1, f"not YAML: {error}"))
        return None
    if node is None:
        problems.append(Problem(file, 1, "the file is empty"))
        return None
    return Value(file, node, problems)


def _kind(node: yaml.Node) -> str:
    return {yaml.ScalarNode: "single value", yaml.SequenceNode: "list", yaml.MappingNode: "mapping"}.get(
        type(node), "something else"
    )


def _shorten(file: Path) -> str:
    try:
        return str(file.relative_to(Path.cwd()))
    except ValueError:
        return str(file)
