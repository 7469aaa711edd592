"""The graph of nodes and topics: a tree for the terminal, Graphviz or Mermaid text, or an image by Graphviz."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.bus.heartbeat import EVERY_NODES

TRANSFORMS = ("/tf", "/tf_static")
IMAGES = ("svg", "png", "pdf")
_FILLS = {"degraded": "#ffe0b8", "starting": "#fff3c4", "failed": "#f6c6c6", "silent": "#f6c6c6"}
_RENDER_TIMEOUT_S = 60.0


@dataclass
class StackGraph:
    """Which node publishes and which node subscribes to each topic.

    Attributes:
        nodes: name → state (``running``, ...; empty where unknown).
        topics: topic → type.
        publishes: (node, topic) → rate in Hz, or None where unknown.
        subscribes: (topic, node) → messages lost.
        hidden: topics that were left out.
    """

    nodes: dict[str, str] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)
    publishes: dict[tuple[str, str], float | None] = field(default_factory=dict)
    subscribes: dict[tuple[str, str], int] = field(default_factory=dict)
    hidden: list[str] = field(default_factory=list)

    def readers(self, topic: str) -> list[str]:
        return [node for name, node in self.subscribes if name == topic]


def make_graph(
    infos: Iterable[Any],
    beats: dict[str, Any],
    only: Collection[str] = (),
    show_all: bool = False,
    transforms: bool = False,
) -> StackGraph:
    """Graph of the running nodes.

    Args:
        infos: nodes listed in the registry.
        beats: node → its newest heartbeat, where there is one.
        only: nodes to show, with their topics and the nodes they exchange messages with; empty shows all.
        show_all: also show topics that every node has, and topics without a publisher or a subscriber.
        transforms: also show /tf and /tf_static.
    """
    graph = StackGraph()
    published: dict[str, list[str]] = {}
    read: dict[str, list[str]] = {}
    types: dict[str, str] = {}
    for info in infos:
        beat = beats.get(info.name)
        graph.nodes[info.name] = "" if beat is None else "silent" if beat.silent else beat.state
        for topic, kind in info.publishes.items():
            published.setdefault(topic, []).append(info.name)
            types[topic] = kind
        for topic, kind in info.subscribes.items():
            read.setdefault(topic, []).append(info.name)
            types.setdefault(topic, kind)
    for topic, kind in sorted(types.items()):
        partners = {*published.get(topic, ()), *read.get(topic, ())}
        if only and partners.isdisjoint(only):
            continue
        dead = topic not in published or topic not in read
        common = topic.endswith((*EVERY_NODES, "/clock")) or (topic.endswith(TRANSFORMS) and not transforms)
        if not show_all and (dead or common):
            graph.hidden.append(topic)
            continue
        graph.topics[topic] = kind
        for node in published.get(topic, ()):
            flow = beats[node].outputs.get(topic) if node in beats else None
            graph.publishes[node, topic] = None if flow is None else flow.rate_hz
        for node in read.get(topic, ()):
            lost = beats[node].lost if node in beats else {}
            graph.subscribes[topic, node] = sum(count for (name, _), count in lost.items() if name == topic)
    if only:
        linked = {node for node, _ in graph.publishes} | {node for _, node in graph.subscribes} | set(only)
        graph.nodes = {node: state for node, state in graph.nodes.items() if node in linked}
    return graph


def rate_text(rate_hz: float | None) -> str:
    """``10 Hz``, ``0.5 Hz``; empty where the rate is zero or unknown."""
    if not rate_hz:
        return ""
    return f"{rate_hz:.0f} Hz" if rate_hz >= 9.5 else f"{rate_hz:.1f} Hz"


def tree(graph: StackGraph) -> str:
    """Tree of the nodes, the topics each one publishes and their subscribers."""
    lines: list[str] = []
    for node, state in graph.nodes.items():
        lines.append(node + (f"  ({state})" if state not in ("", "running") else ""))
        topics = [topic for name, topic in graph.publishes if name == node]
        for topic in topics:
            flow = rate_text(graph.publishes[node, topic])
            kind = graph.topics[topic].rsplit("/", 1)[-1]
            readers = [
                reader + (f" (lost {graph.subscribes[topic, reader]})" if graph.subscribes[topic, reader] else "")
                for reader in graph.readers(topic)
            ]
            branch = "└─" if topic == topics[-1] else "├─"
            lines.append(
                f"  {branch} {topic} [{kind}]{' ' + flow if flow else ''} → {', '.join(readers) or 'no subscriber'}"
            )
    unfed = [topic for topic in graph.topics if not any(name == topic for _, name in graph.publishes)]
    lines += [
        f"{topic} [{graph.topics[topic]}] has no publisher → {', '.join(graph.readers(topic))}" for topic in unfed
    ]
    return "\n".join(lines)


def dot(graph: StackGraph) -> str:
    """The graph in Graphviz's DOT language; the fill of a node shows its state."""
    lines = [
        "digraph stack {",
        "  rankdir=LR; node [fontname=Helvetica, fontsize=10]; edge [fontname=Helvetica, fontsize=8];",
    ]
    lines += [
        f'  "{node}" [shape=box, style="rounded,filled", fillcolor="{_FILLS.get(state, "#dce8f7")}"];'
        for node, state in graph.nodes.items()
    ]
    lines += [
        f'  "{topic}" [shape=plain, label="{topic}\\n{kind.rsplit("/", 1)[-1]}"];'
        for topic, kind in graph.topics.items()
    ]
    lines += [f'  "{n}" -> "{t}" [label="{rate_text(rate)}"];' for (n, t), rate in graph.publishes.items()]
    for (topic, node), lost in graph.subscribes.items():
        label = f' [label="lost {lost}", color=red]' if lost else ""
        lines.append(f'  "{topic}" -> "{node}"{label};')
    return "\n".join([*lines, "}", ""])


