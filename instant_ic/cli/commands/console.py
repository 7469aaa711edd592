"""``ic console``: what the operator's page shows, as a file."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import check_files, group, positive, verb
from instant_ic.cli.errors import UserError

if TYPE_CHECKING:
    from instant_ic.bus.transport import Received

LAYERS = "/vspace/layers"


def add_parser(subparsers: Any) -> None:
    text = "export what the operator's page shows"
    verbs = group(subparsers, "console", text, f"{text.capitalize()}.")
    add = verb(
        verbs, "export-scene", "save the virtual space as one HTML file", export_scene,
        "ic console export-scene -o scene.html",
        "Save the present virtual space of the running stack, or the newest one of a bag, as one HTML file to look "
        "round in and walk through. It needs no server and no network, only a browser with WebGL 2.",
    ).add_argument  # fmt: skip
    add("bag", type=Path, nargs="?", metavar="BAG", help="a recording (default: the running stack)")
    add("-o", "--output", type=Path, required=True, metavar="FILE.html", help="file to write")
    add("--timeout", type=positive, default=10.0, metavar="S", help="wait at most this long (%(default)g s)")


def export_scene(args: argparse.Namespace) -> int:
    from instant_ic.adapters.vspace import layers_of
    from instant_ic.console.export_scene import scene_html
    from instant_ic.console.layer_meshes import LayerMeshes
    from instant_ic.msg import MessageError, deserialize

    check_files(args.output)
    received = newest_of_bag(args.bag) if args.bag else newest_of_stack(args.timeout)
    try:
        message = deserialize(received.payload, received.type_name)
        version = layers_of(message)
        layers = LayerMeshes().layers(version)
    except (ValueError, MessageError) as error:
        raise UserError(f"{LAYERS}: {error}") from error
    newest = version.layers[0].keyframe_id
    made = time.strftime("%Y-%m-%d %H:%M", time.localtime(message.header.stamp.sec))
    args.output.write_text(scene_html(f"Keyframe {newest}, {made}", layers), encoding="utf-8")
    triangles = sum(len(layer.triangles) for layer in layers)
    print(f"wrote {args.output}: keyframe {newest}, {triangles} triangles")
    return 0


def newest_of_bag(path: Path) -> Any:
    """The newest message of the layers in a bag."""
    from instant_ic.bag import BagReader

    newest = None
    with BagReader(path) as bag:
        for newest in bag.messages([LAYERS]):  # noqa: B007
            pass
    if newest is None:
        raise UserError(f"{path} holds no {LAYERS}: record it while the stack runs, with ic bag record")
    return newest


def newest_of_stack(timeout_s: float) -> Received:
    """The newest message of the layers in the running stack."""
    from instant_ic.cli.observer import newest

    received = newest(LAYERS, timeout_s)
    if received is None:
        raise UserError(
            f"no virtual space on {LAYERS} within {timeout_s:g} s: nerf is not running, or there is no keyframe yet "
            "(ic topic echo /vspace/status)"
        )
    return received
