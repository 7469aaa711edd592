"""Parameters of all nodes of a run directory in one namespace, to read."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from instant_ic.bus import ParameterError, registry
from instant_ic.bus.control import ControlError, NodeControl

_TIMEOUT_S = 1.0


def read_parameters(run_dir: Path, names: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Ask the running nodes for parameters; this takes up to a second.

    Args:
        run_dir: run directory of the nodes.
        names: parameters as ``/node.group.key``; empty reads all parameters of all nodes.

    Returns:
        Values by name, and a text for each node that did not answer.
    """
    running = {node.name for node in registry.list_nodes(run_dir)}
    values: dict[str, Any] = {}
    problems = []

    def ask(node: str) -> tuple[dict[str, Any], str]:
        if node not in running:  # the name becomes part of a path
            return {}, f"node {node!r:.100} does not run"
        try:
            found = NodeControl(run_dir, node, _TIMEOUT_S).get()
        except (ControlError, ParameterError) as error:
            return {}, str(error)
        return {f"/{node}.{key}": value for key, value in found.items()}, ""

    nodes = {name.strip("/").partition(".")[0] for name in names} if names else running
    with ThreadPoolExecutor(8, thread_name_prefix="parameters") as pool:
        for found, problem in pool.map(ask, sorted(nodes)):
            values.update(found)
            problems += [problem] if problem else []
    return {name: values[name] for name in names if name in values} if names else values, problems
