"""``ic calibrate``: sensor mounts from a recording."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import check_files, group, numbers, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.tables import print_table

if TYPE_CHECKING:
    from instant_ic.calibration.bag import CalibrationRecording
    from instant_ic.calibration.mount import Calibration
    from instant_ic.geometry.poses import Matrix


def add_parser(subparsers: Any) -> None:
    text = "calibrate sensor mounts from a recording"
    verbs = group(subparsers, "calibrate", text, f"{text.capitalize()} (docs/calibration.md).")
    add = verb(
        verbs, "camera-lidar", "calibrate the camera's pose relative to the LiDAR", camera_lidar,
        "ic calibrate camera-lidar drive -o config/mount.yaml --plot overlay.png; "
        "ic launch robot params:=config/mount.yaml",
        "Estimate the camera's pose relative to the LiDAR from the edges that both see in a recording, report "
        "which degrees of freedom the recording constrains, and write the camera's mount as a parameter file. "
        "Record a minute of slow driving in a furnished room (docs/calibration.md).",
    ).add_argument  # fmt: skip
    add("bag", type=Path, metavar="BAG")
    text = "parameter file to write (%(default)s)"
    add("-o", "--out", type=Path, default=Path("camera_mount.yaml"), metavar="FILE", help=text)
    add("--plot", type=Path, metavar="PNG", help="LiDAR points over the images, before and after")
    add("--json", type=Path, metavar="FILE", help="write the figures here")
    add("--frames", type=positive_int, default=24, metavar="N", help="maximum number of images (%(default)s)")
    text = "initial camera pose in the LiDAR frame (m, degrees) if /tf_static lacks it"
    form = "X,Y,Z,ROLL,PITCH,YAW"
    add("--guess", type=numbers(form), metavar=form, help=text)
    text = "the initial yaw is right within a few degrees: skip the full-circle search"
    add("--near", action="store_true", help=text)


def camera_lidar(args: argparse.Namespace) -> int:
    from instant_ic.calibration.bag import read_recording
    from instant_ic.calibration.mount import calibrate

    guess = _guess(args.guess) if args.guess else None
    check_files(args.out, args.plot, args.json)
    print(f"reading {args.bag}", flush=True)
    recording = read_recording(args.bag, args.frames)
    given = guess if guess is not None else recording.camera_from_lidar
    if given is None:
        raise UserError(
            f"{args.bag}: /tf_static has no transform between camera and LiDAR: record it too, or give "
            "--guess X,Y,Z,ROLL,PITCH,YAW"
        )
    print(f"{recording.images} images, {len(recording.frames)} used, from {recording.places} places"
          + ("" if recording.moves else "; no odometry on /tf: the robot is assumed to stand still"),
          flush=True)  # fmt: skip
    result = calibrate(recording.frames, given, not args.near, lambda line: print(line, flush=True))
    summary = _summary(args.bag, recording, given, result)
    _tell(summary)
    if args.json:
        args.json.write_text(json.dumps(summary, indent=2) + "\n")
        print(f"wrote {args.json}")
    if args.plot:
        _plot(args.plot, recording, given, result)
    if not any(summary["constrained"].values()):
        raise UserError(
            f"{args.bag}: the recording constrains no axis, so no mount was written: record slow driving through "
            "several places of a furnished room (docs/calibration.md)"
        )
    args.out.write_text(_yaml(summary))
    print(f"wrote {args.out}; use it with: ic launch robot params:={args.out}")
    return 0


def _guess(values: list[float]) -> Matrix:
    """Return ``camera_from_lidar`` from the camera's pose in the LiDAR frame: metres and degrees."""
    import numpy as np

    from instant_ic.geometry.poses import inverse, pose_matrix

    return inverse(pose_matrix(*values[:3], *np.radians(values[3:])))


def _xyz_rpy(pose: Matrix) -> tuple[list[float], list[float]]:
    """Return a pose's position in metres and its roll, pitch and yaw in degrees about fixed axes, rounded."""
    from scipy.spatial.transform import Rotation

    rpy = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
    return [round(float(v), 4) + 0.0 for v in pose[:3, 3]], [round(float(v), 3) + 0.0 for v in rpy]


