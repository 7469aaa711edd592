"""Check the parameters of a launch description's nodes without starting them.

The check imports the nodes' modules, which takes two seconds of CPU for the whole stack. So valid nodes are cached,
keyed by everything the result depends on (the package's files, the parameter files, the command line). All others are
checked in a separate process, which frees the memory when it ends.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instant_ic import paths
from instant_ic.launch.description import NodeSpec

_CHECK_TIMEOUT_S = 120.0
_MOST_REMEMBERED = 500


class ParameterCheckError(RuntimeError):
    """The check itself did not finish; the message says why."""


@dataclass(frozen=True)
class _Node:
    """Input of the check of one node."""

    label: str
    exec: str
    words: tuple[str, ...]
    at: str
    places: Mapping[str, str]

    @classmethod
    def of(cls, spec: NodeSpec) -> _Node:
        """The part of a specification that the check needs."""
        start = spec.command.index(str(paths.node_file(spec.exec))) + 1
        return cls(spec.label, spec.exec, spec.command[start:], f"{spec.file}:{spec.line}", dict(spec.places))


def _checkable(nodes: Sequence[NodeSpec]) -> list[_Node]:
    """The shipped nodes; programs given by path and executables are not checked."""
    return [_Node.of(spec) for spec in nodes if str(paths.node_file(spec.exec)) in spec.command]


def check_parameters(nodes: Sequence[NodeSpec]) -> list[str]:
    """Check all nodes for unknown parameters, wrong types and values out of range; returns one text per problem."""
    return [problem for node in _checkable(nodes) for problem in _problems(node)]


def check_parameters_quickly(nodes: Sequence[NodeSpec], cache: Path | None = None) -> list[str]:
    """Like :func:`check_parameters`, but in a separate process, and only for nodes not cached as valid.

    Args:
        nodes: the nodes.
        cache: file of valid nodes; default ``$XDG_CACHE_HOME/instant_ic/launch_check.json``. If it cannot be read or
            written, the check only takes longer.

    Raises:
        ParameterCheckError: the check did not finish.
    """
    cache = cache or paths.cache_dir() / "launch_check.json"
    package = _package_state()
    keys = {node: _key(node, package) for node in map(_frozen, _checkable(nodes))}
    known = _remembered(cache)
    unknown = [json.loads(node) for node, key in keys.items() if key not in known]
    if not unknown:
        return []
    problems = _check_apart(unknown)
    bad = {label for label, _ in problems}
    good = [key for node, key in keys.items() if json.loads(node)["label"] not in bad]
    _remember(cache, [*(key for key in known if key not in good), *good])
    return [text for _, text in problems]


def _frozen(node: _Node) -> str:
    return json.dumps(vars(node), sort_keys=True)


def _key(node: str, package: str) -> str:
    digest = hashlib.sha256(f"{package}\n{node}".encode())
    words = json.loads(node)["words"]
    for option, word in itertools.pairwise(words):
        if option == "--params-file":
            with suppress(OSError):  # missing: the check itself reports it
                digest.update(Path(word).read_bytes())
    return digest.hexdigest()


def _package_state() -> str:
    """Text that changes whenever a module of the package does."""
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
    scratch = cache.with_suffix(f".{os.getpid()}")
    with suppress(OSError):
        cache.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_text(json.dumps(list(keys)[-_MOST_REMEMBERED:]))
        scratch.replace(cache)


def _check_apart(nodes: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Label and text of each problem."""
    command = [sys.executable, "-m", "instant_ic.launch.parameters"]
    try:
        done = subprocess.run(
            command, input=json.dumps(nodes), capture_output=True, text=True, timeout=_CHECK_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        raise ParameterCheckError(
            f"the nodes' parameters could not be checked within {_CHECK_TIMEOUT_S:.0f} s: is a module waiting for "
            "something while it is imported? ic launch FILE --no-check starts without"
        ) from None
    if done.returncode != 0:
        raise ParameterCheckError(f"the nodes' parameters could not be checked:\n{done.stderr.strip()}")
    return [(label, text) for label, text in json.loads(done.stdout)]


def _problems(node: _Node) -> list[str]:
    """All problems of one node's command line."""
    from instant_ic.bus.node_files import NodeFileError, node_class
    from instant_ic.bus.process import argument_parser, parse_remaps
    from instant_ic.config.params import ParameterError, ProcessParameters

    where = f"{node.at}: node {node.label}"
    try:
        found = node_class(node.exec)
    except NodeFileError as error:
        return [f"{where}: {error}"]
    except Exception as error:  # noqa: BLE001 - whatever a module raises on import, the node would raise too
        return [f"{where}: cannot be loaded: {type(error).__name__}: {error}"]
    parser = argument_parser(found)
    told: list[str] = []
    parser.error = told.append  # type: ignore[method-assign,assignment]
    args, unknown = parser.parse_known_args(node.words)
    if told or unknown:
        return [f"{where}: {text}" for text in told or [f"unknown arguments: {' '.join(unknown)}"]]
    problems: list[str] = []
    try:
        parse_remaps(args.remap)
    except ParameterError as error:
        problems.append(f"{where}: {error}")
    values = _values(node, args, problems, where)
    common = {key: values.pop(key) for key in ProcessParameters.__dataclass_fields__ if key in values}
    for config_class, part in ((found.config_class(), values), (ProcessParameters, common)):
        problems += _refused(config_class, part, node, where)
    return problems


def _values(node: _Node, args: Any, problems: list[str], where: str) -> dict[str, Any]:
    from instant_ic.config.params import ParameterError, Values, load_file, parse_override

    values: Values = {}
    for path in args.params_file:
        try:
            values.update(load_file(path, args.name))
        except ParameterError as error:
            problems.append(str(error))
    for word in args.param:
        try:
            key, value = parse_override(word)
            values[key] = value
        except ParameterError as error:
            problems.append(f"{where}: {error}")
    return values


def _refused(config_class: type[Any], values: dict[str, Any], node: _Node, where: str) -> list[str]:
    """All values that a configuration refuses: each refused value is removed, and the rest is checked again."""
    from instant_ic.config.params import ParameterError, build

    problems: list[str] = []
    while True:
        try:
            build(config_class, values)
            return problems
        except ParameterError as error:
            text = str(error)
            to_blame = [key for key, value in values.items() if text.startswith(f"{value.where}: ")]
            at = values[to_blame[0]].where if to_blame else ""
            words = text.removeprefix(f"{at}: ") if to_blame else text
            place = node.places.get(at.removeprefix("-p "), "" if at.startswith("-p ") else at)
            problems.append(f"{place}: {words} (node {node.label})" if place else f"{where}: {text}")
            if not to_blame:
                return problems
            for key in to_blame:
                del values[key]


def main() -> None:
    """Entry point of the separate process: nodes on standard input, problems on standard output."""
    nodes = [_Node(**{**entry, "words": tuple(entry["words"])}) for entry in json.load(sys.stdin)]
    report = [(node.label, problem) for node in nodes for problem in _problems(node)]
    json.dump(report, sys.stdout)


if __name__ == "__main__":
    main()
