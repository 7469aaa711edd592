"""Read ``node`` and ``executable`` entries of launch files."""

from __future__ import annotations

import dataclasses
import re
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.config.yaml_text import one_line
from instant_ic.launch.description import HANG_TIMEOUT_S, NodeSpec
from instant_ic.launch.source import Value, load
from instant_ic.launch.substitutions import Context
from instant_ic.launch.values import (
    CONDITION,
    flag_of,
    holds,
    integer_of,
    pairs_of,
    parameter_value,
    plain_text,
    seconds_of,
    text_of,
    words_of,
)
from instant_ic.util import paths

NODE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""Node names that the bus accepts."""

NODE_MAIN = Path(__file__).with_name("node_main.py")
_PROCESS_KEYS = (
    *("env", "args", "output", "cwd", "launch-prefix", "emulate_tty", "shell", "required"),
    *("respawn", "respawn_delay", "respawn_max_retries", "sigterm_timeout", "sigkill_timeout", *CONDITION),
)
_NODE_KEYS = ("pkg", "exec", "exec_name", "name", "namespace", "param", "remap", "ros_args", "hang_timeout")
_OUTPUTS = ("both", "screen", "log")


@dataclass
class Scope:
    """Settings that apply to the actions of one group or file.

    Attributes:
        context: variables, environment, files.
        namespace: prefix of its nodes' topics.
        group: name of its run directory within the stack's; empty: the stack's own.
        env: variables from ``set_env`` and ``unset_env`` (None).
        options: ``-p``, ``--params-file`` and ``-r`` arguments for each node.
        delay_s: wait after the start of the stack.
    """

    context: Context
    namespace: str = ""
    group: str = ""
    env: dict[str, str | None] = field(default_factory=dict)
    options: list[str] = field(default_factory=list)
    delay_s: float = 0.0

    def child(self) -> Scope:
        """A copy that can change independently."""
        return dataclasses.replace(self, context=self.context.child(), env=dict(self.env), options=list(self.options))

    @property
    def run_dir(self) -> Path | None:
        """Run directory of its nodes; None: the stack's own."""
        return self.context.run_dir if self.group else None


def join_namespace(namespace: str, name: str) -> str:
    """Resolve a namespace inside another; one that begins with ``/`` is absolute."""
    if name.startswith("/") or not namespace:
        return name
    return f"{namespace.rstrip('/')}/{name}"


def read_node(body: Value, scope: Scope) -> NodeSpec | None:
    """Read a ``node``; None if it is wrong or its conditions do not hold."""
    context = scope.context
    fields = body.fields(known=(*_NODE_KEYS, *_PROCESS_KEYS), required=("exec",))
    executable = text_of(fields.get("exec"), context)
    name = text_of(fields.get("name"), context) or Path(executable or "").stem
    namespace = scope.namespace
    if own := text_of(fields.get("namespace"), context):
        namespace = join_namespace(namespace, own)
    if executable and not NODE_NAME.fullmatch(name):
        body.problem(f"node name {name!r} is not legal: letters, digits and underscores only")
    if (package := text_of(fields.get("pkg"), context)) not in (None, "instant_ic"):
        fields["pkg"].problem(f"pkg {package!r}: nodes are those of instant_ic; start another program by executable")
    if flag_of(fields.get("shell"), context):
        fields["shell"].problem("a node is not started by a shell: use executable")
    start = _program(fields["exec"], executable, context) if executable else None
    options = ["--name", name, *(["--namespace", namespace] if namespace else []), *scope.options]
    places: dict[str, str] = {}
    for entry in fields["param"].items() if "param" in fields else []:
        options += _parameter(entry, context, places, prefix="")
    for source, target in pairs_of(fields.get("remap"), "from", "to", context):
        options += ["-r", f"{source}:={target}"]
    options += words_of(fields.get("args"), context)
    # ROS 2 separates its own arguments from the program's; here all of them are the node's.
    options += [word for word in words_of(fields.get("ros_args"), context) if word not in ("--ros-args", "--")]
    hang_timeout_s = seconds_of(fields.get("hang_timeout"), context)
    process = _process(fields, scope, body)
    if not holds(fields, context) or start is None or not executable:
        return None
    return NodeSpec(
        name=name,
        namespace=namespace,
        exec=executable,
        command=(*process.pop("prefix"), *start, *options),
        hang_timeout_s=HANG_TIMEOUT_S if hang_timeout_s is None else hang_timeout_s,
        places=places,
        **process,
    )


