"""``ic vspace``: train a virtual space from one panorama; render, export or film it."""

from __future__ import annotations

import argparse
import dataclasses
import math
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import group, numbers, positive, positive_int, size, verb
from instant_ic.cli.errors import UserError
from instant_ic.util.files import replacing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from instant_ic.vspace import View, VirtualSpace, VirtualSpaceConfig

DEVICES = ("auto", "cpu", "cuda", "triton", "torch-cuda", "torch-cpu")
"""Same values as in ``VirtualSpaceConfig``; its module is too heavy to import here."""
PREVIEW = "preview.png"
PREVIEW_S = 1.0
_LAYERS = "/vspace/layers"
_SIZES = {"perspective": (640, 360), "equirect": (1024, 512), "cube": (512, 512)}
_TRUE_SIGMA, _MODEL_SIGMA = 0.02, 0.1
_LITTLE = 0.1
"""Below this share of known pixels an image is little more than a guess."""


def degrees(text: str) -> float:
    """A field of view."""
    value = float(text)
    if not 1 <= value <= 170:
        raise argparse.ArgumentTypeError(f"must lie in 1..170 degrees (got {text})")
    return value


def add_parser(subparsers: Any) -> None:
    verbs = group(
        subparsers, "vspace", "train and render a virtual space from one panorama",
        "Train a virtual space from one panorama and render it (docs/nerf.md). Poses are relative to the "
        "panorama's camera, in metres: x forward (the centre column of the panorama), y left, z up; yaw in degrees, "
        "counter-clockwise.",
        "ic vspace train room.jpg -o room && ic vspace render room --pose 0.5,0,0,30 -o view.png",
    )  # fmt: skip
    _add_train(verbs)
    _add_render(verbs)
    kind = _of_space(
        verbs, "export", "export the surfaces as PLY", export, "export room --mesh room.ply",
        "Export the surfaces that the panorama has seen as binary PLY, in the frame of the space.",
    )  # fmt: skip
    kind.add_argument("--width", type=positive_int, default=1024, help="points around the horizon (%(default)s)")
    kind = kind.add_mutually_exclusive_group(required=True)
    kind.add_argument("--points", type=Path, metavar="OUT.ply", help="coloured points")
    kind.add_argument("--mesh", type=Path, metavar="OUT.ply", help="coloured triangles, split at depth edges")
    flight = _of_space(
        verbs, "video", "record a flight through a space", video,
        "video room --path 0,0,0,0 1,0,0,0 1,0.3,0,90 -o flight.mp4",
        "Write a flight through a saved space as MP4, along a smooth curve through the waypoints.",
    )  # fmt: skip
    text = "two waypoints or more; the heading turns by the difference of the yaws (default: ahead, back, and one turn)"
    flight.add_argument("--path", type=numbers("x,y,z,yaw"), nargs="+", metavar="x,y,z,yaw", help=text)
    flight.add_argument("--seconds", type=positive, default=8.0, metavar="S", help="(%(default)g)")
    flight.add_argument("--fps", type=positive, default=25.0, help="frames per second (%(default)g)")
    _add_picture(flight)
    flight.add_argument("-o", "--out", type=Path, required=True, metavar="OUT.mp4", help="video to write")
    _of_space(verbs, "info", "print the content of a saved space", info_, "info room")
    for parser in verbs.choices.values():
        # Makes "--pose -1,0,0,90" a value: argparse on its own only recognises single negative numbers.
        parser._negative_number_matcher = re.compile(r"-[\d.]")


def _of_space(verbs: Any, name: str, words: str, run: Any, example: str, description: str = "") -> Any:
    """Add a verb for a saved space."""
    parser = verb(verbs, name, words, run, f"ic vspace {example}", description)
    text = f"folder written by ic vspace train; to render or export, also a bag with {_LAYERS}, of which the newest "
    parser.add_argument("space", type=Path, metavar="DIR", help=f"{text}counts")
    parser.add_argument("--device", choices=DEVICES, help="(default: as in training)")
    return parser


