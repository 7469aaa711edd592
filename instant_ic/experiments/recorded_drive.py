"""V.D from a recording: states over time, trajectories on the map, and the operator's images, without any truth."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.plots import new_figure, perspective_crop, save_figure, save_map
from instant_ic.experiments.recorded import opened
from instant_ic.experiments.teleop_figures import STEP_S, DriveLog, TeleopDrive, judge
from instant_ic.experiments.teleop_plot import plot_modes
from instant_ic.geometry.poses import pose_matrix
from instant_ic.slam.occupancy import OccupancyGrid

STATE, MAP, CAMERA, KEYFRAME = "/ic/state", "/map", "/camera/image/compressed", "/keyframe"
TYPES = {STATE: "ControlState", MAP: "OccupancyGrid", CAMERA: "CompressedImage", KEYFRAME: "Keyframe"}
SIZE = (320, 180)
_BESIDE_S = 1.0
"""Time from the first still to the virtual space, and from the virtual space to the last still, seconds."""


@dataclass(frozen=True)
class Moment:
    """An image on the operator's screen: seconds from the first state, whether it is a view, and the image."""

    time_s: float
    virtual: bool
    image: NDArray[np.uint8]


@dataclass(frozen=True)
class RecordedDrive:
    """A drive from a bag.

    Attributes:
        drive: figures as for a simulated drive, but with the stack's estimate as the r-bot's pose.
        moments: stills at ``still_times``.
        plot, modes: PNG of both trajectories on the map, and of the arbiter's mode over time.
    """

    drive: TeleopDrive
    moments: list[Moment]
    plot: bytes
    modes: bytes


def read_drive(bag: Path) -> RecordedDrive:
    """Read a drive. Views of the virtual space are rendered again from the keyframes.

    Raises:
        ValueError: the path is not a bag, or a topic is missing.
    """
    from instant_ic.msg import deserialize

    begin_ns = 0
    states: list[tuple[float, Any]] = []
    keyframes: list[tuple[float, Any]] = []
    grid = None
    with opened(bag, TYPES, ". Record a drive with the whole stack", optional=MAP) as reader:
        for one in reader.messages([STATE, KEYFRAME, MAP]):
            message = deserialize(one.payload, one.type_name)
            if one.topic == MAP:
                grid = message
                continue
            begin_ns = begin_ns or one.stamp_ns
            time_s = (one.stamp_ns - begin_ns) / 1e9
            if one.topic == STATE:
                states.append((time_s, message))
            elif message.fit:
                keyframes.append((time_s, message))
        if len(states) < 2:
            raise ValueError(f"{bag}: {len(states)} messages on {STATE}, 2 are needed")
        log = as_log(states, len(keyframes))
        times = still_times(log)
        photos: dict[float, bytes] = {}  # the newest image at each time
        for one in reader.messages([CAMERA]):
            photo = bytes(deserialize(one.payload, one.type_name).data)
            photos |= {at: photo for at in times if (one.stamp_ns - begin_ns) / 1e9 <= at}
    drive = TeleopDrive(0, "ic", True, seconds=log.time_s[-1] - log.time_s[0])
    judge(drive, log, np.empty((0, 2)))
    return RecordedDrive(drive, _moments(log, times, photos, keyframes), _plot(drive, grid), _modes(drive))


def as_log(states: Sequence[tuple[float, Any]], keyframes: int = 0) -> DriveLog:
    """Resample states (seconds, ControlState), which come at uneven times, to the steps of a log.

    Poses are interpolated because speeds are computed from their differences. Other values hold until the next state.
    """
    from instant_ic.msg import pose2_from_message, twist_values

    at = np.array([time_s for time_s, _ in states])
    grid = np.arange(at[0], at[-1] + 1e-9, STEP_S)

    def poses(name: str) -> list[NDArray[np.float64]]:
        found = np.array([pose2_from_message(getattr(one, name)) for _, one in states])
        found[:, 2] = np.unwrap(found[:, 2])
        return list(np.stack([np.interp(grid, at, column) for column in found.T], axis=1))

    held = [states[row][1] for row in np.searchsorted(at, grid + 1e-9) - 1]
    robot = poses("robot_pose")
    return DriveLog(
        time_s=grid.tolist(),
        mode=[int(one.mode) for one in held],
        virtual=[int(one.shown) == one.SHOWN_VIRTUAL for one in held],
        robot=robot,
        estimate=robot,
        vbot=poses("vbot_pose"),
        yaw_gap_rad=[float(one.yaw_gap_rad) for one in held],
        command=[(float(v), float(w)) for v, w in (twist_values(one.operator_command) for one in held)],
        blocked=[bool(one.blocked) for one in held],
        reason=[str(one.reason) for one in held],
        keyframes=keyframes,
    )


