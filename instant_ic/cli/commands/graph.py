"""``ic graph``: nodes and topics of the running stack as a tree, text or image."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import verb
from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    add = verb(
        subparsers, "graph", "nodes and topics as a tree, Graphviz or Mermaid text, or an image", show,
        "ic graph -o stack.mmd", "Show publishers and subscribers as a tree, or write them to a file with -o.",
    ).add_argument  # fmt: skip
    text = "only these and their neighbours (default: all)"
    add("nodes", metavar="NODE", nargs="*", help=text, completer=completion.nodes)
    text = ".mmd (Mermaid), .dot (Graphviz), or .svg, .png, .pdf, which need Graphviz"
    add("-o", "--output", type=Path, metavar="FILE", help=text)
    text = "also topics that every node has, and topics without a subscriber or publisher"
    add("-a", "--all", action="store_true", help=text)
    add("--tf", action="store_true", help="also /tf and /tf_static")


def show(args: argparse.Namespace) -> int:
    from instant_ic.bus import registry
    from instant_ic.cli.graph import make_graph, tree, write
    from instant_ic.cli.heartbeats import hear
    from instant_ic.cli.names import find_node, nobody_runs
    from instant_ic.util import paths

    only = [find_node(name).name for name in args.nodes]
    infos = registry.list_nodes(paths.run_dir())
    if not infos:
        raise UserError(nobody_runs())
    graph = make_graph(infos, hear(paths.run_dir(), [info.name for info in infos]), only, args.all, args.tf)
    if args.output is None:
        print(tree(graph))
        if graph.hidden:
            print(f"\nnot shown: {', '.join(graph.hidden)} (--all shows them)")
        return 0
    try:
        write(graph, args.output)
    except ValueError as error:
        raise UserError(str(error), 2) from error
    print(f"{args.output}: {len(graph.nodes)} nodes, {len(graph.topics)} topics")
    return 0
