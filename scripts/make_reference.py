#!/usr/bin/env python3
"""Write docs/reference.md: topics and parameters of every node, read from the code and config/*.yaml.

Usage: python scripts/make_reference.py [--check]
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "docs" / "reference.md"
CALLS = {
    "publisher": "gives",
    "subscribe": "takes",
    "latest": "takes",
    "subscribe_raw": "takes",
    "subscribe_received": "takes",
}


def topics(source: str) -> dict[str, dict[str, str]]:
    """Topics of the publisher, subscribe and latest calls with literal names in a node's source.

    Returns:
        Direction → topic → type.
    """
    found: dict[str, dict[str, str]] = {"takes": {}, "gives": {}}
    for call in ast.walk(ast.parse(source)):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
            continue
        name, arguments = call.func.attr, call.args
        if name in CALLS and len(arguments) >= 2 and isinstance(arguments[0], ast.Constant):
            topic = arguments[0].value
            if isinstance(topic, str) and topic.startswith("/"):
                kind = arguments[1]
                if name in ("subscribe_raw", "subscribe_received"):  # raw bytes, passed on or decoded by the callback
                    kind = next((k.value for k in call.keywords if k.arg == "message_class"), ast.Name("bytes"))
                found[CALLS[name]][topic] = ast.unparse(kind)
        elif name == "tf_broadcast":
            found["gives"]["/tf"] = "TFMessage"
        elif name == "tf_broadcast_static":
            found["gives"]["/tf_static"] = "TFMessage"
    if re.search(r"self\.tf\b", source):
        found["takes"].setdefault("/tf", "TFMessage")
        found["takes"].setdefault("/tf_static", "TFMessage")
    return found


def cell(text: str) -> str:
    """Escape text for a Markdown table cell."""
    return text.replace("|", "\\|")


def render() -> str:
    """Return the page as Markdown."""
    from instant_ic.bus.node_files import node_class
    from instant_ic.config.parameter_info import parameter_infos

    lines = [
        "# Nodes, topics, parameters",
        "",
        "Made by `scripts/make_reference.py` from the code and `config/*.yaml`; a test holds it to them. Every node",
        "also takes `use_sim_time` and `nice` (0..19; a higher value leaves the CPU to others) and gives `/heartbeat`,",
        "`/diagnostics`, `/rosout` and `/parameter_events`. Live parameters can be changed while the node runs",
        "(`ic param set`). Our own types stand in `instant_ic/msg/definitions/`; the others are ROS 2's.",
        "",
    ]
    missing = []
    for path in sorted((ROOT / "nodes").glob("[a-z]*.py")):
        cls = node_class(path.stem)
        source = path.read_text()
        summary = (inspect.getdoc(sys.modules[cls.__module__]) or "").split("\n\n")[0].replace("\n", " ")
        lines += [f"## {cls.name}", "", summary, ""]
        found = topics(source)
        for direction in ("takes", "gives"):
            if found[direction]:
                listed = ", ".join(f"`{t}` {k}" for t, k in sorted(found[direction].items()))
                lines += [f"{direction.capitalize()}: {listed}", ""]
        infos = parameter_infos(cls.config_class(), live=cls.live_parameters, node=cls.name)
        if infos:
            lines += ["| Parameter | Type | Default | Range | Live | Meaning |", "|---|---|---|---|---|---|"]
        for info in infos:
            if not info.description:
                missing.append(f"{cls.name}.{info.name}")
            row = (f"`{info.name}`", info.type, f"`{info.default!r}`", info.range, "yes" * info.live, info.description)
            lines.append(f"| {' | '.join(cell(text) for text in row)} |")
        lines.append("")
    if missing:
        raise SystemExit(f"parameters without a comment in config/*.yaml or the docstring: {', '.join(missing)}")
    return "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Write the page, or check that it is up to date."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="only tell whether the page is current")
    args = parser.parse_args()
    page = render()
    if args.check:
        if not OUTPUT.exists() or OUTPUT.read_text() != page:
            print("docs/reference.md is not current: run python scripts/make_reference.py", file=sys.stderr)
            return 1
        return 0
    OUTPUT.write_text(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
