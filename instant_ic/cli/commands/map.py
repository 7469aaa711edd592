"""``ic map``: save the map of the running stack."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from instant_ic.cli.errors import UserError

SAVE, SAVED = "/slam/save", "/slam/saved"


def add_parser(subparsers: Any) -> None:
    """Add ``map`` to the ``ic`` command."""
    parser = subparsers.add_parser("map", help="save the map", description="Save the map of the running stack.")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    save = verbs.add_parser(
        "save",
        help="save the map in ROS format",
        description=(
            "Make grid_slam write NAME.yaml and NAME.pgm for ROS's map_server, and NAME.graph.npz, from which "
            "mapping can continue (grid_slam's map_file)."
        ),
        epilog="example: ic map save ~/maps/floor3",
    )
    save.add_argument("name", type=Path, metavar="NAME", help="path without suffix; missing folders are created")
    save.add_argument(
        "--timeout", type=float, default=20.0, metavar="S", help="wait at most this long (default: %(default)g s)"
    )
    save.set_defaults(func=save_map)


def save_map(args: argparse.Namespace) -> int:
    """Run ``ic map save``; return the exit status."""
    from instant_ic.bus import RELIABLE
    from instant_ic.bus.node import Publisher
    from instant_ic.cli.observer import Observer
    from instant_ic.msg import deserialize, message_type, type_name

    if not args.timeout > 0:
        raise UserError(f"--timeout must be > 0 (got {args.timeout:g})", 2)
    name = args.name.expanduser().absolute()
    if name.suffix in (".yaml", ".pgm"):
        raise UserError(f"NAME must have no suffix: {name.with_suffix('')}", 2)
    string = message_type("String")
    deadline = time.monotonic() + args.timeout
    with Observer([SAVED]) as observer:
        request = Publisher(observer.transport.advertise(SAVE, type_name(string), RELIABLE))
        while request.subscriber_count == 0:
            if time.monotonic() > deadline:
                raise UserError("cannot save the map: grid_slam is not running (ic node list)")
            time.sleep(0.05)
        request.publish(string(data=str(name)))
        for batch in observer.batches(max(deadline - time.monotonic(), 0.1), 0.1):
            for received in batch:
                answer = str(deserialize(received.payload, received.type_name).data)
                if str(name) not in answer and answer.startswith("saved"):
                    continue  # answers another client's request
                if not answer.startswith("saved"):
                    raise UserError(answer.removeprefix("error: "))
                print(answer)
                return 0
    raise UserError(f"grid_slam did not answer in {args.timeout:g} s (ic log grid_slam)")
