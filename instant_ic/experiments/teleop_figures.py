"""Figures of a teleoperated drive, computed from its log alone: obedience, switches, jumps, freezes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.kinematics import MotionLimits, accelerate
from instant_ic.control.states import Mode
from instant_ic.geometry.poses import relative2, wrap_angle

FloatArray: TypeAlias = NDArray[np.float64]

STEP_S = 0.05
"""Seconds between two rows of a log."""
TRACK_S = 0.2
"""Seconds between two points of a track."""
LATENCY_S = 0.35
"""Latency allowed in obedience: a robot obeys if it follows any command of this period, with its ramps since then."""
TOLERANCE_M_S, TOLERANCE_RAD_S = 0.05, 0.15
"""Tolerance of the speed: tracks slip, and speed is measured over 0.1 s."""
FLICKER_S = 2.0
"""A switch reversed within this time counts as flicker."""
MET_M = 1.2
"""Distance between the centres of an obstacle and the shown robot below which the obstacle counts as met."""


@dataclass(frozen=True)
class Shown:
    """An image on the operator's screen.

    Attributes:
        time_s: when it was displayed.
        came_s: when it arrived at the page; a switch shows the newest image that has already arrived.
        virtual: True for a rendered view, False for the camera's image.
        pose: (3,) of the robot from which the image was taken, in the world's frame; the true pose for a camera image.
        place: (2,) its position, as the stack knows it.
        heading: yaw at which it is shown: the page rotates the camera's image to the newest heading.
        jpeg: encoded image of a rendered view; empty for the camera's.
        fov_rad: horizontal field of view of a rendered view.
    """

    time_s: float
    came_s: float
    virtual: bool
    pose: FloatArray
    place: FloatArray
    heading: float
    jpeg: bytes = b""
    fov_rad: float = math.pi / 2


@dataclass
class DriveLog:
    """Events of a drive, one row per twentieth of a second; poses (x, y, yaw) in the world's frame."""

    time_s: list[float] = field(default_factory=list)
    mode: list[int] = field(default_factory=list)
    virtual: list[bool] = field(default_factory=list)
    """True where the rendered view is shown."""
    robot: list[FloatArray] = field(default_factory=list)
    estimate: list[FloatArray] = field(default_factory=list)
    """The r-bot's pose as the stack knows it."""
    vbot: list[FloatArray] = field(default_factory=list)
    yaw_gap_rad: list[float] = field(default_factory=list)
    """v-bot heading minus r-bot heading, as the arbiter knows them; the page rotates the images to these."""
    command: list[tuple[float, float]] = field(default_factory=list)
    blocked: list[bool] = field(default_factory=list)
    reason: list[str] = field(default_factory=list)
    pictures: list[Shown] = field(default_factory=list)
    keyframes: int = 0


@dataclass(frozen=True)
class Switch:
    """A change of the shown image between the camera's image and the rendered view.

    Attributes:
        time_s: time of the switch.
        to_virtual: True into the virtual space, False back.
        position_error_m: distance between the positions of the last image before the switch and the first after it, as
            the stack knows them, minus the distance that the shown robot drove between the arrivals of the two images.
        yaw_error_deg: angle between the headings of v-bot and r-bot just before the switch, as the stack knows them;
            the page rotates the images to these headings.
        psnr_db: PSNR between the two images; None if they were not rendered.
    """

    time_s: float
    to_virtual: bool
    position_error_m: float
    yaw_error_deg: float
    psnr_db: float | None = None


