"""Check the parameters of a launch description's nodes without starting them.

The check imports the nodes' modules, so ``ic launch`` runs it in a forked process that frees the memory when it ends.
"""

from __future__ import annotations

import functools
import itertools
import multiprocessing
import signal
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.config.parameter_info import parameter_infos, plain
from instant_ic.config.params import (
    PROCESS_KEYS,
    SHARED,
    ParameterError,
    Values,
    configure,
    flatten,
    gather,
    load_sections,
    to_dict,
    typed_value,
)
from instant_ic.config.yaml_text import one_line
from instant_ic.launch.description import NodeSpec
from instant_ic.launch.robot_parameters import RELATED, Driving, disagreements
from instant_ic.util import paths

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

CHECK_TIMEOUT_S = 120.0
"""Longest time that the check may take."""


class ParameterCheckError(RuntimeError):
    """The check did not finish; the message says why."""


def given_values(spec: NodeSpec) -> tuple[type[Any], Values]:
    """Return the configuration class of a shipped node, and the values that its launch file gives it.

    Raises:
        ParameterError: a file or an argument cannot be read.
        NodeFileError: the node's module cannot be used.
        SystemExit: the node's arguments cannot be read.
    """
    from instant_ic.bus.node_files import node_class
    from instant_ic.bus.process import argument_parser, parse_remaps

    found = node_class(spec.exec)
    args = argument_parser(found).parse_args(_words(spec))
    parse_remaps(args.remap)
    return found.config_class(), gather(args.name, args.params_file, args.param, spec.places)


def check_parameters(nodes: Sequence[NodeSpec]) -> list[str]:
    """Return a text for each unknown parameter, wrong type, value out of range, and contradiction between values.

    Programs given by path are not checked.
    """
    shipped = _shipped(nodes)
    shared = _shared(shipped)
    robots: dict[str, dict[str, list[Driving]]] = {}
    problems: list[str] = []
    for spec in shipped:
        config, values, refused = _configured(spec)
        problems += refused
        if len(shipped) == len(nodes):  # else an unknown shared value may be meant for a program
            problems += _declared_by_none(spec, values)
        if config is None:
            continue
        problems += _contradictions(spec, shared[spec.group], values, config)
        if spec.exec in RELATED:
            meant = {key for key, value in values.items() if value.file is None} | shared[spec.group].keys()
            alike = robots.setdefault(spec.group, {}).setdefault(spec.exec, [])
            alike.append(Driving(f"{spec.file}:{spec.line}", config, meant))
    for robot in robots.values():
        problems += disagreements(robot)
    return list(dict.fromkeys(problems))


def check_parameters_apart(nodes: Sequence[NodeSpec]) -> list[str]:
    """Check parameters like :func:`check_parameters`, in a separate process.

    Raises:
        ParameterCheckError: the check did not finish.
    """
    if not _shipped(nodes):
        return []
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_check_and_send, args=(nodes, sender), daemon=True)
    process.start()
    sender.close()
    try:
        if receiver.poll(CHECK_TIMEOUT_S):
            problems: list[str] = receiver.recv()
            return problems
    except EOFError:
        raise ParameterCheckError("the nodes' parameters could not be checked: the check crashed") from None
    finally:
        process.kill()
        process.join()
    raise ParameterCheckError(
        f"the nodes' parameters could not be checked within {CHECK_TIMEOUT_S:.0f} s: is a module waiting for something "
        "while it is imported? ic launch FILE --no-check starts without the check"
    )


