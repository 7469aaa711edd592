"""Read the actions of launch files: arguments, variables, conditions, includes, groups, environment, timers.

The keys are those of ROS 2's YAML launch files; docs/launch.md lists them. Unsupported ROS 2 keys are refused with
the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from instant_ic.config.yaml_text import one_line
from instant_ic.launch import nodes
from instant_ic.launch.description import (
    Announcement,
    LaunchArgument,
    LaunchDescription,
    NodeSpec,
    Shutdown,
    find_launch_file,
)
from instant_ic.launch.nodes import Scope
from instant_ic.launch.source import LaunchFileError, Problem, Value, load
from instant_ic.launch.substitutions import Context, truth
from instant_ic.launch.values import (
    CONDITION,
    flag_of,
    holds,
    pairs_of,
    parameter_value,
    plain_text,
    seconds_of,
    text_of,
)
from instant_ic.util import paths

_MAX_INCLUDE_DEPTH = 8
_NOT_HERE = {
    "node_container": "every node is a process of its own: use node",
    "load_composable_node": "every node is a process of its own: use node",
    "lifecycle_node": "nodes have no life cycle to step through: use node, with respawn or required",
    "lifecycle_transition": "nodes have no life cycle to step through",
    "ros_timer": "use timer",
    "for": "write the entries out, or include a file several times",
    "for_each": "write the entries out, or include a file several times",
    "push_environment": "a group has an environment of its own: use group",
    "pop_environment": "a group has an environment of its own: use group",
    "reset_environment": "a group has an environment of its own: use group",
    "push_launch_configurations": "a group has variables of its own: use group",
    "pop_launch_configurations": "a group has variables of its own: use group",
    "reset_launch_configurations": "a group has variables of its own: use group",
    "set_ros_log_dir": "logs lie in the run directory: ic launch --run-dir DIR",
}
_TYPES: dict[str, Callable[[str], object]] = {"str": str, "int": int, "float": float, "bool": truth, "path": Path}


class Reader:
    """Collects the contents of a launch file and all its includes.

    Args:
        conditions: if false, read every include and group as if its conditions held, to list all arguments.
    """

    def __init__(self, run_dir: Path, given: Mapping[str, str], conditions: bool = True) -> None:
        self.problems: list[Problem] = []
        self.nodes: list[NodeSpec] = []
        self.arguments: list[LaunchArgument] = []
        self.included: list[LaunchArgument] = []
        self.announcements: list[Announcement] = []
        self.shutdown: Shutdown | None = None
        self._run_dir, self._given, self._conditions = run_dir, given, conditions

    def read_top(self, file: Path) -> dict[str, str] | None:
        """Read the top launch file; returns the values of its variables, or None if it cannot be read."""
        scope = Scope(Context(file.resolve(), self._run_dir))
        declared = self._file(file.resolve(), scope, dict(self._given), depth=0)
        if declared is None:
            return None
        self.arguments = declared
        return scope.context.variables

    def _file(self, file: Path, scope: Scope, given: dict[str, str], depth: int) -> list[LaunchArgument] | None:
        root = load(file, self.problems)
        if root is None:
            return None
        declared: list[LaunchArgument] = []
        body = root.fields(known=("launch",), required=("launch",)).get("launch")
        if body is not None:
            _Actions(self, scope, given, declared, depth, self._conditions).read(body)
        return declared

    def include(self, file: Path, scope: Scope, given: dict[str, str], place: Value, depth: int) -> None:
        """Read an included file."""
        if depth >= _MAX_INCLUDE_DEPTH:
            place.problem(f"files include each other more than {_MAX_INCLUDE_DEPTH} deep")
            return
        inner = scope.child()
        inner.context = Context(file, scope.context.run_dir, {}, dict(scope.context.environment))
        # It sees only the arguments that it is given: an argument that a file hides (a switch that is unsafe for
        # driving) stays hidden, whatever the command line says.
        declared = self._file(file, inner, given, depth + 1)
        known = {(argument.file, argument.name) for argument in self.included}
        self.included += [
            argument
            for argument in declared or []
            if argument.name not in given and (argument.file, argument.name) not in known
        ]
        for name in given:
            if declared is not None and name not in {argument.name for argument in declared}:
                place.problem(f"{file.name} has no argument {name!r}")


class _Actions:
    """The actions of one list, in one scope."""

    def __init__(
        self,
        reader: Reader,
        scope: Scope,
        given: dict[str, str],
        declared: list[LaunchArgument],
        depth: int,
        conditions: bool,
    ) -> None:
        self.reader, self.scope, self.given = reader, scope, given
        self.declared, self.depth, self.conditions = declared, depth, conditions
        self.handlers: dict[str, Callable[[Value], None]] = {
            "arg": self._arg,
            "let": self._let,
            "node": self._node,
            "executable": self._executable,
            "include": self._include,
            "group": self._group,
            "set_env": self._set_env,
            "unset_env": self._unset_env,
            "append_env": self._append_env,
            "push_ros_namespace": self._push_namespace,
            "push-ros-namespace": self._push_namespace,
            "set_remap": self._set_remap,
            "set_parameter": self._set_parameter,
            "set_parameters_from_file": self._set_parameters_from_file,
            "set_use_sim_time": self._set_use_sim_time,
            "log": self._log,
            "timer": self._timer,
            "shutdown": self._shutdown,
        }

    @property
    def context(self) -> Context:
        return self.scope.context

    def read(self, body: Value) -> None:
        for entry in body.items():
            fields = entry.fields()
            if entry.is_mapping and len(fields) != 1:
                entry.problem(f"each entry is one of {', '.join(self.handlers)}")
                continue
            for kind, value in fields.items():
                if kind in self.handlers:
                    self.handlers[kind](value)
                elif kind in _NOT_HERE:
                    value.problem(f"{kind!r} is not supported here: {_NOT_HERE[kind]}")
                else:
                    value.problem(f"unknown key {kind!r} (known: {', '.join(sorted(self.handlers))})")

    def _inside(self, body: Value, scope: Scope) -> None:
        _Actions(self.reader, scope, self.given, self.declared, self.depth, self.conditions).read(body)

    def _fields(self, body: Value, known: tuple[str, ...], required: tuple[str, ...] = ()) -> dict[str, Value] | None:
        """The fields of an action whose conditions hold; else None."""
        fields = body.fields(known=(*known, *CONDITION), required=required)
        if any(name not in fields for name in required) or not holds(fields, self.context):
            return None
        return fields

    # -- arguments and variables -----------------------------------------------------------------

    def _arg(self, body: Value) -> None:
        fields = body.fields(known=("name", "default", "description", "type", "choices", "choice"), required=("name",))
        name = plain_text(fields.get("name"))
        if not name:
            return
        if any(argument.name == name for argument in self.declared):
            body.problem(f"argument {name!r} is declared twice")
            return
        kind = plain_text(fields.get("type")) or "str"
        if kind not in _TYPES:
            fields["type"].problem(f"unknown type {kind!r} (types: {', '.join(_TYPES)})")
            kind = "str"
        argument = LaunchArgument(
            name=name,
            default=text_of(fields.get("default"), self.context),
            description=plain_text(fields.get("description")) or "",
            line=body.line,
            type=kind,
            choices=self._choices(fields),
            file=body.file,
        )
        self.declared.append(argument)
        if name in self.given:
            value = self.given[name]
            if kind == "path" and value and self.depth == 0:  # relative to the shell's folder
                value = str(Path(value).expanduser().absolute())
        elif argument.default is not None:
            value = argument.default
        else:
            if "default" not in fields:
                body.problem(f"argument {name!r} has no default: give {name}:=VALUE")
            self.context.variables[name] = ""
            return
        self.context.variables[name] = self._checked(value, argument, body)

    def _choices(self, fields: Mapping[str, Value]) -> tuple[str, ...]:
        """``choices: [a, b]``, or ROS 2's ``choice: [{value: a}, {value: b}]``."""
        found = [entry.text() for entry in fields["choices"].items()] if "choices" in fields else []
        for entry in fields["choice"].items() if "choice" in fields else []:
            found.append(text_of(entry.fields(known=("value",), required=("value",)).get("value"), self.context))
        return tuple(text for text in found if text is not None)

    @staticmethod
    def _checked(value: str, argument: LaunchArgument, body: Value) -> str:
        """The value if the argument allows it; else an allowed one, so that the mistake is reported only once."""
        if value == "" == argument.default:
            return value
        if argument.choices and value not in argument.choices:
            body.problem(f"argument {argument.name!r} must be one of {', '.join(argument.choices)} (got {value!r})")
            return argument.choices[0]
        try:
            _TYPES[argument.type](value)
        except ValueError:
            body.problem(f"argument {argument.name!r} must be of type {argument.type} (got {value!r})")
            return argument.default if argument.default not in (None, value) else "0"
        return str(Path(value).expanduser()) if argument.type == "path" else value

    def _let(self, body: Value) -> None:
        if (fields := self._fields(body, ("name", "value"), ("name", "value"))) is None:
            return
        name, value = plain_text(fields["name"]), text_of(fields["value"], self.context)
        if name and value is not None:
            self.context.variables[name] = value

    # -- groups and files ------------------------------------------------------------------------

    def _group(self, body: Value) -> None:
        if body.is_list:
            self._inside(body, self.scope.child())
            return
        known = ("launch", "children", "namespace", "run_dir", "scoped", *CONDITION)
        fields = body.fields(known=known)
        inside = fields.get("launch", fields.get("children"))
        if inside is None:
            body.problem("'launch' is missing")
            return
        if self.conditions and not holds(fields, self.context):
            return
        scope = self.scope.child() if flag_of(fields.get("scoped"), self.context, default=True) else self.scope
        if namespace := text_of(fields.get("namespace"), self.context):
            scope.namespace = nodes.join_namespace(scope.namespace, namespace)
        if "run_dir" in fields:
            name = text_of(fields["run_dir"], self.context) or ""
            if not nodes.NODE_NAME.fullmatch(name) or name in ("topics", "nodes", "dev", "log"):
                fields["run_dir"].problem(
                    f"run_dir {name!r}: give a name of letters, digits and underscores, none of topics, nodes, dev, log"
                )
            else:
                scope.context.run_dir = scope.context.run_dir / name
                scope.group = f"{scope.group}/{name}".strip("/")
        self._inside(inside, scope)

    def _include(self, body: Value) -> None:
        fields = body.fields(known=("file", "arg", "let", *CONDITION), required=("file",))
        name = text_of(fields.get("file"), self.context)
        entries = [pairs_of(fields.get(key), "name", "value", self.context) for key in ("arg", "let")]
        given = dict(pair for pairs in entries for pair in pairs)
        if name is None or (self.conditions and not holds(fields, self.context)):
            return
        file = self._find(name)
        if file is None:
            fields["file"].problem(f"launch file {name} does not exist")
        elif file.suffix in (".py", ".xml"):
            fields["file"].problem(f"{name}: only YAML launch files are read")
        else:
            self.reader.include(file, self.scope, given, fields["file"], self.depth)

    def _find(self, name: str) -> Path | None:
        beside = self.context.launch_file.parent / name
        if paths.is_file(beside):
            return beside.resolve()
        try:
            return find_launch_file(name)
        except FileNotFoundError:
            return None

    # -- processes -------------------------------------------------------------------------------

    def _node(self, body: Value) -> None:
        self._start(nodes.read_node(body, self.scope))

    def _executable(self, body: Value) -> None:
        taken = {node.name for node in self.reader.nodes if node.run_dir == self.scope.run_dir}
        self._start(nodes.read_executable(body, self.scope, taken))

    def _start(self, spec: NodeSpec | None) -> None:
        self.reader.nodes += [spec] if spec is not None else []

    # -- settings for the processes that follow ------------------------------------------------------

    def _set_env(self, body: Value) -> None:
        if fields := self._fields(body, ("name", "value"), ("name", "value")):
            self._put_env(plain_text(fields["name"]), text_of(fields["value"], self.context))

    def _unset_env(self, body: Value) -> None:
        if (fields := self._fields(body, ("name",), ("name",))) and (name := plain_text(fields["name"])):
            self.scope.env[name] = None
            self.context.environment.pop(name, None)

    def _append_env(self, body: Value) -> None:
        fields = self._fields(body, ("name", "value", "prepend", "separator"), ("name", "value"))
        if fields is None:
            return
        name, value = plain_text(fields["name"]), text_of(fields["value"], self.context)
        before = self.context.environment.get(name or "")
        if before is not None and value is not None:
            separator = plain_text(fields.get("separator")) or ":"
            first = flag_of(fields.get("prepend"), self.context)
            value = f"{value}{separator}{before}" if first else f"{before}{separator}{value}"
        self._put_env(name, value)

    def _put_env(self, name: str | None, value: str | None) -> None:
        if name and value is not None:
            self.scope.env[name] = self.context.environment[name] = value

    def _push_namespace(self, body: Value) -> None:
        if (fields := self._fields(body, ("namespace",), ("namespace",))) and (
            namespace := text_of(fields["namespace"], self.context)
        ):
            self.scope.namespace = nodes.join_namespace(self.scope.namespace, namespace)

    def _set_remap(self, body: Value) -> None:
        if fields := self._fields(body, ("from", "to"), ("from", "to")):
            source, target = text_of(fields["from"], self.context), text_of(fields["to"], self.context)
            self.scope.options += ["-r", f"{source}:={target}"] if source and target else []

    def _set_parameter(self, body: Value) -> None:
        if fields := self._fields(body, ("name", "value"), ("name", "value")):
            value = parameter_value(fields["value"], "", self.context)
            self.scope.options += ["-p", f"{plain_text(fields['name'])}:={one_line(value)}"]

    def _set_parameters_from_file(self, body: Value) -> None:
        if fields := self._fields(body, ("filename",), ("filename",)):
            self.scope.options += nodes.parameter_file(fields["filename"], self.context)

    def _set_use_sim_time(self, body: Value) -> None:
        if fields := self._fields(body, ("value",), ("value",)):
            self.scope.options += ["-p", f"use_sim_time:={str(flag_of(fields['value'], self.context)).lower()}"]

    # -- actions of the launcher itself --------------------------------------------------------------

    def _log(self, body: Value) -> None:
        if (fields := self._fields(body, ("message", "level"), ("message",))) and (
            text := text_of(fields["message"], self.context)
        ) is not None:
            self.reader.announcements.append(Announcement(text, self.scope.delay_s))

    def _timer(self, body: Value) -> None:
        known = ("period", "launch", "children")
        if (fields := self._fields(body, known, ("period",))) is None:
            return
        period_s = seconds_of(fields["period"], self.context)
        inside = fields.get("launch", fields.get("children"))
        if inside is None:
            body.problem("'launch' is missing")
        elif period_s is not None:
            scope = self.scope.child()
            scope.delay_s += period_s
            self._inside(inside, scope)

    def _shutdown(self, body: Value) -> None:
        fields = {} if body.is_null else self._fields(body, ("reason",))
        if fields is None:
            return
        reason = text_of(fields.get("reason"), self.context) or "requested by the launch file"
        if self.reader.shutdown is None or self.scope.delay_s < self.reader.shutdown.delay_s:
            self.reader.shutdown = Shutdown(reason, self.scope.delay_s)