@dataclass
class TeleopDrive:
    """One episode by one method."""

    index: int
    method: str
    completed: bool = False
    gave_up: bool = False
    seconds: float = 0.0
    """Time from the first command until the r-bot is at the goal or the drive ends."""
    way_m: float = 0.0
    driven_m: float = 0.0
    contacts: int = 0
    obstacles: int = 0
    """Number of obstacles that the operator met."""
    detours: int = 0
    """Number of times the operator was blocked, looked, and drove around the obstacle manually."""
    obedience: float = math.nan
    flicker: int = 0
    mode_seconds: dict[str, float] = field(default_factory=dict)
    gap_mean_m: float = math.nan
    gap_max_m: float = math.nan
    longest_freeze_s: float = 0.0
    longest_stall_s: float = 0.0
    keyframes: int = 0
    reason: str = ""
    """The stack's last message if the drive was not completed."""
    switches: list[Switch] = field(default_factory=list)
    tracks: dict[str, list[list[float]]] = field(default_factory=dict)
    """``robot``, ``vbot`` (while it was shown): x, y, yaw each fifth of a second; ``modes``: start time and mode, the
    last entry being the end. For the plot.
    """


def shown_poses(log: DriveLog) -> FloatArray:
    """Return the poses (N, 3) of the robot that is shown."""
    virtual = np.array(log.virtual)[:, None]
    return np.where(virtual, np.array(log.vbot), np.array(log.robot))


def shown_speeds(log: DriveLog) -> FloatArray:
    """Return forward m/s and rad/s (N, 2) of the shown robot, over 0.1 s; NaN across a switch and at the ends."""
    poses, virtual = shown_poses(log), np.array(log.virtual)
    speeds = np.full((len(poses), 2), math.nan)
    for k in range(1, len(poses) - 1):
        if virtual[k - 1] == virtual[k] == virtual[k + 1]:
            moved = relative2(poses[k - 1], poses[k + 1])
            speeds[k] = float(moved[0]) / (2 * STEP_S), wrap_angle(float(moved[2])) / (2 * STEP_S)
    return speeds


def ramped(commands: FloatArray) -> FloatArray:
    """Return speeds (N, 2) of a robot that follows its commands at once, within its acceleration limits."""
    speed, out, limits = (0.0, 0.0), np.zeros((len(commands), 2)), MotionLimits()
    for k, (linear, angular) in enumerate(commands):
        speed = accelerate(speed, (float(linear), float(angular)), limits, STEP_S)
        out[k] = speed
    return out


def obeys(log: DriveLog) -> FloatArray:
    """Return (N,) 1 where the shown robot obeyed the command, 0 where it did not, NaN without a command.

    It obeyed if its forward speed and yaw rate lie between the minimum and maximum of the ramped command within the
    last ``LATENCY_S``, within ``TOLERANCE_*``. A robot that stands, is slowed down, or turns differently did not.
    """
    commands = np.array(log.command, dtype=np.float64).reshape(-1, 2)
    wanted, speeds = ramped(commands), shown_speeds(log)
    window = round(LATENCY_S / STEP_S)
    tolerance = np.array([TOLERANCE_M_S, TOLERANCE_RAD_S])
    out = np.full(len(commands), math.nan)
    for k in range(len(commands)):
        if commands[k].any() and not np.isnan(speeds[k]).any():
            recent = wanted[max(0, k - window) : k + 1]
            low, high = recent.min(axis=0) - tolerance, recent.max(axis=0) + tolerance
            out[k] = float(((speeds[k] >= low) & (speeds[k] <= high)).all())
    return out


def obedience(log: DriveLog) -> float:
    """Return the share of the commanded time in which the shown robot obeyed; NaN without commands."""
    done = obeys(log)
    return math.nan if np.isnan(done).all() else float(np.nanmean(done))


def longest_stall_s(log: DriveLog) -> float:
    """Return the longest time that the shown robot stood still under a command."""
    commands, speeds = np.array(log.command).reshape(-1, 2), shown_speeds(log)
    standing = (np.abs(speeds[:, 0]) < 0.01) & (np.abs(speeds[:, 1]) < 0.02) & commands.any(axis=1)
    longest = run = 0
    for stands in standing:
        run = run + 1 if stands else 0
        longest = max(longest, run)
    return longest * STEP_S