def _add_train(verbs: Any) -> None:
    parser = verb(
        verbs, "train", "train on a panorama", train,
        "ic vspace train room.jpg --depth room_depth.png --seconds 10 -o room",
        "Train on one panorama and save the space in a folder. A preview from 0.5 m ahead in that folder "
        f"({PREVIEW}) is updated every second. Ctrl-C ends the training early and saves the result.",
    )  # fmt: skip
    add = parser.add_argument
    add("panorama", type=Path, help="equirectangular image, twice as wide as high")
    depth = parser.add_mutually_exclusive_group()
    text = "its radial depth: 16-bit PNG in mm; .npy, .npz (key depth) or .exr in m; 0 or non-finite is unknown"
    depth.add_argument("--depth", type=Path, metavar="D", help=text)
    text = "depth model, ONNX or manifest (default: the shipped one; its metres are an estimate, not scaled by a LiDAR)"
    depth.add_argument("--model", type=Path, metavar="M", help=text)
    text = f"(default: {_TRUE_SIGMA:g} with --depth, {_MODEL_SIGMA:g} without)"
    add("--depth-sigma", type=positive, metavar="SHARE", help=f"relative standard deviation of depth {text}")
    text = "height of the camera above the floor; the estimate is scaled to it (default: the model's metres)"
    add("--camera-height", type=positive, metavar="M", help=text)
    text = "use the model's depth unchanged; otherwise nearly level floors and ceilings and nearly upright walls are "
    add("--as-estimated", action="store_true", help=f"{text}straightened")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--seconds", type=positive, metavar="S", help="train for about this time")
    text = "train this many iterations (default: 600)"
    length.add_argument("--iterations", type=positive_int, metavar="N", help=text)
    add("--device", default="auto", choices=DEVICES, help="(%(default)s)")
    add("-o", "--out", type=Path, required=True, metavar="DIR", help="output folder, created if missing")


def _add_picture(parser: argparse.ArgumentParser) -> None:
    text = "horizontal field of view (%(default)g degrees)"
    parser.add_argument("--fov", type=degrees, default=90.0, metavar="DEG", help=text)
    sizes = ", ".join(f"{name} {w}x{h}" for name, (w, h) in _SIZES.items())
    parser.add_argument("--size", type=size, metavar="WxH", help=f"pixels (default: {sizes})")


def _add_render(verbs: Any) -> None:
    parser = _of_space(
        verbs, "render", "render an image of a space", render,
        "render room --pose 0.5,-0.2,0,30 --fov 90 --size 640x360 -o view.png",
        "Render an image of a saved space. A cube map is one row of faces: front, left, back, right, up, down.",
    )  # fmt: skip
    _add_picture(parser)
    add = parser.add_argument
    add("--pose", type=numbers("x,y,z,yaw"), default=[0.0, 0.0, 0.0, 0.0], metavar="x,y,z,yaw", help="(0,0,0,0)")
    add("--projection", choices=tuple(_SIZES), default="perspective", help="(%(default)s)")
    add("-o", "--out", type=Path, required=True, metavar="PNG", help="image to write")
    add("--depth", type=Path, metavar="FILE", help="also write the depth: .png (16-bit, mm) or .npy (m)")
    text = "also write the confidence: white is seen, black is not"
    add("--confidence", type=Path, metavar="PNG", help=text)


# -- the commands --------------------------------------------------------------------------------------


