"""Read the ``node`` entries of launch files."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from instant_ic.config.scalars import Scalar, is_null
from instant_ic.config.yaml_place import YamlPlace
from instant_ic.config.yaml_text import one_line, read_spelled
from instant_ic.launch.description import HANG_TIMEOUT_S, NodeSpec
from instant_ic.launch.substitutions import SubstitutionError, substitute, truth
from instant_ic.util import paths

NODE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""Node names that the bus accepts."""

NODE_MAIN = Path(__file__).with_name("node_main.py")
CONDITION = ("if", "unless")
"""Keys that decide whether an entry counts."""
_NODE_KEYS = (
    *("exec", "name", "param", "remap", "env", *CONDITION),
    *("respawn", "respawn_delay", "required", "hang_timeout"),
)


@dataclass
class Scope:
    """Settings of one file or group.

    Attributes:
        file: the launch file.
        run_dir: run directory of the stack, or of its group.
        variables: values of the arguments and ``let`` entries in scope.
        group: name of the group's run directory within the stack's; empty: the stack's own.
        options: ``--params-file`` arguments for each node.
    """

    file: Path
    run_dir: Path
    variables: dict[str, str] = field(default_factory=dict)
    group: str = ""
    options: list[str] = field(default_factory=list)

    def child(self) -> Scope:
        """Return a copy that can change independently."""
        return dataclasses.replace(self, variables=dict(self.variables), options=list(self.options))

    def text(self, value: YamlPlace | None) -> str:
        """Return a value's text after substitution; empty without a value."""
        return "" if value is None else self.substituted(value.text(), value)

    def substituted(self, text: str, value: YamlPlace) -> str:
        """Return ``text`` after substitution; errors name the place of ``value``."""
        try:
            return substitute(text, self.variables, self.run_dir)
        except SubstitutionError as error:
            raise value.problem(str(error)) from None

    def flag(self, value: YamlPlace | None) -> bool:
        """Return a truth value; false without a value."""
        try:
            return truth(self.text(value))
        except SubstitutionError as error:
            assert value is not None
            raise value.problem(str(error)) from None

    def holds(self, fields: Mapping[str, YamlPlace]) -> bool:
        """Return whether the entry's ``if`` and ``unless`` hold."""
        return ("if" not in fields or self.flag(fields["if"])) and not self.flag(fields.get("unless"))

    def seconds(self, value: YamlPlace | None, default: float) -> float:
        """Return a number of seconds >= 0."""
        if value is None:
            return default
        text = self.text(value)
        try:
            number = float(text)
        except ValueError:
            number = math.nan
        if not 0 <= number < math.inf:
            raise value.problem(f"expected a number of seconds >= 0, got {text!r}")
        return number

    def pairs(self, value: YamlPlace | None, first: str, second: str) -> list[tuple[str, str]]:
        """Return the texts of the keys ``first`` and ``second`` of each entry of a list."""
        found = [] if value is None else [entry.fields((first, second), (first, second)) for entry in value.items()]
        return [(self.text(fields[first]), self.text(fields[second])) for fields in found]


def read_node(body: YamlPlace, scope: Scope) -> NodeSpec | None:
    """Read a ``node``; None if its conditions do not hold.

    Raises:
        YamlProblem: the first mistake in the entry.
    """
    fields = body.fields(_NODE_KEYS, required=("exec",))
    executable = scope.text(fields["exec"])
    name = scope.text(fields.get("name")) or Path(executable).stem
    start = _program(fields["exec"], executable, scope.file)
    if not NODE_NAME.fullmatch(name):
        raise body.problem(f"node name {name!r} is not legal: letters, digits and underscores only")
    options = ["--name", name, *scope.options]
    places: dict[str, str] = {}
    for entry in fields["param"].items() if "param" in fields else []:
        options += _parameter(entry, scope, places)
    for source, target in scope.pairs(fields.get("remap"), "from", "to"):
        options += ["-r", f"{source}:={target}"]
    spec = NodeSpec(
        name=name,
        exec=executable,
        command=(*start, *options),
        env=dict(scope.pairs(fields.get("env"), "name", "value")),
        respawn=scope.flag(fields.get("respawn")),
        respawn_delay_s=scope.seconds(fields.get("respawn_delay"), 1.0),
        required=scope.flag(fields.get("required")),
        file=body.file,
        line=body.line,
        run_dir=scope.run_dir if scope.group else None,
        group=scope.group,
        hang_timeout_s=scope.seconds(fields.get("hang_timeout"), HANG_TIMEOUT_S),
        places=places,
    )
    return spec if scope.holds(fields) else None


def parameter_file(value: YamlPlace, scope: Scope) -> list[str]:
    """Return the command-line arguments that pass a parameter file to a node."""
    path = scope.file.parent / scope.text(value)  # an absolute path replaces the folder
    if not paths.is_file(path):
        raise value.problem(f"parameter file {path} does not exist")
    return ["--params-file", str(path)]


def _program(value: YamlPlace, executable: str, launch_file: Path) -> tuple[str, ...]:
    if executable.endswith(".py"):
        file = launch_file.parent / executable
        if not paths.is_file(file):
            raise value.problem(f"program {executable} does not exist beside the launch file")
        return (sys.executable, str(file.resolve()))
    if executable not in paths.node_names():
        raise value.problem(f"unknown exec {executable!r} (nodes: {', '.join(paths.node_names())})")
    return (sys.executable, str(NODE_MAIN), str(paths.node_file(executable)))


def _parameter(entry: YamlPlace, scope: Scope, places: dict[str, str]) -> list[str]:
    """Return the arguments for one entry of ``param``; record in ``places`` the line that sets a single parameter."""
    fields = entry.fields(("name", "value", "type", "from", *CONDITION))
    if not scope.holds(fields):
        return []
    if "from" in fields:
        return parameter_file(fields["from"], scope)
    if "name" not in fields or "value" not in fields:
        raise entry.problem("a parameter needs name and value, or from: FILE")
    kind = fields["type"].text() if "type" in fields else ""
    word = f"{fields['name'].text()}:={one_line(_parameter_value(fields['value'], kind, scope))}"
    places[word] = entry.place
    return ["-p", word]


_READERS: dict[str, Callable[[str], object]] = {
    "str": str,
    "int": int,
    "float": float,
    "bool": truth,
    "": read_spelled,
}


def _parameter_value(value: YamlPlace, kind: str, scope: Scope) -> object:
    """Return a parameter's value as the type ``kind``; without one, as YAML reads it."""
    if not value.is_single:
        return _texts_replaced(value, scope)
    text = scope.text(value)
    if kind not in _READERS:
        raise value.problem(f"unknown type {kind!r} (types: str, int, float, bool)")
    # Quoted text and empty text stay text; everything else is read as YAML.
    if kind == "" and ((value.is_quoted and "$(" not in value.text()) or not text):
        return text
    try:
        return _READERS[kind](text)
    except (ValueError, yaml.YAMLError):
        raise value.problem(f"{text!r} is not of type {kind or 'YAML'}") from None


def _texts_replaced(value: YamlPlace, scope: Scope) -> object:
    """Return a list or mapping with all its texts after substitution."""

    def read(plain: object) -> object:
        if isinstance(plain, (str, Scalar)) and not is_null(plain):
            text = scope.substituted(str(plain), value)
            return Scalar(text) if text and isinstance(plain, Scalar) else text
        if isinstance(plain, list):
            return [read(entry) for entry in plain]
        return {key: read(entry) for key, entry in plain.items()} if isinstance(plain, dict) else plain

    return read(value.spelled())