def longest_freeze_s(pictures: list[Shown], until_s: float) -> float:
    """Return the longest time that one image stayed on the screen, up to ``until_s``."""
    times = [shown.time_s for shown in pictures if shown.time_s <= until_s]
    if not times:
        return 0.0
    return float(np.diff([*times, until_s]).max())


def find_switches(log: DriveLog) -> list[Switch]:
    """Return all switches; position errors are NaN if one of the images is missing."""
    found = []
    for k in range(1, len(log.virtual)):
        if log.virtual[k] == log.virtual[k - 1]:
            continue
        pictures = pictures_at(log.pictures, log.time_s[k], log.virtual[k])
        error_m = math.nan if pictures is None else picture_error_m(*pictures, log)
        yaw_error_deg = abs(math.degrees(log.yaw_gap_rad[k - 1]))
        found.append(Switch(log.time_s[k], bool(log.virtual[k]), error_m, yaw_error_deg))
    return found


def count_flicker(switches: list[Switch]) -> int:
    """Count the switches that are reversed within ``FLICKER_S``."""
    return sum(after.time_s - before.time_s < FLICKER_S for before, after in pairwise(switches))


def pictures_at(pictures: list[Shown], time_s: float, to_virtual: bool) -> tuple[Shown, Shown] | None:
    """Return the last image before a switch and the first after it; None if one of them is missing."""
    for before, after in pairwise(pictures):
        near = abs(after.time_s - time_s) < 1.0
        if near and before.virtual != after.virtual == to_virtual:
            return before, after
    return None


def picture_error_m(before: Shown, after: Shown, log: DriveLog) -> float:
    """Return the distance between the places of two images that should coincide, as the stack knows them.

    The shown robot moves between the arrivals of the two images. This motion is subtracted; the mean speed around the
    switch gives its length.
    """
    speeds = shown_speeds(log)[:, 0]
    times = np.array(log.time_s)
    near = (times > before.time_s - 0.3) & (times < after.time_s + 0.3) & ~np.isnan(speeds)
    speed = float(speeds[near].mean()) if near.any() else 0.0
    heading = np.array([math.cos(before.heading), math.sin(before.heading)])
    between = speed * (after.came_s - before.came_s) * heading
    return float(np.hypot(*(after.place - before.place - between)))


def obstacles_met(log: DriveLog, centres: FloatArray) -> int:
    """Count the obstacles (N, 2) that the shown robot came near."""
    if len(centres) == 0 or not log.time_s:
        return 0
    away = np.linalg.norm(shown_poses(log)[:, None, :2] - np.asarray(centres)[None], axis=2)
    return int((away.min(axis=0) < MET_M).sum())


def judge(drive: TeleopDrive, log: DriveLog, centres: FloatArray) -> None:
    """Fill in the figures that follow from the log; the caller sets the image figures of the switches."""
    drive.obedience = obedience(log)
    drive.switches = find_switches(log)
    drive.flicker = count_flicker(drive.switches)
    modes = np.array(log.mode)
    drive.mode_seconds = {mode.label: round(float((modes == mode).sum()) * STEP_S, 2) for mode in Mode}
    robot, vbot = np.array(log.robot), np.array(log.vbot)
    drive.driven_m = float(np.linalg.norm(np.diff(robot[:, :2], axis=0), axis=1).sum())
    virtual = np.array(log.virtual)
    if virtual.any():
        gaps = np.linalg.norm(robot[virtual, :2] - vbot[virtual, :2], axis=1)
        drive.gap_mean_m, drive.gap_max_m = float(gaps.mean()), float(gaps.max())
    drive.longest_freeze_s = longest_freeze_s(log.pictures, log.time_s[-1])
    drive.longest_stall_s = longest_stall_s(log)
    drive.obstacles = obstacles_met(log, centres)
    drive.keyframes = log.keyframes
    shown = np.where(virtual[:, None], vbot, math.nan)
    every = round(TRACK_S / STEP_S)
    begins = [0, *(np.flatnonzero(np.diff(modes)) + 1).tolist()]
    drive.tracks = {
        "robot": np.round(robot[::every], 3).tolist(),
        "vbot": [row for row in np.round(shown[::every], 3).tolist() if not math.isnan(row[0])],
        "modes": [[round(log.time_s[k], 2), int(modes[k])] for k in (*begins, len(modes) - 1)],
    }


