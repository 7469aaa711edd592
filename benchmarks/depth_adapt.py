"""What ``ic depth adapt`` gains by true depth: drives in worlds that nothing was trained on.

    python benchmarks/depth_adapt.py bag drive --world ../shared/data/worlds/small_house.glb --metres 24
    ic depth adapt drive --start models/completion.onnx -o mine.onnx
    python benchmarks/depth_adapt.py score drive models/completion.onnx mine.onnx

``bag`` writes a drive between random places: a panorama every 0.3 m, a revolution (noise, outliers, glass) every
0.15 m, odometry that drifts, and the true depth beside the bag. ``score`` prints the mean relative error by solid angle
of the prior and of each model: of the stretches that ``ic depth adapt`` trains on, and of those that it leaves out.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from reporting import parser_of, report

from instant_ic.bag import BagWriter
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.experiments.depth_lidar import Errors, measure_world
from instant_ic.experiments.depth_worlds import CAMERA_HEIGHT_M, LIDAR_HEIGHT_M
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.msg import (
    TFMessage,
    cloud_message,
    compressed_image_message,
    serialize,
    transform_message,
    type_name,
)
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import World
from instant_ic.sim.worlds import make_world
from instant_ic.training.adaptation import STRETCH_M

STEP_M, SPEED, S = 0.15, 0.5, 1_000_000_000


def route(world: World, metres: float, rng: np.random.Generator) -> np.ndarray:
    """(N, 3) poses x, y, yaw every ``STEP_M`` on shortest paths between random places, away from walls."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter1d
    from skimage.graph import route_through_array

    mask = world.occupied(0.03, 1.9, 0.05)
    free_m = distance_transform_edt(np.pad(~mask.cells, 1))[1:-1, 1:-1] * mask.cell_m
    cost = np.where(free_m > 0.35, 1 + 1 / np.maximum(free_m, 0.1), 1e4)
    places = mask.index(world.sample_free_poses(rng, 40)[:, :2])
    xy, ahead = np.empty((0, 2)), 0.0
    for start, goal in itertools.pairwise(places):
        cells, _ = route_through_array(cost, start, goal)
        xy = np.concatenate((xy, mask.centre(np.array(cells))))
        ahead = float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())
        if ahead > metres:
            break
    xy = gaussian_filter1d(xy, 5.0, axis=0, mode="nearest")
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))))
    at = np.arange(0.0, min(metres, ahead), STEP_M)
    xy = np.stack([np.interp(at, along, column) for column in xy.T], axis=1)
    step = np.gradient(xy, axis=0)
    return np.column_stack((xy, np.unwrap(np.arctan2(step[:, 1], step[:, 0]))))


def make_bag(path: Path, world: World, metres: float, seed: int) -> int:
    """Write the drive to the folder ``path`` and the true depth at each image to ``path.npz``; number of images."""
    rng = np.random.default_rng(seed)
    poses, renderer = route(world, metres, rng), EquirectRenderer(world)
    truth = {}
    # Odometry: 0.5 % of scale, and the heading walks by 0.1 degree a root metre.
    bend = np.cumsum(rng.normal(0, math.radians(0.1) * math.sqrt(STEP_M), len(poses)))
    moves = 1.005 * np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2])
    turned = np.stack([(np.cos(bend), -np.sin(bend)), (np.sin(bend), np.cos(bend))]).transpose(2, 0, 1)
    drifted = np.column_stack((np.cumsum(np.einsum("nij,nj->ni", turned, moves), axis=0), poses[:, 2] + bend))
    with BagWriter(path) as bag:

        def write(topic: str, message: Any, stamp: int) -> None:
            qos = LATCHED if topic == "/tf_static" else SENSOR
            bag.write(topic, type_name(message), bytes(serialize(message)), stamp, qos)

        mounts = {"velodyne": LIDAR_HEIGHT_M, "camera": CAMERA_HEIGHT_M}
        write("/tf_static", TFMessage([transform_message(pose_matrix(0, 0, height), "base_link", name, S)
                                       for name, height in mounts.items()]), S)  # fmt: skip
        for number, ((x, y, yaw), (odom_x, odom_y, odom_yaw)) in enumerate(zip(poses, drifted, strict=True)):
            stamp = S + round(number * STEP_M / SPEED * S)
            odom = pose_matrix(odom_x, odom_y, yaw=odom_yaw)
            write("/tf", TFMessage([transform_message(odom, "odom", "base_link", stamp)]), stamp)
            pose = pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw)
            errors = Errors(0.02, 0.01, int(rng.integers(1 << 31)))
            xyz = measure_world(renderer, pose, LIDAR_HEIGHT_M, CAMERA_HEIGHT_M, errors, through_glass=True)
            cloud = np.zeros(len(xyz), POINT_DTYPE)
            for axis, name in enumerate("xyz"):
                cloud[name] = xyz[:, axis] - (LIDAR_HEIGHT_M - CAMERA_HEIGHT_M) * (axis == 2)
            write("/lidar/points", cloud_message(cloud, "velodyne", stamp), stamp)
            if number % 2 == 0:
                frame = renderer.render(pose, 1024, 512)
                _, jpeg = cv2.imencode(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
                write("/camera/image/compressed", compressed_image_message(jpeg.tobytes(), "camera", stamp), stamp)
                truth[str(stamp)] = renderer.render(pose, 512, 256).depth_m.astype(np.float16)
    np.savez_compressed(path.with_suffix(".npz"), **truth)
    return len(truth)


def score(path: Path, models: list[str]) -> dict[str, Any]:
    """Mean relative errors by true depth, over training stretches and those left out."""
    from instant_ic.training.adaptation import LeftOut, errors, gain, split
    from instant_ic.training.drive import read_drive
    from instant_ic.training.export import load_exported

    loaded = [load_exported(name) for name in models]
    manifest = loaded[0][1]
    network = DepthModel.find(DEFAULT_MODEL, 1, "cpu")
    keyframes = read_drive(path, network, (manifest.input_height, manifest.input_width))
    with np.load(path.with_suffix(".npz")) as file:
        truth = {int(stamp): file[stamp].astype(np.float32) for stamp in file.files}
    parts, scale = split(keyframes), (manifest.max_range_m, manifest.brightness)
    found: dict[str, Any] = {}
    for name, chosen in (("training", [one for one, _ in parts.training]),
                         ("left out", [one.keyframe for one in parts.places])):  # fmt: skip
        part = [LeftOut(one, truth[one.stamp_ns], int(one.path_m // STRETCH_M)) for one in chosen]
        prior, first, *others = (errors(part, model, *scale) for model in (None, *(model for model, _ in loaded)))
        found[name] = {"prior": round(float(prior.mean()), 4), models[0]: round(float(first.mean()), 4)}
        for other, values in zip(models[1:], others, strict=True):
            found[name][other] = str(gain(part, prior, first, values))
    return found


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("verb", choices=("bag", "score"))
    parser.add_argument("bag", type=Path)
    parser.add_argument("models", nargs="*", help="completions to score: start, adapted ones")
    parser.add_argument("--world", default="", help="as the simulator's parameter")
    parser.add_argument("--metres", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if args.verb == "bag":
        report({"images": make_bag(args.bag, make_world(args.world), args.metres, args.seed)}, args.json)
    else:
        report(score(args.bag, args.models), args.json)


if __name__ == "__main__":
    main()
