"""Read launch files: arguments, variables, nodes, includes and groups.

The keys are those of ROS 2's YAML launch files, as far as they are supported; docs/launch.md lists them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from instant_ic.config.yaml_place import YamlPlace, YamlProblem, load
from instant_ic.launch.description import LaunchArgument, LaunchDescription, LaunchFileError, NodeSpec, find_launch_file
from instant_ic.launch.nodes import CONDITION, NODE_NAME, Scope, parameter_file, read_node
from instant_ic.launch.substitutions import truth
from instant_ic.util import paths

_MAX_INCLUDE_DEPTH = 8
_TYPES: dict[str, Callable[[str], object]] = {"str": str, "int": int, "float": float, "bool": truth, "path": Path}


class _FileReader:
    """A reader of the entries of one launch file.

    Args:
        nodes: list to which the nodes are added; shared with the included files.
        problems: list to which the first mistake of each entry is added; shared with the included files.
        given: values of the file's arguments.
        depth: number of files through which this file is included.
    """

    def __init__(
        self, nodes: list[NodeSpec], problems: list[YamlProblem], given: Mapping[str, str], depth: int = 0
    ) -> None:
        self.arguments: dict[str, LaunchArgument] = {}
        self._nodes, self._problems, self._given, self._depth = nodes, problems, given, depth
        self._actions: dict[str, Callable[[YamlPlace, Scope], None]] = {
            "arg": self._arg,
            "let": self._let,
            "node": self._node,
            "include": self._include,
            "group": self._group,
            "set_parameters_from_file": self._set_parameters_from_file,
        }

    def read(self, scope: Scope) -> None:
        """Read the scope's file.

        Raises:
            YamlProblem: the file as a whole cannot be read.
        """
        self._entries(load(scope.file).fields(("launch",), ("launch",))["launch"], scope)

    def _entries(self, body: YamlPlace, scope: Scope) -> None:
        for entry in body.items():
            try:
                fields = entry.fields(self._actions)
                if len(fields) != 1:
                    raise entry.problem(f"each entry is one of {', '.join(self._actions)}")
                [(action, value)] = fields.items()
                self._actions[action](value, scope)
            except YamlProblem as problem:
                self._problems.append(problem)

    def _arg(self, body: YamlPlace, scope: Scope) -> None:
        argument = _argument(body)
        if argument.name in self.arguments:
            raise body.problem(f"argument {argument.name!r} is declared twice")
        self.arguments[argument.name] = argument
        value = self._given.get(argument.name)
        if value is None and argument.default is not None:
            value = scope.substituted(argument.default, body)
        scope.variables[argument.name] = "0" if value is None or argument.type in ("int", "float") else ""
        if value is None:
            raise body.problem(f"argument {argument.name!r} has no default: give {argument.name}:=VALUE")
        if value or argument.default != "":
            try:
                _TYPES[argument.type](value)
            except ValueError:
                text = f"argument {argument.name!r} must be of type {argument.type} (got {value!r})"
                raise body.problem(text) from None
        if argument.type == "path" and value:
            on_command_line = argument.name in self._given and self._depth == 0
            file = Path(value).expanduser()
            value = str(file.absolute() if on_command_line else file)  # relative to the shell's folder
        scope.variables[argument.name] = value

    def _let(self, body: YamlPlace, scope: Scope) -> None:
        fields = body.fields(("name", "value", *CONDITION), ("name", "value"))
        if scope.holds(fields):
            scope.variables[fields["name"].text()] = scope.text(fields["value"])

    def _node(self, body: YamlPlace, scope: Scope) -> None:
        spec = read_node(body, scope)
        if spec is None:
            return
        for other in self._nodes:
            if (other.run_dir, other.name) == (spec.run_dir, spec.name):
                where = f"line {other.line} of {other.file.name}"
                raise body.problem(f"a node named {spec.name!r} is already started in {where}")
        self._nodes.append(spec)

    def _set_parameters_from_file(self, body: YamlPlace, scope: Scope) -> None:
        scope.options += parameter_file(body.fields(("filename",), ("filename",))["filename"], scope)

    def _group(self, body: YamlPlace, scope: Scope) -> None:
        fields = body.fields(("launch", "run_dir", *CONDITION), ("launch",))
        if not scope.holds(fields):
            return
        inner = scope.child()
        if "run_dir" in fields:
            name = scope.text(fields["run_dir"])
            if not NODE_NAME.fullmatch(name) or name in ("topics", "nodes", "dev", "log"):
                raise fields["run_dir"].problem(
                    f"run_dir {name!r}: give a name of letters, digits and underscores, none of topics, nodes, dev, log"
                )
            inner.run_dir /= name
            inner.group = f"{inner.group}/{name}".strip("/")
        self._entries(fields["launch"], inner)

    def _include(self, body: YamlPlace, scope: Scope) -> None:
        fields = body.fields(("file", "arg", *CONDITION), ("file",))
        name = scope.text(fields["file"])
        # An included file gets only the arguments that its include names. A switch that the including file leaves out,
        # such as one that is unsafe for driving, therefore cannot be set on the command line.
        given = dict(scope.pairs(fields.get("arg"), "name", "value"))
        if not scope.holds(fields):
            return
        if self._depth >= _MAX_INCLUDE_DEPTH:
            raise body.problem(f"files include each other more than {_MAX_INCLUDE_DEPTH} deep")
        beside = scope.file.parent / name
        try:
            file = beside.resolve() if paths.is_file(beside) else find_launch_file(name)
        except FileNotFoundError:
            raise fields["file"].problem(f"launch file {name} does not exist") from None
        inner = dataclasses.replace(scope.child(), file=file, variables={})
        reader = _FileReader(self._nodes, self._problems, given, self._depth + 1)
        reader.read(inner)
        if unknown := [name for name in given if name not in reader.arguments]:
            raise fields["arg"].problem(f"{file.name} has no argument {unknown[0]!r}")


def _argument(body: YamlPlace) -> LaunchArgument:
    """Read an ``arg`` entry. Its default may still contain substitutions."""
    fields = body.fields(("name", "default", "description", "type"), ("name",))
    kind = fields["type"].text() if "type" in fields else "str"
    if kind not in _TYPES:
        raise fields["type"].problem(f"unknown type {kind!r} (types: {', '.join(_TYPES)})")
    default = fields["default"].text() if "default" in fields else None
    description = fields["description"].text() if "description" in fields else ""
    return LaunchArgument(fields["name"].text(), default, description, kind)


def read_launch_file(
    file: Path, arguments: Mapping[str, str] | None = None, run_dir: Path | None = None
) -> LaunchDescription:
    """Read and check a launch file with all files that it includes.

    Args:
        file: the launch file.
        arguments: values of its arguments.
        run_dir: value of ``$(run-dir)``; default: ``paths.run_dir()``.

    Raises:
        LaunchFileError: the files have mistakes; it lists the first one of each entry, in file order.
    """
    given = dict(arguments or {})
    nodes: list[NodeSpec] = []
    problems: list[YamlProblem] = []
    scope = Scope(file.resolve(), run_dir or paths.run_dir())
    reader = _FileReader(nodes, problems, given)
    try:
        reader.read(scope)
    except YamlProblem as problem:
        problems.append(problem)
    have = ", ".join(sorted(reader.arguments)) or "none"
    problems += [
        YamlProblem(file, 1, f"there is no argument {name!r} (arguments: {have})")
        for name in given
        if name not in reader.arguments
    ]
    if problems:
        raise LaunchFileError(sorted(problems, key=lambda problem: (str(problem.file), problem.line)))
    return LaunchDescription(file, tuple(nodes))


def read_arguments(file: Path) -> tuple[LaunchArgument, ...]:
    """Return the ``arg`` entries of a launch file, even if other entries have mistakes.

    Raises:
        LaunchFileError: the file cannot be read, or an argument is wrong.
    """
    try:
        entries = load(file).fields(("launch",), ("launch",))["launch"].items()
        bodies = [entry.fields()["arg"] for entry in entries if "arg" in entry.fields()]
        return tuple(_argument(body) for body in bodies)
    except YamlProblem as problem:
        raise LaunchFileError([problem]) from None