def read_launch_file(
    file: Path, arguments: Mapping[str, str] | None = None, run_dir: Path | None = None
) -> LaunchDescription:
    """Read and check a launch file with everything that it includes.

    Args:
        run_dir: value of ``$(run-dir)``; default: ``paths.run_dir()``.

    Raises:
        LaunchFileError: all mistakes found, in file order.
    """
    given = dict(arguments or {})
    reader = Reader(run_dir or paths.run_dir(), given)
    values = reader.read_top(file)
    own = {argument.name for argument in reader.arguments}
    inner = {argument.name: argument.file.name for argument in reader.included}
    for name in given:
        if name not in own:
            hint = f"; {inner[name]} has one: declare it here and hand it to the include" if name in inner else ""
            text = f"there is no argument {name!r} (arguments: {', '.join(sorted(own)) or 'none'}){hint}"
            reader.problems.append(Problem(file, 1, text))
    seen: dict[tuple[Path | None, str], NodeSpec] = {}
    for node in reader.nodes:
        key = (node.run_dir, node.name)
        if key in seen:
            first = seen[key]
            text = f"a node named {node.name!r} is already started in line {first.line} of {first.file.name}"
            reader.problems.append(Problem(node.file, node.line, text))
        seen.setdefault(key, node)
    if reader.problems:
        raise LaunchFileError(sorted(set(reader.problems), key=lambda problem: (str(problem.file), problem.line)))
    return LaunchDescription(
        file, tuple(reader.arguments), values or {}, tuple(reader.nodes), tuple(reader.announcements), reader.shutdown
    )


def read_arguments(file: Path, included: bool = False) -> tuple[LaunchArgument, ...]:
    """The ``arg`` entries of a launch file, whatever else it contains.

    Args:
        included: return those of the included files instead, as far as this file leaves them at their defaults.

    Raises:
        LaunchFileError: the file cannot be read.
    """
    reader = Reader(paths.run_dir(), {}, conditions=False)
    if reader.read_top(file) is None:
        raise LaunchFileError(reader.problems)
    return tuple(reader.included if included else reader.arguments)
