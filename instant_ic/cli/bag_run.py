"""``ic bag record``, ``play``, ``snapshot`` and ``control``: the commands that use the bus."""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

from instant_ic.bus.control import ControlError, NodeBusyError, NodeControl
from instant_ic.bus.node_files import node_class
from instant_ic.bus.process import run as run_node
from instant_ic.bus.registry import NodeInfo, list_nodes
from instant_ic.cli.commands.bag import argument_of, topic_names
from instant_ic.cli.errors import UserError
from instant_ic.util.paths import run_dir

_STARTING_S = 10.0  # grace period for a node that is just starting
_STEERED = ("bag_recorder", "bag_player")


def record(args: argparse.Namespace) -> int:
    if args.output and Path(args.output).exists() and not args.snapshot:
        raise UserError(f"{args.output} exists already: choose another name with -o")
    words = ["--name", f"bag_recorder_{os.getpid()}"]
    words += _parameters(
        path=args.output,
        duration_s=args.duration,
        topics=topic_names(args.topics),
        exclude=topic_names(args.exclude),
        compressed=args.compression,
        max_bag_size=args.max_bag_size,
        max_bag_duration=args.max_bag_duration,
        queue_mb=_megabytes(args.max_queue),
        min_free_mb=args.min_free // 1_000_000,
        snapshot=args.snapshot,
        max_cache_mb=_megabytes(args.max_cache_size),
    )
    if args.snapshot:
        words += _parameters(snapshot_seconds=args.snapshot_seconds, snapshot_after_s=args.snapshot_after)
    words += _parameters(use_sim_time=True) if args.use_sim_time else []
    return run_node(node_class("bag_recorder"), words)


def play(args: argparse.Namespace) -> int:
    if not Path(args.bag).exists():
        raise UserError(f"bag {args.bag} does not exist")
    words = ["--name", f"bag_player_{os.getpid()}"]
    words += _parameters(
        use_sim_time=True,
        bag=args.bag,
        rate=args.rate,
        start_offset_s=args.start,
        duration_s=args.duration,
        loop=args.loop,
        start_paused=args.start_paused,
        topics=topic_names(args.topics),
        exclude=topic_names(args.exclude),
        publish_clock=not args.no_clock,
        delay_s=args.delay,
        wait_for=args.wait_for,
        force=args.force,
    )
    for remap in args.remap:
        words += ["-r", remap]
    return run_node(node_class("bag_player"), words)


def snapshot(args: argparse.Namespace) -> int:
    node = _node(("bag_recorder",), args.node, keeps_snapshots=True)
    recorder = NodeControl(run_dir(), node.name)
    path = _call(recorder, "snapshot", reason=args.reason)["path"]
    deadline_s = time.monotonic() + args.timeout
    while time.monotonic() < deadline_s:
        made = next(s for s in _call(recorder, "status")["snapshots"] if s["path"] == path)
        if made["state"] == "done":
            print(f"{path}: {made['text']}")
            return 0
        if made["state"] == "failed":
            raise UserError(made["text"])
        time.sleep(0.1)
    raise UserError(f"{node.name} did not write {path} within {args.timeout:g} s")


def control(args: argparse.Namespace) -> int:
    arguments = argument_of(args.command, args.value)
    on_request = args.command in ("record", "stop")
    kinds = _STEERED if args.command == "status" else ("bag_recorder",) if on_request else ("bag_player",)
    node = _node(kinds, args.node, keeps_snapshots=on_request)
    result = _call(NodeControl(run_dir(), node.name), args.command, **arguments)
    if args.command == "status":
        print(json.dumps({"node": node.name, **result}, indent=2))
    else:
        print(f"{node.name}: {args.command}" + (f" {result['path']}" if on_request else ""))
    return 0


def _call(node: NodeControl, command: str, **arguments: Any) -> Any:
    deadline_s = time.monotonic() + _STARTING_S
    while True:
        try:
            return node.call(command, **arguments)
        except NodeBusyError as error:
            if time.monotonic() > deadline_s:
                raise UserError(str(error)) from None
            time.sleep(0.1)
        except ControlError as error:
            raise UserError(str(error)) from None


def _node(kinds: tuple[str, ...], name: str, *, keeps_snapshots: bool = False) -> NodeInfo:
    """Return the node that a command is for; of several recorders, the one that supports the command."""
    running = [node for node in list_nodes(run_dir()) if node.executable in kinds]
    chosen = [node for node in running if not name or node.name == name]
    if len(chosen) > 1:
        able = [node for node in chosen if bool(node.params.get("snapshot")) is keeps_snapshots]
        chosen = able or chosen
    if len(chosen) == 1:
        return chosen[0]
    what = " or ".join(kinds)
    if not chosen:
        others = f" (running: {', '.join(node.name for node in running)})" if running else ""
        raise UserError(f"no {what}{f' named {name}' if name else ''} runs in {run_dir()}{others}")
    raise UserError(f"several are running, choose one with --node: {', '.join(node.name for node in chosen)}", 2)


def _megabytes(size: int) -> int:
    return max(1, size // 1_000_000)


def _parameters(**values: Any) -> list[str]:
    """Return parameter arguments for a node's command line (JSON is valid YAML)."""
    return [word for key, value in values.items() for word in ("-p", f"{key}:={json.dumps(value)}")]
