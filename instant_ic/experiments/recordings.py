"""Real recordings through the real nodes: a LiDAR capture to a map, a panorama photo to a virtual space.

The simulated devices send the recordings over the devices' own protocols, so every driver and node runs as with the
hardware. Photo and capture are assumed to be from different places. The photo's depth is therefore used in the model's
own metres, without LiDAR scaling (``trust_depth:=true`` of ``launch/sim.yaml``); the summary states this.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.experiments.plots import (
    correlation,
    perspective_crop,
    save_depth,
    save_map,
    save_view_strip,
)
from instant_ic.experiments.stack import Stack, StackError, free_ports
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import inverse, pose_matrix, yaw_of
from instant_ic.msg import grid_array, image_array, matrix_from_pose, message_type, pose_message, stamp_ns, to_time
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.util.pace import read as read_pace

_YAWS_DEG = (0, 90, 180, -90)
_AHEAD_M = 0.4
"""Distance in metres of the last two views from the photo's position, to show the effect of the estimated depth."""
_WIDTH, _HEIGHT, _FOV = 640, 360, math.radians(90)


def evaluate_recordings(
    pcap: Path,
    panorama: Path,
    out: Path,
    timeout_s: float = 240.0,
    tell: Callable[[str], None] = lambda text: None,
    same_place: bool = False,
    pace: float = 1.0,
) -> dict[str, Any]:
    """Run ``launch/sim.yaml`` on recordings; write a bag, images and a summary to ``out``.

    Writes ``bag/`` (rosbag2 MCAP), ``view.png`` (trained view beside the photo's own crop), ``depth.png``, ``map.png``,
    ``launch.log`` and ``summary.json``, whose content is returned.

    Args:
        timeout_s: total time limit, in seconds of the stack.
        tell: called with a description of each wait.
        same_place: photo and capture are from the same place and time: the LiDAR scales the depth, as on the robot.
        pace: of the stack's time, see :mod:`instant_ic.util.pace`.

    Raises:
        FileNotFoundError: a recording is missing.
        FileExistsError: ``out`` already holds a bag.
        StackError: a step was not completed in time.
    """
    for path in (pcap, panorama):
        if not path.is_file():
            raise FileNotFoundError(f"{path} does not exist")
    if (out / "bag").exists():
        raise FileExistsError(f"{out}/bag already exists: choose another folder or remove it")
    out.mkdir(parents=True, exist_ok=True)
    # Sockets need a short path; `out` may be longer.
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    arguments = {
        **free_ports(),
        "pcap": pcap.resolve(),
        "panorama": panorama.resolve(),
        "record": (out / "bag").resolve(),
        "headless": True,
        "trust_depth": not same_place,
    }
    try:
        with Stack("sim.yaml", run_dir, arguments, out / "launch.log", pace=pace) as stack:
            summary = _watch(stack, out, timeout_s, tell)
            tell("stopping the stack")
            status = stack.stop()
        if status != 0:
            raise StackError(f"the stack ended with status {status}; see {out}/launch.log")
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
    summary["depth_from"] = "scaled by the LiDAR" if same_place else "as estimated, the LiDAR was not asked"
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return summary