def train(args: argparse.Namespace) -> int:
    from instant_ic.cli.progress import progress
    from instant_ic.depth.files import load_depth, load_picture
    from instant_ic.vspace import KeyframeError, VirtualSpaceConfig
    from instant_ic.vspace.warm_up import warm_up

    if args.camera_height and (args.depth or args.as_estimated):
        other = "--depth" if args.depth else "--as-estimated"
        raise UserError(
            f"--camera-height scales an estimate, but {other} uses the depth unchanged: omit one of them", 2
        )
    rgb = load_picture(args.panorama)
    if args.depth:
        depth, sigma = load_depth(args.depth), args.depth_sigma or _TRUE_SIGMA
    else:
        depth, sigma = estimated_depth(args.model, rgb), args.depth_sigma or _MODEL_SIGMA
        if not args.as_estimated:
            depth = _tidied(depth, args.camera_height, args.panorama)
    args.out.mkdir(parents=True, exist_ok=True)
    config = VirtualSpaceConfig(device=args.device)
    began = time.monotonic()
    warm_up(config)
    if time.monotonic() - began > 5:
        print("compiled the kernels (first run only)", file=sys.stderr)
    try:
        space = _space(config, rgb, depth, sigma, args)
    except KeyframeError as error:
        raise UserError(f"{args.panorama}{f' with {args.depth}' if args.depth else ''}: {error}") from error
    with progress("training") as advance:
        ended = _train(space, args, advance)
    file, status = space.save(args.out), space.status
    if status.warning:
        print(f"warning: {status.warning}", file=sys.stderr)
    print(f"{'ended early: ' if ended else ''}{status.iterations} iterations in {status.train_seconds:.1f} s on "
          f"{status.device}, {status.psnr_db:.1f} dB on the panorama's own rays; depth known in "
          f"{(depth > 0).mean():.0%}, usable up to {status.ready_radius_m:.1f} m; wrote {file}")  # fmt: skip
    return 0


def estimated_depth(model: Path | None, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Estimate the depth of a panorama in the model's own metres; print a note about that."""
    from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
    from instant_ic.util.paths import shipped_file

    loaded = DepthModel.load(model or shipped_file("models", DEFAULT_MODEL))
    kind = loaded.manifest.output_kind
    if kind not in ("metric", "scale_invariant"):
        raise UserError(
            f"{model}: its {kind} depth has no metric scale without a LiDAR; give --depth or a metric model"
        )
    print(f"no --depth: the scale is an estimate of {loaded.manifest.name}, not measured", file=sys.stderr)
    return loaded.estimate(rgb)


def _tidied(depth: NDArray[np.float32], camera_height_m: float | None, panorama: Path) -> NDArray[np.float32]:
    """Straighten floor, ceiling and walls of estimated depth; print where floor and ceiling are."""
    from instant_ic.depth.tidy import tidy

    try:
        room = tidy(depth, camera_height_m)
    except ValueError as error:
        raise UserError(f"{panorama}: {error}") from error
    found = [
        f"{name} {'not found' if away is None else f'{away:.2f} m {where} the camera'}"
        for name, away, where in (("floor", room.floor_m, "under"), ("ceiling", room.ceiling_m, "over"))
    ]
    scaled = f"; estimate scaled by {room.scale:.2f}" if camera_height_m else ""
    print(", ".join(found) + scaled, file=sys.stderr)
    return room.depth_m


def _space(config: VirtualSpaceConfig, rgb: Any, depth: Any, sigma: float, args: argparse.Namespace) -> VirtualSpace:
    """Virtual space with the panorama as its keyframe and a schedule of the requested length."""
    import numpy as np

    from instant_ic.vspace import VirtualSpace

    iterations = args.iterations or config.train.iterations
    if args.seconds:
        trial = VirtualSpace(config)
        trial.set_keyframe(rgb, depth, np.eye(4), sigma)
        iterations = max(10, int(1e3 * args.seconds * 5 / trial.train(iterations=5).elapsed_ms))
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, iterations=iterations))
    space = VirtualSpace(config)
    space.set_keyframe(rgb, depth, np.eye(4), sigma)
    return space


def _train(space: VirtualSpace, args: argparse.Namespace, advance: Any) -> bool:
    """Train to the end and report the progress; return whether the user ended it early."""
    from instant_ic.geometry.poses import pose_matrix

    preview = args.out / PREVIEW
    next_preview, total = 0.0, space.config.train.iterations
    deadline = 1.2 * args.seconds if args.seconds else math.inf
    try:
        while not space.status.converged and space.status.train_seconds < deadline:
            space.train(budget_ms=200)
            advance(space.status.iterations / total)
            begin = time.monotonic()
            if begin >= next_preview or space.status.converged:
                write_picture(preview, space.render(pose_matrix(x=0.5), *_SIZES["perspective"], math.pi / 2).rgb)
                took = time.monotonic() - begin
                next_preview = begin + max(PREVIEW_S, 4 * took)  # on a slow machine, training has priority
    except KeyboardInterrupt:
        return True
    return False