def summary(drives: list[TeleopDrive]) -> dict[str, Any]:
    """Return the figures of one method."""
    switches = [switch for drive in drives for switch in drive.switches]
    into, back = ([s for s in switches if s.to_virtual == to_virtual] for to_virtual in (True, False))
    obstacles = sum(drive.obstacles for drive in drives)
    return {
        "episodes": len(drives),
        "contacts": sum(drive.contacts for drive in drives),
        "completed_fraction": float(np.mean([drive.completed for drive in drives])),
        "obedience": _mean([drive.obedience for drive in drives], [drive.seconds for drive in drives]),
        "switches_per_obstacle": len(switches) / 2 / obstacles if obstacles else None,
        "switches_to_virtual_per_obstacle": len(into) / obstacles if obstacles else None,
        "switches_to_real_per_obstacle": len(back) / obstacles if obstacles else None,
        "switch_position_error_m": _max([s.position_error_m for s in switches]),
        "switch_position_error_mean_m": _mean([s.position_error_m for s in switches]),
        "switch_yaw_error_deg": _max([s.yaw_error_deg for s in switches]),
        "switch_yaw_error_mean_deg": _mean([s.yaw_error_deg for s in switches]),
        "switch_psnr_db": _mean([s.psnr_db for s in switches if s.psnr_db is not None]),
        "switch_to_virtual_psnr_db": _mean([s.psnr_db for s in into if s.psnr_db is not None]),
        "switch_to_real_psnr_db": _mean([s.psnr_db for s in back if s.psnr_db is not None]),
        "longest_freeze_s": _max([drive.longest_freeze_s for drive in drives]),
        "longest_stall_s": _max([drive.longest_stall_s for drive in drives]),
        "obstacles": obstacles,
        "detours": sum(drive.detours for drive in drives),
        "flicker": sum(drive.flicker for drive in drives),
        "gap_mean_m": _mean([drive.gap_mean_m for drive in drives]),
        "gap_max_m": _max([drive.gap_max_m for drive in drives]),
        "seconds_mean": _mean([drive.seconds for drive in drives if drive.completed]),
        "path_ratio_mean": _mean([d.driven_m / d.way_m for d in drives if d.completed and d.way_m > 0]),
    }


def targets(figures: dict[str, Any]) -> dict[str, bool | None]:
    """Check each target of illusory control; None without data for it."""

    def holds(key: str, least: float = -math.inf, most: float = math.inf) -> bool | None:
        value = figures[key]
        return None if value is None else least <= value <= most

    each_way = [holds(f"switches_to_{name}_per_obstacle", 0.95, 1.05) for name in ("virtual", "real")]
    return {
        "contacts == 0": holds("contacts", most=0),
        "completed_fraction >= 0.95": holds("completed_fraction", least=0.95),
        "obedience >= 0.98": holds("obedience", least=0.98),
        "one switch each way an obstacle": None if None in each_way else all(each_way),
        "switch_position_error_m <= 0.02": holds("switch_position_error_m", most=0.02),
        "switch_yaw_error_deg <= 0.5": holds("switch_yaw_error_deg", most=0.5),
        "longest_freeze_s <= 0.3": holds("longest_freeze_s", most=0.3),
    }


def _mean(values: list[float], weights: list[float] | None = None) -> float | None:
    known = [k for k, value in enumerate(values) if not math.isnan(value)]
    if not known:
        return None
    chosen = [weights[k] for k in known] if weights is not None else None
    return float(np.average([values[k] for k in known], weights=chosen))


def _max(values: list[float]) -> float | None:
    known = [value for value in values if not math.isnan(value)]
    return max(known) if known else None