def _watch(stack: Stack, out: Path, timeout_s: float, tell: Callable[[str], None]) -> dict[str, Any]:
    import cv2

    started = time.monotonic()
    scans = stack.collect("/scan", message_type("LaserScan"))
    poses = stack.collect("/pose", message_type("PoseWithCovarianceStamped"))
    points: list[None] = []
    clouds = stack.observer.subscribe(
        "/lidar/points", message_type("PointCloud2"), lambda cloud: points.append(None), SENSOR
    )
    faults = stack.collect("/diagnostics", message_type("DiagnosticArray"), RELIABLE)
    maps = stack.collect("/map", message_type("OccupancyGrid"), LATCHED)
    keyframes = stack.collect("/keyframe", message_type("Keyframe"), LATCHED)
    statuses = stack.collect("/vspace/status", message_type("VspaceStatus"), LATCHED)
    views = stack.collect("/vspace/view", message_type("RenderedView"))
    requests = stack.observer.publisher("/view/request", message_type("ViewRequest"), SENSOR)
    ready, failed = message_type("VspaceStatus").READY, message_type("VspaceStatus").FAILED

    def wait(condition: Callable[[], Any], what: str) -> Any:
        tell(f"waiting for {what}")
        return stack.wait_for(condition, max(1.0, timeout_s - (time.monotonic() - started) * stack.pace), what)

    try:
        wait(lambda: len(scans) >= 5, "laser scans of the capture")
    except StackError:
        stack.check_alive("laser scans of the capture")
        raise StackError(
            f"the capture gives {len(points)} point clouds and {len(scans)} scans{_reasons(faults)}"
        ) from None
    stack.observer.drop(clouds)
    wait(lambda: maps and poses, "a map")
    keyframe = wait(lambda: keyframes and keyframes[-1], "a keyframe of the photo")

    def is_ready() -> bool:
        if statuses and statuses[-1].state == failed:
            raise StackError(f"the virtual space failed: {statuses[-1].message}")
        return bool(statuses) and statuses[-1].state == ready

    wait(is_ready, "a virtual space that is fit to show")
    time_to_ready_s = float(statuses[-1].ready_seconds)
    # Slightly later than ready: the quality an operator sees after the first moments.
    settled = time.monotonic() + 10.0 / stack.pace
    wait(lambda: time.monotonic() > settled, "ten more seconds of training")
    keyframe = keyframes[-1]

    encoded = np.asarray(keyframe.panorama.data)
    photo = cv2.cvtColor(cv2.imdecode(encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    map_from_camera = matrix_from_pose(keyframe.pose)
    rows = []
    scores, likeness = {}, {}
    places = [(yaw, 0.0) for yaw in _YAWS_DEG] + [(yaw, _AHEAD_M) for yaw in (0, -90)]
    for number, (yaw_deg, ahead_m) in enumerate(places, start=1):
        map_from_view = map_from_camera @ pose_matrix(yaw=math.radians(yaw_deg)) @ pose_matrix(x=ahead_m)
        request = _request(number, map_from_view, read_pace(stack.run_dir).now_ns())
        next_try = 0.0

        def view_of(number: int = number, request: Any = request) -> Any:
            nonlocal next_try
            if time.monotonic() > next_try:  # repeat the request: only the newest one is served
                next_try = time.monotonic() + 2.0
                requests.publish(request)
            return next((v for v in views if v.request_id == number), None)

        view = wait(view_of, f"the view at {yaw_deg}°")
        data = np.asarray(view.image.data)
        rendered = cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        camera_from_view = (inverse(map_from_camera) @ map_from_view)[:3, :3]
        crop = perspective_crop(photo, camera_from_view, rendered.shape[1], rendered.shape[0], _FOV)
        if ahead_m:
            # No reference image: the photo was taken elsewhere.
            rows.append((f"{yaw_deg}°, {ahead_m} m ahead of the photo's place", rendered, crop))
            continue
        scores[str(yaw_deg)] = round(psnr_db(rendered, crop), 2)
        likeness[str(yaw_deg)] = round(correlation(rendered, crop), 3)
        rows.append((f"{yaw_deg}°  ({scores[str(yaw_deg)]} dB)", rendered, crop))
    save_view_strip(out / "view.png", rows)
    depth = image_array(keyframe.depth)
    save_depth(out / "depth.png", photo, depth, f"depth: {keyframe.message}")
    grid, resolution, origin = grid_array(maps[-1])
    robot = matrix_from_pose(poses[-1])
    shown = OccupancyGrid(grid, resolution, np.array(origin))
    save_map(out / "map.png", shown, (robot[0, 3], robot[1, 3], yaw_of(robot)))
    span_s = (stamp_ns(scans[-1]) - stamp_ns(scans[0])) / 1e9
    return {
        "scans": len(scans),
        "scan_rate_hz": round((len(scans) - 1) / span_s, 2) if span_s > 0 else 0.0,
        "map_cells_known": int((grid >= 0).sum()),
        "map_cells_occupied": int((grid > 50).sum()),
        "keyframe_to_ready_s": round(time_to_ready_s, 2),
        "training_psnr_db": round(float(statuses[-1].psnr_db), 2),
        "view_psnr_db": scores,
        "view_correlation": likeness,
        "depth_scale": round(float(keyframe.scale), 4),
        "depth_quality": round(float(keyframe.quality), 3),
        "depth_fit": bool(keyframe.fit),
        "depth_message": str(keyframe.message),
        "device": str(statuses[-1].device),
    }


def _reasons(diagnostics: Sequence[Any]) -> str:
    """The newest texts of the LiDAR's driver about the packets, to be appended to an error."""
    newest = {status.name: status.message for array in diagnostics for status in array.status}
    texts = [newest[name] for name in ("vlp16_driver: packets", "vlp16_driver: source") if newest.get(name)]
    return f" ({'; '.join(texts)})" if texts else ""


def _request(number: int, map_from_view: Any, now_ns: int) -> Any:
    request, head = message_type("ViewRequest"), message_type("Header")
    return request(
        header=head(stamp=to_time(now_ns), frame_id="map"),
        id=number,
        pose=pose_message(map_from_view),
        fov_rad=_FOV,
        width=_WIDTH,
        height=_HEIGHT,
    )
