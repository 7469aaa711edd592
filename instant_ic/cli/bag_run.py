"""``ic bag record``, ``play``, ``snapshot`` and ``control``: the commands that use the bus."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
from pathlib import Path
from typing import Any

from instant_ic.bus.control import ControlError, NodeBusyError, NodeControl
from instant_ic.bus.node_files import node_class
from instant_ic.bus.process import run as run_node
from instant_ic.bus.registry import NodeInfo, list_nodes
from instant_ic.cli.commands.bag import argument_of
from instant_ic.cli.errors import UserError
from instant_ic.util.paths import run_dir

_STARTING_S = 10.0  # grace period for a node that is just starting
_STEERED = ("bag_recorder", "bag_player")


def record(args: argparse.Namespace) -> int:
    if "path" in args and "snapshot" not in args and Path(args.path).exists():
        raise UserError(f"{args.path} exists already: choose another name with -o")
    return _run("bag_recorder", args, "use_sim_time" in args)


def play(args: argparse.Namespace) -> int:
    if not Path(args.bag).exists():
        raise UserError(f"bag {args.bag} does not exist")
    return _run("bag_player", args, True, *(word for remap in args.remap for word in ("-r", remap)))


def _run(node: str, args: argparse.Namespace, use_sim_time: bool, *words: str) -> int:
    """Run a node in this process with the arguments that have the name of a parameter."""
    found = node_class(node)
    names = {field.name for field in dataclasses.fields(found.config_class())}
    given = {name: value for name, value in vars(args).items() if name in names} | {"use_sim_time": use_sim_time}
    # JSON is valid YAML.
    parameters = [word for name, value in given.items() for word in ("-p", f"{name}:={json.dumps(value)}")]
    return run_node(found, ["--name", f"{node}_{os.getpid()}", *parameters, *words])


def snapshot(args: argparse.Namespace) -> int:
    node = _node(("bag_recorder",), args.node, keeps_snapshots=True)
    recorder = NodeControl(run_dir(), node.name)
    path = _call(recorder, "snapshot", reason=args.reason)["path"]
    deadline_s = time.monotonic() + args.timeout
    while time.monotonic() < deadline_s:
        made = next(s for s in _call(recorder, "status")["snapshots"] if s["path"] == path)
        if made["error"]:
            raise UserError(made["error"])
        if made["state"] == "ended":
            print(f"{path}: {made['messages']} messages, {made['bytes'] / 1e6:.1f} MB")
            return 0
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
    """Return the node that a command addresses; among several recorders, the one that supports the command."""
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
