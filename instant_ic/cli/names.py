"""Look up topics, nodes and message types by name, with a suggestion for an unknown name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from instant_ic.bus import registry
from instant_ic.cli.errors import UserError
from instant_ic.util import paths


def absolute(topic: str) -> str:
    """Return a topic's name with its leading slash."""
    return topic if topic.startswith("/") else f"/{topic}"


def near(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return ``did you mean 'x'?`` if a known name is similar, else ``otherwise``."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {close[0]!r}?" if close else otherwise


def topic_types() -> dict[str, str]:
    """Return the types of all published or subscribed topics, by topic; ``any`` if all subscribers accept any type."""
    run_dir = paths.run_dir()
    types = {info.topic: info.type_name for info in registry.list_topics(run_dir)}
    for node in registry.list_nodes(run_dir):
        for topic, name in node.subscribes.items():
            if types.get(topic, "any") == "any":
                types[topic] = name
    return dict(sorted(types.items()))


def unknown_topic(topic: str, known: Iterable[str]) -> str:
    """Return the message for a topic that no node publishes."""
    return f"{topic} has no publisher ({near(topic, known, 'see ic topic list')})"


def nobody_runs() -> str:
    """Return the message for a run directory without running nodes. It names stacks in subfolders, as of a fleet."""
    run_dir = paths.run_dir()
    inside = [folder.parent for folder in sorted(run_dir.glob("*/nodes")) if registry.list_nodes(folder.parent)]
    hint = f"; nodes are running in {', '.join(map(str, inside))}: ic --run-dir {inside[0]} ..." if inside else ""
    return f"no node is running in {run_dir}{hint}"


def find_node(name: str) -> registry.NodeInfo:
    """Return a running node.

    Raises:
        UserError: no running node has this name.
    """
    nodes = {node.name: node for node in registry.list_nodes(paths.run_dir())}
    if name.strip("/") not in nodes:
        if not nodes:
            raise UserError(nobody_runs())
        hint = near(name.strip("/"), nodes, f"running: {', '.join(nodes)}")
        raise UserError(f"node {name!r} is not running in {paths.run_dir()} ({hint})")
    return nodes[name.strip("/")]


def find_type(name: str) -> str:
    """Return the full name of a message type, from its full or short name.

    Raises:
        UserError: the type is unknown.
    """
    from instant_ic.msg import MessageError, message_type, type_name, typestore

    try:
        return type_name(message_type(name))
    except MessageError as error:
        short = name.rsplit("/", 1)[-1]
        known = {full.rsplit("/", 1)[1]: full for full in typestore().types}
        close = difflib.get_close_matches(short, known, n=1)
        suggestion = (known[close[0]] if "/" in name else close[0]) if close else ""
        raise UserError(f"{error}" + (f"; did you mean {suggestion!r}?" if close else ""), 2) from None
