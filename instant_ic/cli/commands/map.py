"""``ic map``: save the map or the local 3D model of the running stack, or the 3D model of a bag."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import check_files, group, positive, verb
from instant_ic.cli.errors import UserError

LOCAL = "/map/local"


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
        "Save the local 3D model (the LiDAR's measurements over the last 10 m of the way) as a PLY file, in the map "
        "frame. It comes from topic /map/local of the running stack, which may be `ic launch replay bag:=BAG`.",
    ).add_argument  # fmt: skip
    add("-o", "--out", type=Path, required=True, metavar="FILE.ply", help="point cloud to write")
    add("--timeout", type=positive, default=10.0, metavar="S", help=text)


def save_map(args: argparse.Namespace) -> int:
    from instant_ic.bus.control import ControlError, NodeControl
    from instant_ic.bus.registry import list_nodes
    from instant_ic.util.paths import run_dir

    name = args.name.expanduser().absolute()
    if name.suffix in (".yaml", ".pgm"):
        raise UserError(f"NAME must have no suffix: {name.with_suffix('')}", 2)
    running = [node.name for node in list_nodes(run_dir()) if node.executable == "grid_slam"]
    if not running:
        raise UserError("cannot save the map: grid_slam is not running (ic node list)")
    try:
        files = NodeControl(run_dir(), running[0], args.timeout).call("save", path=str(name))
    except ControlError as error:
        raise UserError(str(error)) from None
    print("saved: " + ", ".join(files))
    return 0


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