def mermaid(graph: StackGraph) -> str:
    """The graph as a Mermaid flowchart, which Markdown pages can show."""
    keys = {name: f"v{number}" for number, name in enumerate([*graph.nodes, *graph.topics])}
    lines = ["flowchart LR"]
    lines += [f'  {keys[node]}["{node}"]' for node in graph.nodes]
    lines += [f'  {keys[topic]}(["{topic}"])' for topic in graph.topics]
    for (node, topic), rate in graph.publishes.items():
        label = f'|"{rate_text(rate)}"|' if rate_text(rate) else ""
        lines.append(f"  {keys[node]} -->{label} {keys[topic]}")
    for (topic, node), lost in graph.subscribes.items():
        lines.append(f"  {keys[topic]} -->" + (f'|"lost {lost}"| ' if lost else " ") + keys[node])
    return "\n".join([*lines, ""])


def write(graph: StackGraph, path: Path) -> None:
    """Write the graph as ``.dot`` or ``.mmd`` text, or as an image that Graphviz's ``dot`` renders.

    Raises:
        ValueError: the suffix is not supported, or an image is requested and ``dot`` is missing or fails.
        OSError: the file cannot be written.
    """
    kind = path.suffix.lstrip(".").lower()
    if kind == "dot":
        path.write_text(dot(graph))
    elif kind == "mmd":
        path.write_text(mermaid(graph))
    elif kind in IMAGES:
        path.write_bytes(_render(graph, kind, path))
    else:
        known = ", ".join(f".{suffix}" for suffix in ("dot", "mmd", *IMAGES))
        raise ValueError(f"{path}: the name must end in one of {known}")


def _render(graph: StackGraph, kind: str, path: Path) -> bytes:
    program = shutil.which("dot")
    if program is None:
        raise ValueError(
            f"{path}: images are rendered by Graphviz, which is not installed (sudo apt install graphviz). "
            f"Or write {path.with_suffix('.mmd')}: GitHub, VS Code and mermaid.live render it"
        )
    command = [program, f"-T{kind}"]
    try:
        done = subprocess.run(command, input=dot(graph).encode(), capture_output=True, timeout=_RENDER_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise ValueError(f"{path}: dot did not finish within {_RENDER_TIMEOUT_S:g} s; write a .dot file") from None
    if done.returncode:
        raise ValueError(f"{path}: dot failed: {done.stderr.decode(errors='replace').strip()}")
    return done.stdout
