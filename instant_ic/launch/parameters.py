"""Check the parameters of a launch description's nodes without starting them.

The check imports the nodes' modules, which takes two seconds of CPU for the whole stack. So a valid stack is remembered
by everything the result depends on (the package's files, the parameter files, the command lines). Others are checked in
a separate process, which frees the memory when it ends.
"""

from __future__ import annotations

import difflib
import functools
import hashlib
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.launch.description import NodeSpec
from instant_ic.launch.robot_parameters import RELATED, Driving, disagreements
from instant_ic.util import paths
from instant_ic.util.files import replacing

if TYPE_CHECKING:
    from instant_ic.config.params import Values

CHECK_TIMEOUT_S = 120.0
"""Longest time that the check may take."""
_MOST_REMEMBERED = 50


class ParameterCheckError(RuntimeError):
    """The check itself did not finish; the message says why."""


@dataclass(frozen=True)
class CheckedNode:
    """Input of the check of one node.

    Attributes:
        label: its name for users.
        words: its arguments.
        at: ``file:line`` of its entry.
        places: ``file:line`` of each ``-p`` argument.
        shared: value as YAML, place and file of each parameter that a ``/**`` section sets for this run directory.
        own_programs: whether the stack has nodes that are not checked.
        group: run directory within the stack's: the robot of a fleet.
    """

    label: str
    exec: str
    words: tuple[str, ...]
    at: str
    places: Mapping[str, str]
    shared: Mapping[str, tuple[str, str, str]]
    own_programs: bool
    group: str


def _checkable(nodes: Sequence[NodeSpec]) -> list[CheckedNode]:
    """Return the shipped nodes; programs given by path are not checked."""
    shipped = [spec for spec in nodes if str(paths.node_file(spec.exec)) in spec.command]
    shared = _shared(shipped)
    return [
        CheckedNode(
            label=spec.label,
            exec=spec.exec,
            words=_words(spec),
            at=f"{spec.file}:{spec.line}",
            places=dict(spec.places),
            shared=shared[spec.group],
            own_programs=len(shipped) < len(nodes),
            group=spec.group,
        )
        for spec in shipped
    ]


def given_values(spec: NodeSpec) -> tuple[type[Any], Values]:
    """Return the configuration class of a shipped node, and the values that its launch file gives it.

    Raises:
        ParameterError: a file or an argument cannot be read.
    """
    from instant_ic.bus.node_files import node_class
    from instant_ic.bus.process import argument_parser
    from instant_ic.config.params import gather

    found = node_class(spec.exec)
    args = argument_parser(found).parse_args(_words(spec))
    return found.config_class(), gather(args.name, args.params_file, args.param, spec.places)


def check_parameter_file(file: Path) -> list[str]:
    """Return all mistakes in a parameter file: its sections against the shipped nodes, ``/**`` against all of them.

    What depends on other values of the node (a missing one, for example) is left to the check of a launch file.
    """
    from instant_ic.bus.node_files import node_class
    from instant_ic.config.params import SHARED, ParameterError, configure, load_sections

    try:
        sections = load_sections(file)
    except ParameterError as error:
        return [str(problem) for problem in error.problems]
    problems: list[str] = []
    names = paths.node_names()
    shared = sections.pop(SHARED, {})
    for name, values in sections.items():
        if name in names:
            try:
                configure(node_class(name).config_class(), {**shared, **values})
            except ParameterError as error:
                problems += [f"{problem} (node {name})" for problem in error.problems if problem.where]
        elif close := difflib.get_close_matches(name, names, n=1, cutoff=0.8):
            problems.append(f"{file}: no shipped node is called {name!r}; did you mean {close[0]!r}?")
    return problems + _declared_by_none(shared, names)


def _words(spec: NodeSpec) -> tuple[str, ...]:
    return spec.command[spec.command.index(str(paths.node_file(spec.exec))) + 1 :]


def _files(words: Sequence[str]) -> list[Path]:
    return [Path(word) for option, word in itertools.pairwise(words) if option == "--params-file"]


def _shared(specs: Sequence[NodeSpec]) -> dict[str, dict[str, tuple[str, str, str]]]:
    """Return the ``/**`` values of each run directory; the first node with a value decides."""
    from instant_ic.config.params import PROCESS_KEYS, SHARED, ParameterError, load_sections
    from instant_ic.config.yaml_text import one_line

    sections = functools.cache(load_sections)
    found: dict[str, dict[str, tuple[str, str, str]]] = {}
    for spec in specs:
        own: dict[str, tuple[str, str, str]] = {}
        for file in _files(_words(spec)):
            with suppress(ParameterError):  # the check of the node reports it
                for key, value in sections(file).get(SHARED, {}).items():
                    own[key] = (one_line(value.given), value.where, str(file))
        values = found.setdefault(spec.group, {})
        values.update({key: value for key, value in own.items() if key not in values and key not in PROCESS_KEYS})
    return found


