#!/usr/bin/env python3
"""Writes docs/reference.md: every node with its topics and parameters, read from the code and config/*.yaml.

Usage: python scripts/make_reference.py [--check]
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import inspect
import re
import sys
import types
import typing
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "docs" / "reference.md"
CALLS = {"publisher": "gives", "subscribe": "takes", "latest": "takes"}


def node_class(module: types.ModuleType) -> Any:
    """The node that a module of instant_ic.nodes defines."""
    from instant_ic.bus import Node

    for _, value in inspect.getmembers(module, inspect.isclass):
        if issubclass(value, Node) and value is not Node and value.__module__ == module.__name__:
            return value
    raise SystemExit(f"{module.__name__} defines no node")


def topics(source: str) -> dict[str, dict[str, str]]:
    """Topics of the literal publisher, subscribe and latest calls in a node's source: direction → topic → type."""
    found: dict[str, dict[str, str]] = {"takes": {}, "gives": {}}
    for call in ast.walk(ast.parse(source)):
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
            continue
        name, arguments = call.func.attr, call.args
        if name in CALLS and len(arguments) >= 2 and isinstance(arguments[0], ast.Constant):
            topic = arguments[0].value
            if isinstance(topic, str) and topic.startswith("/"):
                found[CALLS[name]][topic] = ast.unparse(arguments[1])
        elif name == "tf_broadcast":
            found["gives"]["/tf"] = "TFMessage"
        elif name == "tf_broadcast_static":
            found["gives"]["/tf_static"] = "TFMessage"
    if re.search(r"self\.tf\b", source):
        found["takes"].setdefault("/tf", "TFMessage")
        found["takes"].setdefault("/tf_static", "TFMessage")
    return found


def comments(path: Path) -> dict[str, dict[str, str]]:
    """Comment of every key of a parameter file: node → dotted key → text."""
    result: dict[str, dict[str, str]] = {}
    stack: list[tuple[int, str]] = []
    above: list[str] = []
    for line in path.read_text().splitlines():
        bare = line.strip()
        if bare.startswith("#"):
            above.append(bare.lstrip("# ").strip())
            continue
        match = re.match(r"^(\s*)([\w/*]+):(.*)$", line)
        if not match:
            above = []
            continue
        indent, key, rest = len(match[1]), match[2], match[3]
        while stack and stack[-1][0] >= indent:
            stack.pop()
        stack.append((indent, key))
        names = [name for _, name in stack]
        beside = re.search(r"(?:^|\s)#\s*(.*)$", rest)
        text = " ".join([*above, *([beside[1].strip()] if beside else [])])
        if len(names) > 2 and text:
            result.setdefault(names[0], {})[".".join(names[2:])] = text
        above = []
    return result


def attributes(config_class: type[Any]) -> dict[str, str]:
    """Texts of the "Attributes:" part of a docstring; ``a, b: text`` holds for both."""
    doc = inspect.getdoc(config_class) or ""
    part = doc.partition("Attributes:\n")[2].split("\n\n")[0]
    found: dict[str, str] = {}
    names: list[str] = []
    for line in part.splitlines():
        if match := re.match(r"    (\w+(?:, \w+)*): (.*)", line):
            names = match[1].split(", ")
            found.update(dict.fromkeys(names, match[2]))
        else:
            found.update({name: f"{found[name]} {line.strip()}" for name in names})
    return found


def parameters(config_class: type[Any], prefix: str = "") -> list[tuple[str, str, str, str]]:
    """(dotted key, type, default, meaning by the docstring) of a configuration."""
    rows = []
    meanings = attributes(config_class)
    hints = typing.get_type_hints(config_class)
    for field in dataclasses.fields(config_class):
        hint = hints[field.name]
        if dataclasses.is_dataclass(hint):
            rows += parameters(typing.cast(type[Any], hint), f"{prefix}{field.name}.")
            continue
        if field.default is not dataclasses.MISSING:
            default = field.default
        elif field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        else:
            default = "(required)"
        kind = hint.__name__ if isinstance(hint, type) and not typing.get_args(hint) else str(hint)
        kind = kind.replace("typing.", "").replace("pathlib.", "")
        shown = str(default) if isinstance(default, Path) else repr(default)
        rows.append((prefix + field.name, kind, shown, meanings.get(field.name, "")))
    return rows


def cell(text: str) -> str:
    """Text that a Markdown table can hold."""
    return text.replace("|", "\\|")


def render() -> str:
    """The page."""
    described: dict[str, dict[str, str]] = {}
    for path in sorted((ROOT / "config").glob("*.yaml")):
        for node, keys in comments(path).items():
            described.setdefault(node, {}).update(keys)
    lines = [
        "# Nodes, topics, parameters",
        "",
        "Made by `scripts/make_reference.py` from the code and `config/*.yaml`; a test holds it to them. Every node",
        "also takes `use_sim_time` and `nice` (0..19; a higher value leaves the CPU to others) and gives `/heartbeat`,",
        "`/diagnostics` and `/rosout`. Our own types stand in `instant_ic/msg/definitions/`; the others are ROS 2's.",
        "",
    ]
    missing = []
    for path in sorted((ROOT / "instant_ic" / "nodes").glob("[a-z]*.py")):
        cls = node_class(importlib.import_module(f"instant_ic.nodes.{path.stem}"))
        source = path.read_text()
        summary = (inspect.getdoc(sys.modules[cls.__module__]) or "").split("\n\n")[0].replace("\n", " ")
        lines += [f"## {cls.name}", "", summary, ""]
        found = topics(source)
        for direction in ("takes", "gives"):
            if found[direction]:
                listed = ", ".join(f"`{t}` {k}" for t, k in sorted(found[direction].items()))
                lines += [f"{direction.capitalize()}: {listed}", ""]
        rows = parameters(cls.config_class())
        if rows:
            lines += ["| Parameter | Type | Default | Meaning |", "|---|---|---|---|"]
        for key, kind, default, documented in rows:
            meaning = described.get(cls.name, {}).get(key) or documented
            if not meaning:
                missing.append(f"{cls.name}.{key}")
            lines.append(f"| `{key}` | {cell(kind)} | `{cell(default)}` | {cell(meaning)} |")
        lines.append("")
    if missing:
        raise SystemExit(f"parameters without a comment in config/*.yaml or the docstring: {', '.join(missing)}")
    return "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Writes or checks the page."""
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
