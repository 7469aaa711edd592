"""``ic replay``: replay a bag through nodes in lockstep."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import verb
from instant_ic.cli.commands.bag import tolerances
from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    parser = verb(
        subparsers, "replay", "replay a bag through nodes in lockstep and record their output", run,
        "ic replay drive --nodes grid_slam,depth_estimator,depth_scaler -o again -p grid_slam.field.resolution_m:=0.1",
        "Run nodes in one process on the clock of a bag, message by message, and record what they publish. "
        "The result does not depend on the speed of the machine: repeating a command gives the same bytes.",
    )  # fmt: skip
    add, many = parser.add_argument, {"action": "append", "default": []}
    add("bag", metavar="BAG")
    add("--nodes", required=True, metavar="A,B,...", help="nodes, in the order in which they run")
    add("-o", "--output", required=True, metavar="DIR", help="new bag")
    text = "parameter file; repeatable; default: the nodes' files in config/"
    add("--params-file", action="append", type=Path, metavar="FILE", help=text)
    add("-p", "--param", **many, metavar="NODE.KEY:=VALUE", help="one parameter; repeatable")
    add("--drop-tf", **many, metavar="FRAME", help="leave out transforms with this child frame; repeatable")
    add("--compression", action="store_true", help="compress the new bag with zstd")
    text = "compare the result with this bag; exit status 1 if a topic differs"
    add("--compare", default="", metavar="BAG", help=text)
    tolerances(parser)


def run(args: argparse.Namespace) -> int:
    from instant_ic.util.paths import node_names

    names = [name for name in args.nodes.split(",") if name]
    for name in names:
        if name not in node_names():
            raise UserError(f"there is no node {name!r}; available: {', '.join(node_names())}", 2)
    for word in args.param:
        node, dot, rest = word.partition(".")
        if not dot or ":=" not in rest or node not in names:
            raise UserError(f"-p {word}: expected NODE.KEY:=VALUE, NODE being one of {', '.join(names)}", 2)
    if Path(args.output).exists():
        raise UserError(f"{args.output} exists already: choose another name with -o")
    for bag in filter(None, (args.bag, args.compare)):
        if not Path(bag).exists():
            raise UserError(f"bag {bag} does not exist")

    from instant_ic.bag.compare import compare
    from instant_ic.bag.replay import make_node, replay
    from instant_ic.cli.bag_look import print_differences, tolerance_of
    from instant_ic.cli.progress import progress

    tolerance = tolerance_of(args)
    logging.basicConfig(level="WARNING", format="%(levelname)-7s %(name)s: %(message)s")
    nodes = [make_node(name, args.params_file, args.param) for name in names]
    with progress(f"replaying {args.bag}") as step:
        result = replay(Path(args.bag), nodes, Path(args.output), args.drop_tf, step, args.compression)
    print(f"{args.output}: {result.made.total()} messages from {result.fed.total()} of {args.bag}")
    for topic, count in sorted(result.made.items()):
        print(f"  {topic}: {count}")
    left_out = ", ".join(f"{topic} {count}" for topic, count in sorted(result.left_out.items()))
    if left_out:
        print(f"not fed: {left_out}")
    speed = result.bag_s / max(result.wall_s, 1e-9)
    took = f"{result.wall_s:.1f} s, {speed:.1f} x real time, after {result.setup_s:.1f} s to start"
    print(f"{result.bag_s:.1f} s of bag in {took}")
    if not args.compare:
        return 0
    found = compare(Path(args.output), Path(args.compare), tuple(args.ignore), True, tolerance)
    if not found:
        raise UserError(f"{args.output} and {args.compare} have no topic in common")
    return print_differences(found)
