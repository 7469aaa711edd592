"""Parameters of all nodes of a run directory in one namespace."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from instant_ic.bridge.parameter_guard import never_set
from instant_ic.bus import ParameterError, registry
from instant_ic.bus.control import ControlError, NodeControl

_TIMEOUT_S = 1.0


class Parameters:
    """Parameters of all nodes of a run directory, as ``/node.key``; read from the nodes themselves."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._pool = concurrent.futures.ThreadPoolExecutor(8, thread_name_prefix="parameters")
        self.nodes: tuple[str, ...] = ()

    def _control(self, node: str) -> NodeControl:
        return NodeControl(self._run_dir, node, _TIMEOUT_S)

    def _of(self, node: str) -> tuple[dict[str, Any], str]:
        if node not in self.nodes:  # the name becomes part of a path
            return {}, f"node {node!r:.100} does not run"
        try:
            return {f"/{node}.{key}": value for key, value in self._control(node).get().items()}, ""
        except (ControlError, ParameterError) as error:
            return {}, str(error)

    def get(self, names: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
        """Return values by name (without names: all parameters of all nodes), and an error text per failed node."""
        nodes = {_split(name)[0] for name in names} if names else set(self.nodes)
        values: dict[str, Any] = {}
        silent = []
        for found, words in self._pool.map(self._of, sorted(nodes)):
            values.update(found)
            silent += [words] if words else []
        return {name: values[name] for name in names if name in values} if names else values, silent

    def set(self, wanted: Mapping[str, Any]) -> list[str]:
        """Change parameters, those of one node together; return an error text for each refused change.

        A safety parameter (:mod:`.parameter_guard`) is always refused, and with it the whole change of its node.
        """
        by_node: dict[str, dict[str, Any]] = {}
        for name, value in wanted.items():
            node, key = _split(name)
            by_node.setdefault(node, {})[key] = value
        executables = {info.name: info.executable for info in registry.list_nodes(self._run_dir)}
        refused = []
        for node, values in by_node.items():
            try:
                if node not in executables:
                    raise ControlError(f"node {node!r:.100} does not run")
                for key, value in values.items():
                    _check(executables[node], key, value)
                self._control(node).set(values)
            except (ControlError, ParameterError) as error:
                refused.append(f"{node:.100}: {error}")
        return refused

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)


def _check(executable: str, key: str, value: Any) -> None:
    """Refuse a safety parameter, also as part of a group.

    Raises:
        ParameterError: the key is a safety parameter, or the value has an unsupported type.
    """
    items = value if isinstance(value, list) else [value]
    if not all(isinstance(item, (bool, int, float, str)) for item in items):
        raise ParameterError(f"{key!r:.100} must be a number, a string, true or false, or a list of these")
    if never_set(executable, key):
        raise ParameterError(
            f"{key!r:.100} is a safety parameter and cannot be set over a bridge; use `ic param set` on the robot"
        )


def _split(name: str) -> tuple[str, str]:
    """Split ``/node.group.key`` into node and key."""
    node, _, key = name.strip("/").partition(".")
    return node, key
