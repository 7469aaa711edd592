"""``ic doctor``: check machine, devices and configuration."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import verb
from instant_ic.util.safe_text import direct, masked, visible


def add_parser(subparsers: Any) -> None:
    add = verb(
        subparsers, "doctor", "check machine, devices, ports, models and configuration", run,
        "ic doctor --robot --serial-port /dev/ttyACM0", "Check this machine, its devices, ports, models and "
        "configuration, and advise what to do. The exit status is 1 if a check fails.",
    ).add_argument  # fmt: skip
    add("--robot", action="store_true", help="missing devices are failures, not warnings")
    add("--serial-port", metavar="PORT", help="port of the RoboClaw (default: from config/robot.yaml)")
    add("--camera-url", metavar="URL", help="URL of the Theta (default: from config/robot.yaml)")
    add("--lidar-port", type=int, metavar="PORT", help="UDP port of the VLP-16's data")
    text = "time to wait for LiDAR packets (default: %(default)g s)"
    add("--listen", type=float, default=1.0, metavar="S", help=text)


def run(args: argparse.Namespace) -> int:
    from instant_ic.cli.doctor import FAIL, OK, WARN, run_checks
    from instant_ic.util import paths

    colours = {OK: "32", WARN: "33", FAIL: "31"} if sys.stdout.isatty() else {}
    counts = {OK: 0, WARN: 0, FAIL: 0}
    serial_port = Path(args.serial_port or _shipped("crawler_base", "roboclaw.port", "/dev/ttyACM0"))
    camera_url = args.camera_url or _shipped("theta_camera", "url", "http://192.168.1.1")
    lidar_port = args.lidar_port or _shipped("vlp16_driver", "port", 2368)
    missing = FAIL if args.robot else WARN
    checks = run_checks(paths.run_dir(), serial_port, camera_url, lidar_port, args.listen, missing)
    for finding in checks:
        counts[finding.level] += 1
        level = f"{finding.level:<4}"
        if finding.level in colours:
            level = f"\033[{colours[finding.level]}m{level}\033[0m"
        text = visible(masked(f"{finding.subject}: {finding.text}"))
        print(f"{level}  {text}", file=direct(sys.stdout), flush=True)
        if finding.advice and finding.level != OK:
            print(f"      → {finding.advice}", flush=True)
    print(f"{counts[OK]} ok, {counts[WARN]} warnings, {counts[FAIL]} failures")
    return 1 if counts[FAIL] else 0


def _shipped(node: str, key: str, default: Any) -> Any:
    """Return a parameter of the shipped config/robot.yaml."""
    from instant_ic.config.params import ParameterError, load_file
    from instant_ic.util import paths

    try:
        found = load_file(paths.shipped_file("config", "robot.yaml"), node).get(key)
    except (ParameterError, FileNotFoundError):
        return default  # check_configuration reports the fault in the file
    return default if found is None else found.value
