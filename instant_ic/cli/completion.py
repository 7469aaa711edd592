"""Completers for the shell: topics, nodes, parameters, types, launch files, bags.

argcomplete calls them at each press of TAB, so they import nothing heavy and raise no errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any


def _quiet(function: Callable[..., Iterable[str]]) -> Callable[..., list[str]]:
    def complete(prefix: str = "", parsed_args: Any = None, **_: Any) -> list[str]:
        try:
            return [word for word in function(parsed_args) if word.startswith(prefix)]
        except Exception:  # noqa: BLE001 - a traceback in the middle of the user's command line helps nobody
            return []

    return complete


def _nodes() -> dict[str, Any]:
    from instant_ic.bus import registry
    from instant_ic.util import paths

    return {node.name: node for node in registry.list_nodes(paths.run_dir())}


@_quiet
def topics(args: Any) -> Iterable[str]:
    """Return the topics of the running nodes."""
    from instant_ic.cli.names import topic_types

    return topic_types()


@_quiet
def nodes(args: Any) -> Iterable[str]:
    """Return the running nodes."""
    return _nodes()


@_quiet
def parameters(args: Any) -> Iterable[str]:
    """Return the parameters of the node on the command line."""
    from instant_ic.config.params import flatten

    return flatten(_nodes()[str(args.node).strip("/")].params)


@_quiet
def types(args: Any) -> Iterable[str]:
    """Return the message types."""
    from instant_ic.msg import typestore

    return sorted(typestore().types)


@_quiet
def programs(args: Any) -> Iterable[str]:
    """Return the shipped nodes."""
    from instant_ic.util import paths

    return paths.node_names()


@_quiet
def launch_files(args: Any) -> Iterable[str]:
    """Return the shipped launch files, and the YAML files in this folder."""
    from instant_ic.util import paths

    shipped = [path.stem for path in paths.share_dir("launch").glob("*.yaml")]
    return sorted(shipped) + sorted(str(path) for path in Path().glob("*.yaml"))


@_quiet
def launch_arguments(args: Any) -> Iterable[str]:
    """Return the arguments of the launch file on the command line."""
    from instant_ic.launch.description import find_launch_file
    from instant_ic.launch.reader import read_arguments

    return [f"{argument.name}:=" for argument in read_arguments(find_launch_file(args.file))]


@_quiet
def bags(args: Any) -> Iterable[str]:
    """Return the bags in this folder and the folders inside."""
    found = [path.parent for pattern in ("*/metadata.yaml", "*/*/metadata.yaml") for path in Path().glob(pattern)]
    return sorted(str(path) for path in [*found, *Path().glob("*.mcap"), *Path().glob("*.bag")])