def open_space(args: argparse.Namespace) -> VirtualSpace:
    """Load the space given on the command line: a saved one, or the newest layers of a bag."""
    from instant_ic.vspace import VirtualSpace

    if args.space.suffix == ".mcap" or (args.space / "metadata.yaml").exists():
        return _space_of_bag(args.space)
    return VirtualSpace.load(args.space, args.device)


def _space_of_bag(path: Path) -> VirtualSpace:
    from instant_ic.adapters.vspace import layers_of
    from instant_ic.bag import BagReader
    from instant_ic.msg import MessageError, deserialize
    from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
    from instant_ic.vspace.layers import LayersError, decode

    newest = None
    with BagReader(path) as bag:
        for newest in bag.messages([_LAYERS]):  # noqa: B007
            pass
    if newest is None:
        raise UserError(f"{path} holds no {_LAYERS}. Record it while the stack runs, with `ic bag record`.")
    space = VirtualSpace(VirtualSpaceConfig(source="warp", device="cpu"))
    try:
        layers = layers_of(deserialize(newest.payload, newest.type_name))
        space.show(decode(layers, space.config.panorama_width))
    except (LayersError, MessageError) as error:
        raise UserError(f"{path}, newest message of {_LAYERS}: {error}") from error
    return space


def placed(space: VirtualSpace, pose: list[float]) -> NDArray[np.float64]:
    """Transform a pose relative to the panorama's camera (yaw in degrees) into the map of the space."""
    from instant_ic.geometry.poses import pose_matrix

    assert space.keyframe is not None
    x, y, z, yaw = pose
    return space.keyframe.map_from_camera @ pose_matrix(x, y, z, yaw=math.radians(yaw))


def render(args: argparse.Namespace) -> int:
    import numpy as np

    space = open_space(args)
    width, height = args.size or _SIZES[args.projection]
    pose = placed(space, args.pose)
    try:
        if args.projection == "perspective":
            view = space.render(pose, width, height, math.radians(args.fov))
        elif args.projection == "equirect":
            if width != 2 * height:
                raise UserError(f"--size of a panorama must be twice as wide as high (got {width}x{height})", 2)
            view = space.render_equirect(pose, width)
        else:
            if width != height:
                raise UserError(f"--size of a cube map must be that of one square face (got {width}x{height})", 2)
            view = space.render_cube(pose, width)
    except ValueError as error:
        raise UserError(f"--size: {error}", 2) from error
    write_picture(args.out, _row(view.rgb))
    if args.depth:
        write_depth(args.depth, _row(view.depth_m))
    if args.confidence:
        write_picture(args.confidence, (255 * _row(view.confidence)).astype(np.uint8))
    _warn_of_the_unknown(view, space, args.pose)
    print(f"{view.mean_confidence:.0%} of the image is known; wrote {args.out}")
    return 0


def _row(faces: NDArray) -> NDArray:
    """Faces of a cube map side by side; any other image unchanged."""
    import numpy as np

    return np.concatenate(list(faces), axis=1) if len(faces) == 6 else faces


def _warn_of_the_unknown(view: View, space: VirtualSpace, pose: list[float]) -> None:
    radius, away = space.status.ready_radius_m, math.dist(pose[:3], (0, 0, 0))
    if view.mean_confidence < _LITTLE:
        print(f"warning: the panorama has seen little of this view ({view.mean_confidence:.0%}): "
              "the rest is extrapolated or black", file=sys.stderr)  # fmt: skip
    elif away > radius > 0:
        print(f"warning: {away:.1f} m from the panorama; the space is usable up to {radius:.1f} m",
              file=sys.stderr)  # fmt: skip