def check_parameters(nodes: Sequence[NodeSpec]) -> list[str]:
    """Return all unknown parameters, wrong types, values out of range, and values that contradict each other."""
    return _checked(_checkable(nodes))


def _checked(nodes: Sequence[CheckedNode]) -> list[str]:
    problems = [problem for node in nodes for problem in _problems(node)]
    return list(dict.fromkeys([*problems, *_disagreements(nodes)]))


def check_parameters_quickly(nodes: Sequence[NodeSpec], cache: Path | None = None) -> list[str]:
    """Check parameters like :func:`check_parameters`, but in a separate process, and a valid stack only once.

    Args:
        nodes: nodes of the stack.
        cache: file of valid stacks; default ``$XDG_CACHE_HOME/instant_ic/launch_check.json``. If it cannot be read or
            written, the check only takes longer.

    Raises:
        ParameterCheckError: the check did not finish.
    """
    cache = cache or paths.cache_dir() / "launch_check.json"
    request = json.dumps([asdict(node) for node in _checkable(nodes)], sort_keys=True)
    digest = hashlib.sha256(f"{_package_state()}\n{request}".encode())
    for file in sorted({file for spec in nodes for file in _files(spec.command)}):
        with suppress(OSError):  # missing: the check itself reports it
            digest.update(file.read_bytes())
    key, valid = digest.hexdigest(), _remembered(cache)
    if key in valid:
        return []
    problems = _check_apart(request)
    if not problems:
        _remember(cache, [*valid, key])
    return problems


def existing_bags(nodes: Sequence[NodeSpec]) -> list[str]:
    """Return a text for each recorder whose bag's folder exists already: it would refuse, and nothing be recorded."""
    problems = []
    for spec in nodes:
        given = dict(word.split(":=", 1) for word in spec.command if ":=" in word)
        if spec.exec == "bag_recorder" and given.get("path") and given.get("snapshot") != "true":
            path = Path(given["path"]).expanduser()
            if path.exists():
                problems.append(f"{path} exists: record into a new folder (node {spec.label})")
    return problems


def _package_state() -> str:
    """Return a text that changes whenever a module of the package does."""
    root = Path(__file__).resolve().parents[1]
    newest, count = 0, 0
    for folder, _, names in os.walk(root):
        for name in names:
            if name.endswith(".py"):
                newest, count = max(newest, os.stat(f"{folder}/{name}").st_mtime_ns), count + 1  # noqa: PTH116 - hundreds
    return f"{root} {newest} {count} {sys.version}"


def _remembered(cache: Path) -> list[str]:
    try:
        content = json.loads(cache.read_text())
    except (OSError, ValueError):
        return []
    return [key for key in content if isinstance(key, str)] if isinstance(content, list) else []


def _remember(cache: Path, keys: Sequence[str]) -> None:
    with suppress(OSError):
        cache.parent.mkdir(parents=True, exist_ok=True)
        with replacing(cache) as stream:
            stream.write(json.dumps(list(keys)[-_MOST_REMEMBERED:]).encode())


