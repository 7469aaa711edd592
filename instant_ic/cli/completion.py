"""Completers for the shell: topics, nodes, parameters, types, launch files.

argcomplete calls them at each press of TAB, so they import nothing heavy. argcomplete shows no errors, completes files
by itself, and leaves out entries that do not begin with the typed word.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any


def _nodes() -> dict[str, Any]:
    from instant_ic.bus import registry
    from instant_ic.util import paths

    return {node.name: node for node in registry.list_nodes(paths.run_dir())}


def topics(**_: Any) -> Iterable[str]:
    """Return the topics of the running nodes."""
    from instant_ic.cli.names import topic_types

    return topic_types()


def nodes(**_: Any) -> Iterable[str]:
    """Return the running nodes."""
    return _nodes()


def parameters(parsed_args: Any, **_: Any) -> Iterable[str]:
    """Return the parameters of the node on the command line."""
    from instant_ic.config.params import flatten

    return flatten(_nodes()[str(parsed_args.node).strip("/")].params)


def types(**_: Any) -> Iterable[str]:
    """Return the message types."""
    from instant_ic.msg import typestore

    return sorted(typestore().types)


def programs(**_: Any) -> Iterable[str]:
    """Return the shipped nodes."""
    from instant_ic.util import paths

    return paths.node_names()


def launch_files(**_: Any) -> Iterable[str]:
    """Return the shipped launch files, and the YAML files in this folder."""
    from instant_ic.util import paths

    shipped = [path.stem for path in paths.share_dir("launch").glob("*.yaml")]
    return sorted(shipped) + sorted(str(path) for path in Path().glob("*.yaml"))


def launch_arguments(parsed_args: Any, **_: Any) -> Iterable[str]:
    """Return the arguments of the launch file on the command line."""
    from instant_ic.launch.description import find_launch_file
    from instant_ic.launch.reader import read_arguments

    return [f"{argument.name}:=" for argument in read_arguments(find_launch_file(parsed_args.file))]