def still_times(log: DriveLog) -> list[float]:
    """Return times as in Fig. 9: before, first, middle and last in the virtual space, and after it.

    They belong to the first passage. Without a passage, only the drive's first time is returned.
    """
    times, virtual = np.array(log.time_s), np.array(log.virtual)
    if not virtual.any():
        return [float(times[0])]
    first = int(np.argmax(virtual))
    last = first + (int(np.argmin(virtual[first:])) or len(virtual) - first) - 1
    begin, end = float(times[first]), float(times[last])
    return [
        max(begin - _BESIDE_S, float(times[0])),
        begin,
        (begin + end) / 2,
        end,
        min(end + _BESIDE_S, float(times[-1])),
    ]


def _moments(
    log: DriveLog,
    times: Sequence[float],
    photos: Mapping[float, bytes],
    keyframes: Sequence[tuple[float, Any]],
) -> list[Moment]:
    from instant_ic.msg import image_array, matrix_from_pose
    from instant_ic.util.limits import decode_rgb
    from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig

    space, shown = VirtualSpace(VirtualSpaceConfig(source="warp", panorama_width=1024)), -1
    base_from_camera = np.eye(4)
    found = []
    for time_s in times:
        row = int(np.searchsorted(log.time_s, time_s + 1e-9)) - 1
        newest = sum(at <= time_s for at, _ in keyframes) - 1
        if log.virtual[row] and newest >= 0:
            if newest != shown:
                at, message = keyframes[newest]
                pose = matrix_from_pose(message.pose)
                robot = log.robot[max(int(np.searchsorted(log.time_s, at + 1e-9)) - 1, 0)]
                base_from_camera = np.eye(4)
                base_from_camera[2, 3] = pose[2, 3]
                ahead = np.linalg.inv(pose_matrix(robot[0], robot[1], yaw=robot[2])) @ pose
                if math.hypot(ahead[0, 3], ahead[1, 3]) < 0.5:  # a keyframe farther away is older than this drive
                    base_from_camera[:2, 3] = ahead[:2, 3]
                depth = np.asarray(image_array(message.depth), np.float32)
                rgb = decode_rgb(np.asarray(message.panorama.data, np.uint8))
                space.set_keyframe(rgb, depth, pose, float(message.relative_sigma))
                shown = newest
            x, y, yaw = log.vbot[row]
            view = space.render(pose_matrix(x, y, yaw=yaw) @ base_from_camera, *SIZE, math.pi / 2)
            found.append(Moment(float(time_s), True, view.softened()))
            continue
        if time_s in photos:
            rgb = decode_rgb(np.frombuffer(photos[time_s], np.uint8))
            found.append(Moment(float(time_s), False, perspective_crop(rgb, np.eye(3), *SIZE, math.pi / 2)))
    return found


def _plot(drive: TeleopDrive, grid: Any) -> bytes:
    """Return a PNG of both tracks on the recorded map, or on white without one."""
    from instant_ic.msg import grid_array

    tracks = {
        name: np.array(drive.tracks[key]) for name, key in (("r-bot", "robot"), ("v-bot", "vbot")) if drive.tracks[key]
    }
    places = np.concatenate([track[:, :2] for track in tracks.values()])
    corner = places.min(axis=0) - 1.5
    if grid is not None:
        cells, resolution, origin = grid_array(grid)
        background = OccupancyGrid(cells, resolution, np.array(origin))
    else:
        columns, rows = np.ceil(places.max(axis=0) + 1.5 - corner).astype(int)
        background = OccupancyGrid(np.zeros((rows, columns), np.int8), 1.0, corner)
    out = io.BytesIO()
    save_map(out, background, None, tracks)
    return out.getvalue()


def _modes(drive: TeleopDrive) -> bytes:
    figure, axes = new_figure(1, 1, (9.0, 1.4))
    plot_modes(axes[0, 0], [drive])
    out = io.BytesIO()
    save_figure(figure, out)
    return out.getvalue()