def _check_apart(request: str) -> list[str]:
    """Return the problems of some nodes, given as JSON; a separate process finds them."""
    command = [sys.executable, "-m", "instant_ic.launch.parameters"]
    try:
        done = subprocess.run(command, input=request, capture_output=True, text=True, timeout=CHECK_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise ParameterCheckError(
            f"the nodes' parameters could not be checked within {CHECK_TIMEOUT_S:.0f} s: is a module waiting for "
            "something while it is imported? ic launch FILE --no-check starts without"
        ) from None
    if done.returncode != 0:
        raise ParameterCheckError(f"the nodes' parameters could not be checked:\n{done.stderr.strip()}")
    problems: list[str] = json.loads(done.stdout)
    return problems


def _problems(node: CheckedNode) -> list[str]:
    """Return all problems of one node's command line."""
    from instant_ic.bus.node_files import NodeFileError, node_class
    from instant_ic.bus.process import argument_parser, parse_remaps
    from instant_ic.config.params import ParameterError, configure, gather

    where = f"{node.at}: node {node.label}"
    try:
        found = node_class(node.exec)
    except NodeFileError as error:
        return [f"{where}: {error}"]
    except Exception as error:  # noqa: BLE001 - whatever a module raises on import, the node would raise too
        return [f"{where}: cannot be loaded: {type(error).__name__}: {error}"]
    try:
        args = argument_parser(found).parse_args(node.words)
    except SystemExit:  # such as a remap of a name that begins with a dash
        return [f"{where}: its arguments cannot be read: {' '.join(node.words)}"]
    problems: list[str] = []
    try:
        parse_remaps(args.remap)
    except ParameterError as error:
        problems.append(f"{where}: {error}")
    try:
        values = gather(args.name, args.params_file, args.param, node.places)
    except ParameterError as error:
        return problems + [str(problem) if problem.where else f"{where}: {problem}" for problem in error.problems]
    if not node.own_programs:
        # A shared value that no node has is a typing error, unless it is for a program that is not checked.
        shared = {key: value for key, value in values.items() if value.shared}
        problems += _declared_by_none(shared, (node.exec, *paths.node_names()))
    try:
        config, _ = configure(found.config_class(), values)
    except ParameterError as error:
        for problem in error.problems:
            at_line = problem.where and not problem.where.startswith("-p ")
            problems.append(f"{problem} (node {node.label})" if at_line else f"{where}: {problem}")
        return problems
    return problems + _contradictions(node, values, config)


def _contradictions(node: CheckedNode, values: Values, config: Any) -> list[str]:
    """Return values that differ from the shared one, unless stated beside it or on the node's own entry."""
    from instant_ic.config.parameter_info import plain
    from instant_ic.config.params import flatten, to_dict, typed_value, yaml_value

    problems: list[str] = []
    effective = flatten(to_dict(config))
    for key, (wanted, place, file) in node.shared.items():
        value = values.get(key)
        if key not in effective:
            continue
        got = plain(effective[key])
        with suppress(ValueError):  # the node that takes it reports it
            if got == plain(typed_value(type(config), key, yaml_value(wanted, place))):
                continue
        if value is None:
            problems.append(
                f"{node.at}: node {node.label}: {key} is {got}, its default, but {place} sets {wanted} for the other "
                f"nodes: give it the same file (from: {file})"
            )
        elif value.file is not None and (value.shared or str(value.file) != file):
            problems.append(
                f"{value.where}: {key} {got} contradicts {place}, which sets {wanted} for all nodes: change it there, "
                f"or set it for this node in the launch file (node {node.label})"
            )
    return problems


def _disagreements(nodes: Sequence[CheckedNode]) -> Iterator[str]:
    """Yield values of one robot's nodes that do not fit together; nodes with problems of their own are left out."""
    from instant_ic.bus.node_files import NodeFileError, node_class
    from instant_ic.bus.process import argument_parser
    from instant_ic.config.params import ParameterError, configure, gather

    robots: dict[str, dict[str, list[Driving]]] = {}
    for node in (node for node in nodes if node.exec in RELATED):
        with suppress(ParameterError, NodeFileError, SystemExit):  # the check of the node reports it
            found = node_class(node.exec)
            args = argument_parser(found).parse_args(node.words)
            values = gather(args.name, args.params_file, args.param, node.places)
            config = configure(found.config_class(), values)[0]
            meant = {key for key, value in values.items() if value.file is None}
            alike = robots.setdefault(node.group, {}).setdefault(node.exec, [])
            alike.append(Driving(node.at, config, meant | node.shared.keys()))
    for robot in robots.values():
        yield from disagreements(robot)


def _declared_by_none(values: Values, nodes: Sequence[str]) -> list[str]:
    from instant_ic.bus.node_files import node_class
    from instant_ic.config.parameter_info import parameter_infos
    from instant_ic.config.params import PROCESS_KEYS

    left = {key: value for key, value in values.items() if key not in PROCESS_KEYS}
    for name in nodes:
        if not left:
            break
        for info in parameter_infos(node_class(name).config_class()):
            left.pop(info.name, None)
    return [f"{value.where}: no node has a parameter {key!r}" for key, value in left.items()]


def main() -> None:
    """Check the nodes on standard input, in a separate process; write the problems to standard output."""
    nodes = [CheckedNode(**{**entry, "words": tuple(entry["words"])}) for entry in json.load(sys.stdin)]
    json.dump(_checked(nodes), sys.stdout)


if __name__ == "__main__":
    main()
