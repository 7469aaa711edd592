"""Reads a launch file into a list of nodes to start, or reports everything that is wrong with it.

The keys are those of ROS 2's YAML launch files: a list of ``arg``, ``let``, ``node``, ``include`` and ``group`` under
``launch:``; docs/launch.md lists them.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from instant_ic import paths
from instant_ic.launch.source import LaunchFileError, Problem, Value, load
from instant_ic.launch.substitutions import Context, SubstitutionError, has_substitution, substitute, truth

_ACTIONS = ("arg", "let", "node", "include", "group")
_CONDITION = ("if", "unless")
_MAX_INCLUDE_DEPTH = 8
_NODE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")  # what the bus accepts

_NODE_MAIN = Path(__file__).with_name("node_main.py")


@dataclass(frozen=True)
class LaunchArgument:
    """An ``arg`` of a launch file; ``default`` is None where a value must be given."""

    name: str
    default: str | None
    description: str
    line: int


@dataclass(frozen=True)
class NodeSpec:
    """One process to start.

    Attributes:
        name: its name on the bus, unique in the stack whatever its namespace.
        namespace: put before its topics.
        exec: module of ``instant_ic.nodes``, or the path of a Python file.
        command: the whole command line, without the run directory.
        env: environment variables to add.
        respawn: start it again when it ends.
        respawn_delay_s: wait before the first new start; doubles with each one within the window.
        required: when it ends, the whole stack ends.
        file: the launch file that asks for it.
        line: line in that file.
    """

    name: str
    exec: str
    command: tuple[str, ...]
    namespace: str = ""
    env: Mapping[str, str] = field(default_factory=dict)
    respawn: bool = False
    respawn_delay_s: float = 1.0
    required: bool = False
    file: Path = Path()
    line: int = 0


@dataclass(frozen=True)
class LaunchDescription:
    """What a launch file asks for, once its arguments are known."""

    file: Path
    arguments: tuple[LaunchArgument, ...]
    values: Mapping[str, str]
    nodes: tuple[NodeSpec, ...]


def find_launch_file(name: str) -> Path:
    """A launch file by path, or by the name of a shipped one (``sim`` or ``sim.yaml``).

    Raises:
        FileNotFoundError: neither; the message lists the shipped ones.
    """
    path = Path(name)
    if path.is_file():
        return path.resolve()
    if path.name == name:
        return paths.shipped_file("launch", name if path.suffix else f"{name}.yaml")
    raise FileNotFoundError(f"{name} does not exist")


def read_launch_file(
    file: Path, arguments: Mapping[str, str] | None = None, run_dir: Path | None = None
) -> LaunchDescription:
    """Reads and checks a launch file with everything that it includes.

    Args:
        file: the launch file.
        arguments: values for its ``arg`` entries.
        run_dir: run directory that ``$(run-dir)`` stands for; default ``paths.run_dir()``.

    Raises:
        LaunchFileError: with every mistake found, in file order.
    """
    reader = _Reader(run_dir or paths.run_dir())
    given = dict(arguments or {})
    declared, values = reader.read(file.resolve(), given, depth=0)
    for name in given:
        if name not in {argument.name for argument in declared}:
            known = ", ".join(argument.name for argument in declared) or "none"
            reader.problems.append(Problem(file, 1, f"there is no argument {name!r} (arguments: {known})"))
    seen: dict[str, NodeSpec] = {}
    for node in reader.nodes:
        if node.name in seen:
            first = seen[node.name]
            text = f"a node named {node.name!r} is already started in line {first.line} of {first.file.name}"
            reader.problems.append(Problem(node.file, node.line, text))
        seen.setdefault(node.name, node)
    if reader.problems:
        raise LaunchFileError(sorted(reader.problems, key=lambda problem: (str(problem.file), problem.line)))
    return LaunchDescription(file, tuple(declared), values, tuple(reader.nodes))


def read_arguments(file: Path) -> tuple[LaunchArgument, ...]:
    """Only the ``arg`` entries of a launch file, whatever else is in it.

    Raises:
        LaunchFileError: the file cannot be read.
    """
    problems: list[Problem] = []
    root = load(file, problems)
    if root is None:
        raise LaunchFileError(problems)
    found: list[LaunchArgument] = []
    for action in root.fields().get("launch", root).items() if root.is_mapping else []:
        for kind, body in action.fields().items():
            if kind == "arg":
                fields = body.fields()
                texts = {key: value.text() for key, value in fields.items()}
                found.append(
                    LaunchArgument(
                        texts.get("name") or "", texts.get("default"), texts.get("description") or "", body.line
                    )
                )
    return tuple(found)


class _Reader:
    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.problems: list[Problem] = []
        self.nodes: list[NodeSpec] = []

    def read(self, file: Path, given: dict[str, str], depth: int) -> tuple[list[LaunchArgument], Mapping[str, str]]:
        """Reads one file; returns the arguments that it declares and the values of its variables."""
        context = Context(file, self.run_dir)
        declared: list[LaunchArgument] = []
        root = load(file, self.problems)
        if root is not None:
            body = root.fields(known=("launch",), required=("launch",)).get("launch")
            if body is not None:
                self._actions(body, context, namespace="", given=given, declared=declared, depth=depth)
        return declared, context.variables

    def _actions(
        self,
        body: Value,
        context: Context,
        namespace: str,
        given: dict[str, str],
        declared: list[LaunchArgument],
        depth: int,
    ) -> None:
        for entry in body.items():
            fields = entry.fields(known=_ACTIONS)
            if entry.is_mapping and len(fields) != 1 and not self._noted_at(entry):
                entry.problem(f"each entry is one of {', '.join(_ACTIONS)}")
            for kind, value in fields.items():
                match kind:
                    case "arg":
                        self._arg(value, context, given, declared)
                    case "let":
                        self._let(value, context)
                    case "node":
                        self._node(value, context, namespace)
                    case "include":
                        self._include(value, context, depth)
                    case "group":
                        self._group(value, context, namespace, given, declared, depth)

    def _arg(self, body: Value, context: Context, given: dict[str, str], declared: list[LaunchArgument]) -> None:
        fields = body.fields(known=("name", "default", "description"), required=("name",))
        name = self._plain_text(fields.get("name"))
        if not name:
            return
        if any(argument.name == name for argument in declared):
            body.problem(f"argument {name!r} is declared a second time")
            return
        default = self._text(fields.get("default"), context)
        description = self._plain_text(fields.get("description")) or ""
        declared.append(LaunchArgument(name, default, description, body.line))
        if name in given:
            context.variables[name] = given[name]
        elif "default" in fields:
            context.variables[name] = default or ""
        else:
            body.problem(f"argument {name!r} has no default: give {name}:=VALUE")
            context.variables[name] = ""

    def _let(self, body: Value, context: Context) -> None:
        fields = body.fields(known=("name", "value", *_CONDITION), required=("name", "value"))
        name = self._plain_text(fields.get("name"))
        value = self._text(fields.get("value"), context)
        if name and value is not None and self._holds(fields, context):
            context.variables[name] = value

    def _group(
        self,
        body: Value,
        context: Context,
        namespace: str,
        given: dict[str, str],
        declared: list[LaunchArgument],
        depth: int,
    ) -> None:
        if body.is_list:
            self._actions(body, context.child(), namespace, given, declared, depth)
            return
        fields = body.fields(known=("launch", "namespace", *_CONDITION), required=("launch",))
        inner_namespace = _join(namespace, self._text(fields.get("namespace"), context) or "")
        inside = fields.get("launch")
        if inside is not None and self._holds(fields, context):
            self._actions(inside, context.child(), inner_namespace, given, declared, depth)

    def _include(self, body: Value, context: Context, depth: int) -> None:
        fields = body.fields(known=("file", "arg", "let", *_CONDITION), required=("file",))
        name = self._text(fields.get("file"), context)
        given: dict[str, str] = {}
        for key in ("arg", "let"):
            for entry in fields[key].items() if key in fields else []:
                pair = entry.fields(known=("name", "value"), required=("name", "value"))
                argument = self._plain_text(pair.get("name"))
                value = self._text(pair.get("value"), context)
                if argument and value is not None:
                    given[argument] = value
        if name is None or not self._holds(fields, context):
            return
        file = self._find(name, context)
        if file is None:
            fields["file"].problem(f"launch file {name} does not exist")
        elif depth >= _MAX_INCLUDE_DEPTH:
            fields["file"].problem(f"files include each other more than {_MAX_INCLUDE_DEPTH} deep")
        else:
            declared, _ = self.read(file, given, depth + 1)
            for argument in given:
                if argument not in {entry.name for entry in declared}:
                    body.problem(f"{file.name} has no argument {argument!r}")

    def _find(self, name: str, context: Context) -> Path | None:
        beside = context.launch_file.parent / name
        if beside.is_file():
            return beside.resolve()
        try:
            return find_launch_file(name)
        except FileNotFoundError:
            return None

    def _node(self, body: Value, context: Context, namespace: str) -> None:
        known = (
            *("exec", "name", "namespace", "param", "remap", "env", "args"),
            *("respawn", "respawn_delay", "required", *_CONDITION),
        )
        fields = body.fields(known=known, required=("exec",))
        executable = self._text(fields.get("exec"), context)
        name = self._text(fields.get("name"), context) or Path(executable or "").stem
        if namespace_field := self._text(fields.get("namespace"), context):
            namespace = _join(namespace, namespace_field)
        if executable and not _NODE_NAME.fullmatch(name):
            body.problem(f"node name {name!r} is not legal: letters, digits and underscores only")
        start = self._program(fields["exec"], executable, context) if executable else None
        options: list[str] = ["--name", name]
        if namespace:
            options += ["--namespace", namespace]
        for entry in fields["param"].items() if "param" in fields else []:
            options += self._parameter(entry, context)
        for entry in fields["remap"].items() if "remap" in fields else []:
            pair = self._pair(entry, "from", "to", context)
            if pair is not None:
                options += ["-r", f"{pair[0]}:={pair[1]}"]
        env: dict[str, str] = {}
        for entry in fields["env"].items() if "env" in fields else []:
            pair = self._pair(entry, "name", "value", context)
            if pair is not None:
                env[pair[0]] = pair[1]
        options += self._arguments(fields.get("args"), context)
        respawn = self._flag(fields.get("respawn"), context)
        required = self._flag(fields.get("required"), context)
        delay = self._number(fields.get("respawn_delay"), context, default=1.0)
        if not self._holds(fields, context) or start is None or not executable:
            return
        self.nodes.append(
            NodeSpec(
                name=name,
                namespace=namespace,
                exec=executable,
                command=(*start, *options),
                env=env,
                respawn=respawn,
                respawn_delay_s=delay,
                required=required,
                file=body.file,
                line=body.line,
            )
        )

    def _program(self, value: Value, executable: str, context: Context) -> tuple[str, ...] | None:
        if executable.endswith(".py"):
            file = context.launch_file.parent / executable
            if file.is_file():
                return (sys.executable, str(file.resolve()))
            value.problem(f"program {executable} does not exist beside the launch file")
            return None
        if executable.isidentifier() and importlib.util.find_spec(f"instant_ic.nodes.{executable}"):
            return (sys.executable, str(_NODE_MAIN), f"instant_ic.nodes.{executable}")
        value.problem(f"unknown exec {executable!r} (nodes: {', '.join(known_nodes()) or 'none'})")
        return None

    def _arguments(self, value: Value | None, context: Context) -> list[str]:
        text = self._text(value, context)
        if value is None or not text:
            return []
        try:
            return shlex.split(text)
        except ValueError as error:
            value.problem(f"args {text!r}: {error}")
            return []

    def _parameter(self, entry: Value, context: Context) -> list[str]:
        fields = entry.fields(known=("name", "value", "type", "from", *_CONDITION))
        if not entry.is_mapping or not self._holds(fields, context):
            return []
        if "from" in fields:
            file = self._text(fields["from"], context)
            if file is None:
                return []
            path = context.launch_file.parent / file  # an absolute path replaces the folder
            self._check_parameter_file(path, fields["from"])
            return ["--params-file", str(path)]
        name = self._plain_text(fields.get("name"))
        if not name or "value" not in fields:
            entry.problem("a parameter needs name and value, or from: FILE")
            return []
        kind = self._plain_text(fields.get("type")) or ""
        value = self._parameter_value(fields["value"], kind, context)
        return ["-p", f"{name}:={_as_yaml(value)}"]

    def _parameter_value(self, value: Value, kind: str, context: Context) -> object:
        if value.is_list or value.is_mapping:
            return self._substituted(value.plain(), value, context)
        text = self._text(value, context)
        if text is None:
            return None
        readers: dict[str, Callable[[str], object]] = {
            "str": str,
            "int": int,
            "float": float,
            "bool": truth,
            "": yaml.safe_load,
        }
        if kind not in readers:
            value.problem(f"unknown type {kind!r} (types: str, int, float, bool)")
            return None
        # Quoted text, and nothing at all, stay text; the rest is read as YAML reads it.
        if kind == "" and ((value.is_quoted and not has_substitution(value.text() or "")) or not text):
            return text
        try:
            return readers[kind](text)
        except (ValueError, yaml.YAMLError):
            value.problem(f"{text!r} is not of type {kind or 'YAML'}")
            return None

    def _substituted(self, plain: object, value: Value, context: Context) -> object:
        if isinstance(plain, str):
            return self._replace(plain, value, context)
        if isinstance(plain, list):
            return [self._substituted(entry, value, context) for entry in plain]
        if isinstance(plain, dict):
            return {key: self._substituted(entry, value, context) for key, entry in plain.items()}
        return plain

    def _check_parameter_file(self, path: Path, value: Value) -> None:
        if not path.is_file():
            value.problem(f"parameter file {path} does not exist")
            return
        root = load(path, self.problems)
        if root is None:
            return
        for node_name, section in root.fields().items():
            if not section.is_mapping or "ros__parameters" not in section.fields():
                section.problem(f"section {node_name!r} has no ros__parameters: key")

    def _pair(self, entry: Value, first: str, second: str, context: Context) -> tuple[str, str] | None:
        fields = entry.fields(known=(first, second), required=(first, second))
        one, two = self._text(fields.get(first), context), self._text(fields.get(second), context)
        return (one, two) if one and two is not None else None

    def _holds(self, fields: Mapping[str, Value], context: Context) -> bool:
        """Whether ``if`` and ``unless`` let this entry through."""
        return self._flag(fields.get("if"), context, default=True) and not self._flag(fields.get("unless"), context)

    def _flag(self, value: Value | None, context: Context, default: bool = False) -> bool:
        text = self._text(value, context)
        if value is None or text is None:
            return default
        try:
            return truth(text)
        except SubstitutionError as error:
            value.problem(str(error))
            return default

    def _number(self, value: Value | None, context: Context, default: float) -> float:
        text = self._text(value, context)
        if value is None or text is None:
            return default
        try:
            number = float(text)
        except ValueError:
            value.problem(f"expected a number, got {text!r}")
            return default
        if not 0 <= number < float("inf"):
            value.problem(f"must be a number of seconds >= 0, got {text!r}")
            return default
        return number

    def _text(self, value: Value | None, context: Context) -> str | None:
        """The value's text with its substitutions done; None where there is none or it is wrong (noted)."""
        text = value.text() if value is not None else None
        return self._replace(text, value, context) if value is not None and text is not None else None

    def _replace(self, text: str, value: Value, context: Context) -> str | None:
        try:
            return substitute(text, context)
        except SubstitutionError as error:
            value.problem(str(error))
            return None

    @staticmethod
    def _plain_text(value: Value | None) -> str | None:
        return value.text() if value is not None else None

    def _noted_at(self, entry: Value) -> bool:
        """Whether a mistake in this entry's own keys is already on the list."""
        first, last = entry.line, entry.node.end_mark.line + 1
        return any(problem.file == entry.file and first <= problem.line <= last for problem in self.problems)


def known_nodes() -> list[str]:
    """Names of the modules in ``instant_ic.nodes``."""
    spec = importlib.util.find_spec("instant_ic.nodes")
    folders = [Path(location) for location in (spec.submodule_search_locations or [])] if spec else []
    return sorted({file.stem for folder in folders for file in folder.glob("*.py") if file.stem[0] != "_"})


def _as_yaml(value: object) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True, width=1 << 20)
    return text.removesuffix("...\n").rstrip("\n")


def _join(namespace: str, name: str) -> str:
    if name.startswith("/") or not namespace:
        return name
    return f"{namespace.rstrip('/')}/{name}"