def export(args: argparse.Namespace) -> int:
    from instant_ic.geometry.ply import write_ply
    from instant_ic.vspace.export import surface

    space, out = open_space(args), args.points or args.mesh
    try:
        found = surface(space, args.width)
    except ValueError as error:
        raise UserError(f"--width: {error}", 2) from error
    write_ply(out, found.points, found.rgb, found.triangles if args.mesh else None)
    triangles = f" and {len(found.triangles)} triangles" if args.mesh else ""
    print(f"wrote {out}: {len(found.points)} points{triangles}")
    return 0


def video(args: argparse.Namespace) -> int:
    import cv2

    from instant_ic.cli.progress import progress
    from instant_ic.vspace.export import default_flight, flight

    if args.out.suffix.lower() != ".mp4":
        raise UserError(f"{args.out}: the name must end in .mp4", 2)
    space = open_space(args)
    waypoints = [(x, y, z, math.radians(yaw)) for x, y, z, yaw in args.path or []]
    try:
        poses = flight(waypoints or default_flight(space.status.ready_radius_m), round(args.seconds * args.fps))
    except ValueError as error:
        raise UserError(f"--path: {error}", 2) from error
    width, height = args.size or _SIZES["perspective"]
    if width % 2 or height % 2:
        raise UserError(f"--size of a video must be even (got {width}x{height})", 2)
    assert space.keyframe is not None
    writer, known = None, 0.0
    with progress("rendering") as advance:
        for number, pose in enumerate(poses):
            try:
                view = space.render(space.keyframe.map_from_camera @ pose, width, height, math.radians(args.fov))
            except ValueError as error:
                raise UserError(f"--size: {error}", 2) from error
            if writer is None:
                writer = cv2.VideoWriter(str(args.out), cv2.VideoWriter.fourcc(*"mp4v"), args.fps, (width, height))
                if not writer.isOpened():
                    raise UserError(f"{args.out}: cannot be written")
            writer.write(view.rgb[..., ::-1])
            known += view.mean_confidence / len(poses)
            advance((number + 1) / len(poses))
    assert writer is not None
    writer.release()
    print(f"wrote {args.out}: {len(poses)} frames, {known:.0%} known")
    return 0


def info_(args: argparse.Namespace) -> int:
    from instant_ic.vspace.saved import read, space_file

    saved = read(args.space)
    field, progress = saved.config.field, saved.progress
    fit = "usable" if progress.ready else "not usable yet"
    print(f"{space_file(args.space)}: {progress.iteration} iterations in {progress.train_seconds:.1f} s, "
          f"{progress.psnr_db:.1f} dB; {fit}")  # fmt: skip
    print(f"field: {field.levels} levels x {field.features} features, 2^{field.log2_table} entries, "
          f"network {field.levels * field.features}-{field.hidden}-4")  # fmt: skip
    for prior in saved.priors:
        height, width = prior.rgb.shape[:2]
        x, y, z = prior.map_from_camera[:3, 3]
        print(f"keyframe: panorama {width} x {height} at ({x:.2f}, {y:.2f}, {z:.2f}) m, depth known in "
              f"{prior.known.mean():.0%}, median {prior.median_depth_m:.2f} m")  # fmt: skip
    return 0


# -- files ---------------------------------------------------------------------------------------------


def write_picture(path: Path, picture: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an RGB or grey image in the format of the file suffix; never leave a partial file."""
    import cv2

    try:
        done, content = cv2.imencode(path.suffix or ".png", picture[..., ::-1] if picture.ndim == 3 else picture)
    except cv2.error:
        done = False
    if not done:
        raise UserError(f"{path}: the name of an image must end in .png or .jpg", 2)
    with replacing(path) as file:
        file.write(content.tobytes())


def write_depth(path: Path, depth_m: NDArray[np.float32]) -> None:
    """Write depth as a 16-bit PNG in millimetres or as ``.npy`` in metres."""
    import numpy as np

    if path.suffix == ".npy":
        np.save(path, depth_m)
    elif path.suffix == ".png":
        write_picture(path, np.rint(np.clip(1000 * depth_m, 0, 65535)).astype(np.uint16))
    else:
        raise UserError(f"{path}: the name of a depth file must end in .png (16-bit, mm) or .npy (m)", 2)