def _summary(bag: Path, recording: CalibrationRecording, given: Matrix, result: Calibration) -> dict[str, Any]:
    import numpy as np

    from instant_ic.calibration.mount import AXES
    from instant_ic.geometry.poses import inverse

    base_from_lidar = recording.base_from_lidar if recording.base_from_lidar is not None else _lidar_mount()
    xyz, rpy = _xyz_rpy(base_from_lidar @ inverse(result.camera_from_lidar))
    xyz_before, rpy_before = _xyz_rpy(base_from_lidar @ inverse(given))
    in_units = np.concatenate([result.sigma[:3], np.degrees(result.sigma[3:])])
    return {
        "bag": str(bag),
        "frames": len(recording.frames),
        "places": recording.places,
        "edges": result.edges,
        "mount_xyz": xyz,
        "mount_rpy_deg": rpy,
        "mount_xyz_before": xyz_before,
        "mount_rpy_deg_before": rpy_before,
        "sigma_m_deg": {axis: round(float(value), 4) for axis, value in zip(AXES, in_units, strict=True)},
        "constrained": {axis: bool(value) for axis, value in zip(AXES, result.constrained, strict=True)},
        "score_before": round(result.score_before, 3),
        "score_after": round(result.score_after, 3),
        "yaw_rival": round(result.yaw_rival, 3),
        "camera_from_lidar": result.camera_from_lidar.round(6).tolist(),
    }


def _lidar_mount() -> Matrix:
    """Return ``base_from_lidar`` of config/robot.yaml, for a bag without this transform."""
    from instant_ic.bus.node_files import node_class
    from instant_ic.config import params
    from instant_ic.geometry.poses import pose_matrix
    from instant_ic.util import paths

    values = params.load_file(paths.shipped_file("config", "robot.yaml"), "vlp16_driver")
    return pose_matrix(*params.configure(node_class("vlp16_driver").config_class(), values)[0].lidar_mount.pose)


def _tell(summary: dict[str, Any]) -> None:
    before = summary["mount_xyz_before"] + summary["mount_rpy_deg_before"]
    after = summary["mount_xyz"] + summary["mount_rpy_deg"]
    rows = []
    for number, (axis, sigma) in enumerate(summary["sigma_m_deg"].items()):
        note = "" if summary["constrained"][axis] else "not constrained by this recording"
        figures = (f"{before[number]:.3f}", f"{after[number]:.3f}", f"{sigma:.3f}")
        rows.append((f"{axis} ({'m' if number < 3 else 'deg'})", *figures, note))
    print_table(rows, ("camera on base_link", "before", "after", "+-", ""), right=(1, 2, 3))
    print(f"overlap of LiDAR edges with image edges: {summary['score_before']:.2f} times chance before, "
          f"{summary['score_after']:.2f} after")  # fmt: skip
    if summary["yaw_rival"] > 0.8:
        print("another yaw fits nearly as well: the place looks similar in two directions; check the overlay (--plot)")


def _yaml(summary: dict[str, Any]) -> str:
    loose = [axis for axis, known in summary["constrained"].items() if not known]
    sigma = ", ".join(f"{axis} {value:g}" for axis, value in summary["sigma_m_deg"].items())
    kept = f"# Not constrained by the recording, kept as given: {', '.join(loose)}.\n" if loose else ""
    return (
        f"# Camera's mount by ic calibrate camera-lidar {summary['bag']}, {summary['frames']} images.\n"
        f"# Standard deviations (m, degrees): {sigma}.\n{kept}"
        "# It goes into the /** section of config/robot.yaml, or on top of it: params:=THIS_FILE.\n"
        "/**:\n  ros__parameters:\n    camera_mount:\n"
        f"      xyz: {summary['mount_xyz']}\n      rpy_deg: {summary['mount_rpy_deg']}\n"
    )


def _plot(path: Path, recording: CalibrationRecording, given: Matrix, result: Calibration) -> None:
    import cv2

    from instant_ic.calibration.overlay import before_and_after

    sheet = before_and_after(recording.frames, given, result.camera_from_lidar)
    if not cv2.imwrite(str(path), sheet[..., ::-1]):
        raise UserError(f"{path} cannot be written: use a name that ends in .png or .jpg")
    print(f"wrote {path}")