def read_executable(body: Value, scope: Scope, taken: set[str]) -> NodeSpec | None:
    """Read an ``executable`` (any program); None if it is wrong or its conditions do not hold.

    Args:
        taken: names of the processes before it.
    """
    context = scope.context
    fields = body.fields(known=("cmd", "name", *_PROCESS_KEYS), required=("cmd",))
    if flag_of(fields.get("shell"), context):
        words = ["/bin/sh", "-c", text_of(fields.get("cmd"), context) or ""]
        program = words[2].split()[0] if words[2].split() else ""
    else:
        words = words_of(fields.get("cmd"), context)
        program = words[0] if words else ""
    words += words_of(fields.get("args"), context)
    if "cmd" in fields and not program:
        fields["cmd"].problem("cmd is empty")
    name = text_of(fields.get("name"), context)
    if name is None:
        stem = re.sub(r"\W", "_", Path(program).name) or "program"
        name = next(n for i in range(1, len(taken) + 2) if (n := stem if i == 1 else f"{stem}_{i}") not in taken)
    process = _process(fields, scope, body)
    if not holds(fields, context) or not program:
        return None
    if not NODE_NAME.fullmatch(name.lstrip("0123456789")):
        body.problem(f"name {name!r} is not legal: letters, digits and underscores only")
    if shutil.which(words[0], path=context.environment.get("PATH")) is None and not (process["prefix"]):
        fields["cmd"].problem(f"program {words[0]!r} does not exist")
        return None
    return NodeSpec(name=name, exec=program, command=(*process.pop("prefix"), *words), heartbeat=False, **process)


def _process(fields: Mapping[str, Value], scope: Scope, body: Value) -> dict[str, Any]:
    """Common part of ``node`` and ``executable``: arguments of :class:`NodeSpec`, and also ``prefix``."""
    context = scope.context
    output = text_of(fields.get("output"), context) or "both"
    if output not in _OUTPUTS:
        fields["output"].problem(f"output must be one of {', '.join(_OUTPUTS)} (got {output!r})")
    flag_of(fields.get("emulate_tty"), context)  # nodes write line by line anyway
    prefix = words_of(fields.get("launch-prefix"), context)
    if prefix and shutil.which(prefix[0]) is None:
        fields["launch-prefix"].problem(f"program {prefix[0]!r} does not exist")
    cwd = text_of(fields.get("cwd"), context)
    if cwd and not Path(cwd).is_dir():
        fields["cwd"].problem(f"folder {cwd} does not exist")
    env: dict[str, str | None] = dict(scope.env)
    env.update(pairs_of(fields.get("env"), "name", "value", context))
    for variable in env:
        if "=" in variable:
            body.problem(f"environment variable {variable!r}: a name has no =")
    delay_s = seconds_of(fields.get("respawn_delay"), context)
    return {
        "prefix": prefix,
        "env": env,
        "respawn": flag_of(fields.get("respawn"), context),
        "respawn_delay_s": 1.0 if delay_s is None else delay_s,
        "respawn_max_retries": integer_of(fields.get("respawn_max_retries"), context, -1),
        "required": flag_of(fields.get("required"), context),
        "sigterm_timeout_s": seconds_of(fields.get("sigterm_timeout"), context),
        "sigkill_timeout_s": seconds_of(fields.get("sigkill_timeout"), context),
        "to_terminal": output != "log",
        "cwd": Path(cwd) if cwd else None,
        "file": body.file,
        "line": body.line,
        "run_dir": scope.run_dir,
        "group": scope.group,
        "start_delay_s": scope.delay_s,
    }


def _program(value: Value, executable: str, context: Context) -> tuple[str, ...] | None:
    if executable.endswith(".py"):
        file = context.launch_file.parent / executable
        if paths.is_file(file):
            return (sys.executable, str(file.resolve()))
        value.problem(f"program {executable} does not exist beside the launch file")
        return None
    if executable in paths.node_names():
        return (sys.executable, str(NODE_MAIN), str(paths.node_file(executable)))
    value.problem(f"unknown exec {executable!r} (nodes: {', '.join(paths.node_names())})")
    return None


def _parameter(entry: Value, context: Context, places: dict[str, str], prefix: str) -> list[str]:
    fields = entry.fields(known=("name", "value", "type", "from", "param", "allow_substs", *CONDITION))
    if not entry.is_mapping or not holds(fields, context):
        return []
    if "from" in fields:
        words = parameter_file(fields["from"], context)
        if words and flag_of(fields.get("allow_substs"), context) and "$(" in Path(words[1]).read_text():
            fields["allow_substs"].problem("a parameter file cannot contain substitutions: give name and value")
        return words
    name = plain_text(fields.get("name"))
    if name and "param" in fields:  # nested parameters, as in ROS 2
        inner = [_parameter(part, context, places, f"{prefix}{name}.") for part in fields["param"].items()]
        return [word for words in inner for word in words]
    if not name or "value" not in fields:
        entry.problem("a parameter needs name and value, or from: FILE")
        return []
    value = parameter_value(fields["value"], plain_text(fields.get("type")) or "", context)
    word = f"{prefix}{name}:={one_line(value)}"
    places[word] = entry.place
    return ["-p", word]


def parameter_file(value: Value, context: Context) -> list[str]:
    """Command-line arguments that pass a parameter file to a node; empty, with the problem noted, if it is invalid."""
    name = text_of(value, context)
    if name is None:
        return []
    path = context.launch_file.parent / name  # an absolute path replaces the folder
    if not paths.is_file(path):
        value.problem(f"parameter file {path} does not exist")
        return []
    root = load(path, value.problems)
    for node_name, section in root.fields().items() if root is not None else ():
        if not section.is_mapping or "ros__parameters" not in section.fields():
            section.problem(f"section {node_name!r} has no ros__parameters: key")
    return ["--params-file", str(path)]
