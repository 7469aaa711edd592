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


@_quiet
def topics(args: Any) -> Iterable[str]:
    from instant_ic.cli.names import topic_types

    return topic_types()


@_quiet
def nodes(args: Any) -> Iterable[str]:
    from instant_ic.bus import registry
    from instant_ic.util import paths

    return [node.name for node in registry.list_nodes(paths.run_dir())]


@_quiet
def parameters(args: Any) -> Iterable[str]:
    from instant_ic.bus import registry
    from instant_ic.config import params
    from instant_ic.util import paths

    for node in registry.list_nodes(paths.run_dir()):
        if args is not None and node.name == str(args.node).strip("/"):
            return params.flatten(node.params)
    return []


@_quiet
def types(args: Any) -> Iterable[str]:
    from instant_ic.msg import typestore

    return sorted(typestore().types)


@_quiet
def programs(args: Any) -> Iterable[str]:
    from instant_ic.util import paths

    return paths.node_names()


@_quiet
def launch_files(args: Any) -> Iterable[str]:
    from instant_ic.util import paths

    shipped = [path.stem for path in paths.share_dir("launch").glob("*.yaml")]
    return sorted(shipped) + sorted(str(path) for path in Path().glob("*.yaml"))


@_quiet
def launch_arguments(args: Any) -> Iterable[str]:
    from instant_ic.launch.description import find_launch_file
    from instant_ic.launch.reader import read_arguments

    return [f"{argument.name}:=" for argument in read_arguments(find_launch_file(args.file))]


@_quiet
def bags(args: Any) -> Iterable[str]:
    found = [path.parent for pattern in ("*/metadata.yaml", "*/*/metadata.yaml") for path in Path().glob(pattern)]
    return sorted(str(path) for path in [*found, *Path().glob("*.mcap")])
