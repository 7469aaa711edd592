"""``ic map``: save the map or the local 3D model of the running stack, or the 3D model of a bag."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import check_files, group, positive, verb
from instant_ic.cli.errors import UserError

SAVE, SAVED, LOCAL = "/slam/save", "/slam/saved", "/map/local"


def add_parser(subparsers: Any) -> None:
    verbs = group(subparsers, "map", "save the map", "Save the map or the local 3D model of the running stack.")
    text = "wait at most this long (default: %(default)g s)"
    add = verb(
        verbs, "save", "save the map in ROS format", save_map, "ic map save ~/maps/floor3",
        "Make grid_slam write NAME.yaml and NAME.pgm for ROS's map_server, and NAME.graph.npz, from which "
        "mapping can continue (grid_slam's map_file).",
    ).add_argument  # fmt: skip
    add("name", type=Path, metavar="NAME", help="path without suffix; missing folders are created")
    add("--timeout", type=positive, default=20.0, metavar="S", help=text)
    add = verb(
        verbs, "local", "save the local 3D model as a point cloud", save_local,
        "ic map local -o cloud.ply",
        "Save the local 3D model (what the LiDAR has measured over the last 10 m of the way) as a PLY file, in the "
        "map frame (topic /map/local of the running stack, also of `ic launch replay bag:=BAG`).",
    ).add_argument  # fmt: skip
    add("-o", "--out", type=Path, required=True, metavar="FILE.ply", help="point cloud to write")
    add("--timeout", type=positive, default=10.0, metavar="S", help=text)


def save_map(args: argparse.Namespace) -> int:
    from instant_ic.bus import RELIABLE
    from instant_ic.bus.topics import Publisher
    from instant_ic.cli.observer import TopicObserver
    from instant_ic.msg import deserialize, message_type, type_name

    name = args.name.expanduser().absolute()
    if name.suffix in (".yaml", ".pgm"):
        raise UserError(f"NAME must have no suffix: {name.with_suffix('')}", 2)
    string = message_type("String")
    deadline = time.monotonic() + args.timeout
    with TopicObserver([SAVED]) as observer:
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


def save_local(args: argparse.Namespace) -> int:
    from instant_ic.cli.observer import newest
    from instant_ic.geometry.ply import write_ply
    from instant_ic.msg import cloud_xyz, deserialize

    out = args.out.expanduser()
    check_files(out)
    received = newest(LOCAL, args.timeout)
    if received is None:
        raise UserError(
            f"no local model on {LOCAL} within {args.timeout:g} s: depth_scaler is not running, or the LiDAR or "
            "odometry is missing (ic node list, ic topic hz /lidar/points)"
        )
    points = cloud_xyz(deserialize(received.payload, received.type_name))
    write_ply(out, points)
    print(f"wrote {out}: {len(points)} points")
    return 0