def _check_and_send(nodes: Sequence[NodeSpec], sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C: the launcher reports it
    sender.send(check_parameters(nodes))


def existing_bags(nodes: Sequence[NodeSpec]) -> list[str]:
    """Return a text for each recorder whose bag folder exists already; such a recorder would refuse to start."""
    problems = []
    for spec in nodes:
        given = dict(word.split(":=", 1) for word in spec.command if ":=" in word)
        if spec.exec == "bag_recorder" and given.get("path") and given.get("snapshot") != "true":
            path = Path(given["path"]).expanduser()
            if path.exists():
                problems.append(f"{path} exists: record into a new folder (node {spec.label})")
    return problems


def _shipped(nodes: Sequence[NodeSpec]) -> list[NodeSpec]:
    return [spec for spec in nodes if str(paths.node_file(spec.exec)) in spec.command]


def _words(spec: NodeSpec) -> tuple[str, ...]:
    """Return the node's arguments."""
    return spec.command[spec.command.index(str(paths.node_file(spec.exec))) + 1 :]


def _shared(specs: Sequence[NodeSpec]) -> dict[str, Values]:
    """Return the ``/**`` values of each run directory; the first node that has a value decides."""
    sections = functools.cache(load_sections)
    found: dict[str, Values] = {}
    for spec in specs:
        own: Values = {}
        for option, word in itertools.pairwise(_words(spec)):
            if option == "--params-file":
                with suppress(ParameterError):  # reported by the node's own check
                    own |= sections(Path(word)).get(SHARED, {})
        found[spec.group] = own | found.get(spec.group, {})
    return found


def _configured(spec: NodeSpec) -> tuple[Any, Values, list[str]]:
    """Return a node's configuration (None if refused), its values, and the problems of its command line."""
    from instant_ic.bus.node_files import NodeFileError

    where = f"{spec.file}:{spec.line}: node {spec.label}"
    values: Values = {}
    config_class = None
    try:
        config_class, values = given_values(spec)
        return configure(config_class, values)[0], values, []
    except ParameterError as error:
        # An unreadable file is one problem, however many nodes use it, so its text names no node.
        node = "" if config_class is None else f" (node {spec.label})"
        at_line = [problem.where and not problem.where.startswith("-p ") for problem in error.problems]
        texts = zip(error.problems, at_line, strict=True)
        return None, values, [f"{problem}{node}" if placed else f"{where}: {problem}" for problem, placed in texts]
    except NodeFileError as error:
        return None, values, [f"{where}: {error}"]
    except SystemExit:  # such as a remap of a name that begins with a dash
        return None, values, [f"{where}: its arguments cannot be read: {' '.join(_words(spec))}"]
    except Exception as error:  # noqa: BLE001 - any error on import would end the node too
        return None, values, [f"{where}: cannot be loaded: {type(error).__name__}: {error}"]


def _contradictions(spec: NodeSpec, shared: Values, values: Values, config: Any) -> Iterator[str]:
    """Yield a text for each value that differs from the shared one without being set for this node on purpose."""
    effective = flatten(to_dict(config))
    for key, wanted in shared.items():
        value = values.get(key)
        if key not in effective:  # such as the parameters of the process itself
            continue
        got = plain(effective[key])
        with suppress(ValueError):  # reported by the check of the node that has this parameter
            if got == plain(typed_value(type(config), key, wanted.given)):
                continue
        if value is None:
            yield (
                f"{spec.file}:{spec.line}: node {spec.label}: {key} is {got}, its default, but {wanted.where} sets "
                f"{one_line(wanted.given)} for the other nodes: give it the same file (from: {wanted.file})"
            )
        elif value.file is not None and (value.shared or value.file != wanted.file):
            yield (
                f"{value.where}: {key} {got} contradicts {wanted.where}, which sets {one_line(wanted.given)} for all "
                f"nodes: change it there, or set it for this node in the launch file (node {spec.label})"
            )


def _declared_by_none(spec: NodeSpec, values: Values) -> list[str]:
    """Return a text for each of a node's shared values that no shipped node declares."""
    from instant_ic.bus.node_files import node_class

    left = {key: value for key, value in values.items() if value.shared and key not in PROCESS_KEYS}
    for name in (spec.exec, *paths.node_names()):
        if not left:
            break
        for info in parameter_infos(node_class(name).config_class()):
            left.pop(info.name, None)
    return [f"{value.where}: no node has a parameter {key!r}" for key, value in left.items()]
