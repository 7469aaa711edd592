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
from typing import Any, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.depth.colour import coloured_depth
from instant_ic.experiments.plots import image_strip, perspective_crop, save_map
from instant_ic.experiments.stack import Stack, StackError, free_ports
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix, yaw_of
from instant_ic.msg import (
    DiagnosticArray,
    Keyframe,
    LaserScan,
    PoseWithCovarianceStamped,
    RenderedView,
    ViewRequest,
    VspaceStatus,
    grid_array,
    header,
    image_array,
    matrix_from_pose,
    pose_message,
    stamp_ns,
)
from instant_ic.msg import OccupancyGrid as OccupancyGridMessage
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.util.limits import decode_rgb
from instant_ic.util.pace import read as read_pace

FloatArray: TypeAlias = NDArray[np.float64]
T = TypeVar("T")

_YAWS_DEG = (0, 90, 180, -90)
_WIDTH, _HEIGHT, _FOV = 640, 360, math.radians(90)


def evaluate_recordings(
    pcap: Path,
    panorama: Path,
    out: Path,
    timeout_s: float = 240.0,
    report: Callable[[str], None] = lambda text: None,
    same_place: bool = False,
    pace: float = 1.0,
) -> dict[str, Any]:
    """Run ``launch/sim.yaml`` on recordings; write a bag, images and a summary to ``out``.

    Writes ``bag/`` (rosbag2 MCAP), ``view.png`` (trained view beside the photo's own crop), ``depth.png``, ``map.png``,
    ``launch.log`` and ``summary.json``, whose content is returned.

    Args:
        pcap: capture of VLP-16 data packets.
        panorama: equirectangular photo.
        out: output folder.
        timeout_s: total time limit, in seconds of the stack.
        report: called with a description of each wait.
        same_place: photo and capture are from the same place and time: the LiDAR scales the depth, as on the robot.
        pace: pace of the stack's time, see :mod:`instant_ic.util.pace`.

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
            summary = _results(_Run(stack, timeout_s, report), out)
            report("stopping the stack")
            status = stack.stop()
        if status != 0:
            raise StackError(f"the stack ended with status {status}; see {out}/launch.log")
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
    summary["depth_from"] = "scaled by the LiDAR" if same_place else "as estimated, not compared with the LiDAR"
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return summary


class _Run:
    """One run of the stack on recordings.

    Args:
        stack: running stack.
        timeout_s: time limit for all steps, in seconds of the stack.
        report: called with a description of each wait.
    """

    def __init__(self, stack: Stack, timeout_s: float, report: Callable[[str], None]) -> None:
        self.stack, self.timeout_s, self.report = stack, timeout_s, report
        self.started = time.monotonic()
        self.scans = stack.collect("/scan", LaserScan)
        self.poses = stack.collect("/pose", PoseWithCovarianceStamped)
        self.faults = stack.collect("/diagnostics", DiagnosticArray, RELIABLE)
        self.maps = stack.collect("/map", OccupancyGridMessage, LATCHED)
        self.keyframes = stack.collect("/keyframe", Keyframe, LATCHED)
        self.statuses = stack.collect("/vspace/status", VspaceStatus, LATCHED)
        self.views = stack.collect("/vspace/view", RenderedView)
        self.requests = stack.observer.publisher("/view/request", ViewRequest, SENSOR)

    def wait(self, condition: Callable[[], T], what: str) -> T:
        """Wait until a condition is true, and return its value; StackError if the time limit is over."""
        self.report(f"waiting for {what}")
        passed_s = (time.monotonic() - self.started) * self.stack.pace
        return self.stack.wait_for(condition, max(1.0, self.timeout_s - passed_s), what)

    def reach_ready(self) -> float:
        """Wait for map, keyframe and virtual space; return the seconds from the keyframe to a space fit to show."""
        try:
            self.wait(lambda: len(self.scans) >= 5, "laser scans of the capture")
        except StackError:
            self.stack.check_alive("laser scans of the capture")
            raise StackError(f"the capture gives {len(self.scans)} scans{_reasons(self.faults)}") from None
        self.wait(lambda: self.maps and self.poses, "a map")
        self.wait(lambda: self.keyframes, "a keyframe of the photo")

        def is_ready() -> bool:
            newest = self.statuses[-1] if self.statuses else None
            if newest is not None and newest.state == newest.FAILED:
                raise StackError(f"the virtual space failed: {newest.message}")
            return newest is not None and newest.state == newest.READY

        self.wait(is_ready, "a virtual space that is fit to show")
        ready_s = float(self.statuses[-1].ready_seconds)
        # Slightly later than ready: the quality an operator sees after the first moments.
        settled = time.monotonic() + 10.0 / self.stack.pace
        self.wait(lambda: time.monotonic() > settled, "ten more seconds of training")
        return ready_s

    def view(self, number: int, map_from_view: FloatArray) -> NDArray[np.uint8]:
        """Return the rendered view of a pose (4, 4) as RGB."""
        request = ViewRequest(
            header=header("map", read_pace(self.stack.run_dir).now_ns()),
            id=number,
            pose=pose_message(map_from_view),
            fov_rad=_FOV,
            width=_WIDTH,
            height=_HEIGHT,
        )
        next_try = 0.0

        def answer() -> Any:
            nonlocal next_try
            if time.monotonic() > next_try:  # repeat the request: only the newest one is served
                next_try = time.monotonic() + 2.0
                self.requests.publish(request)
            return next((view for view in self.views if view.request_id == number), None)

        return decode_rgb(np.asarray(self.wait(answer, f"view {number}").image.data, np.uint8))


def _results(run: _Run, out: Path) -> dict[str, Any]:
    """Wait for the results of a run, write the images, and return the summary."""
    ready_s = run.reach_ready()
    keyframe = run.keyframes[-1]
    photo = decode_rgb(np.asarray(keyframe.panorama.data, np.uint8))
    scores, strip = _compare_views(run, photo, matrix_from_pose(keyframe.pose))
    cv2.imwrite(str(out / "view.png"), strip[..., ::-1])
    depth_m = np.asarray(image_array(keyframe.depth), np.float32)
    near_m, far_m = np.percentile(depth_m[depth_m > 0], (1, 99))
    colours = coloured_depth(depth_m, near_m, far_m)
    small = cv2.resize(photo, colours.shape[1::-1], interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(out / "depth.png"), np.vstack([small, colours])[..., ::-1])
    grid, resolution, origin = grid_array(run.maps[-1])
    robot = matrix_from_pose(run.poses[-1])
    shown = OccupancyGrid(grid, resolution, np.array(origin))
    save_map(out / "map.png", shown, (robot[0, 3], robot[1, 3], yaw_of(robot)))
    span_s = (stamp_ns(run.scans[-1]) - stamp_ns(run.scans[0])) / 1e9
    status = run.statuses[-1]
    return {
        "scans": len(run.scans),
        "scan_rate_hz": round((len(run.scans) - 1) / span_s, 2) if span_s > 0 else 0.0,
        "map_cells_known": int((grid >= 0).sum()),
        "map_cells_occupied": int((grid > 50).sum()),
        "keyframe_to_ready_s": round(ready_s, 2),
        "training_psnr_db": round(float(status.psnr_db), 2),
        "view_psnr_db": scores,
        "depth_png_m": [round(float(near_m), 2), round(float(far_m), 2)],
        "depth_scale": round(float(keyframe.scale), 4),
        "depth_quality": round(float(keyframe.quality), 3),
        "depth_fit": bool(keyframe.fit),
        "depth_message": str(keyframe.message),
        "device": str(status.device),
    }


def _compare_views(
    run: _Run, photo: NDArray[np.uint8], map_from_camera: FloatArray
) -> tuple[dict[str, float], NDArray[np.uint8]]:
    """Compare views with the photo's own crops; return PSNR in dB by yaw in degrees, and an image of both."""
    scores, rows = {}, []
    for number, yaw_deg in enumerate(_YAWS_DEG, start=1):
        camera_from_view = pose_matrix(yaw=math.radians(yaw_deg))
        rendered = run.view(number, map_from_camera @ camera_from_view)
        crop = perspective_crop(photo, camera_from_view[:3, :3], rendered.shape[1], rendered.shape[0], _FOV)
        scores[str(yaw_deg)] = round(psnr_db(rendered, crop), 2)
        rows.append((f"{yaw_deg} deg", [rendered, crop]))
    return scores, image_strip(("virtual space", "photo"), rows, _WIDTH)


def _reasons(diagnostics: Sequence[Any]) -> str:
    """Return the newest texts of the LiDAR's driver about the packets, to be appended to an error."""
    newest = {status.name: status.message for array in diagnostics for status in array.status}
    texts = [newest[name] for name in ("vlp16_driver: packets", "vlp16_driver: source") if newest.get(name)]
    return f" ({'; '.join(texts)})" if texts else ""
