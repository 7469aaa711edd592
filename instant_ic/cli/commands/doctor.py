"""``ic doctor``: check machine, devices and configuration."""

from __future__ import annotations

from typing import Any

from instant_ic.cli.arguments import verb


def add_parser(subparsers: Any) -> None:
    add = verb(
        subparsers, "doctor", "check machine, devices, ports, models and configuration", "doctor.run",
        "ic doctor --robot --serial-port /dev/ttyACM0", "Check this machine, its devices, ports, models and "
        "configuration, and advise what to do. The exit status is 1 if a check fails.",
    ).add_argument  # fmt: skip
    add("--robot", action="store_true", help="missing devices are failures, not warnings")
    add("--serial-port", metavar="PORT", help="port of the RoboClaw (default: from config/robot.yaml)")
    add("--camera-url", metavar="URL", help="URL of the Theta (default: from config/robot.yaml)")
    add("--lidar-port", type=int, metavar="PORT", help="UDP port of the VLP-16's data")
    text = "time to wait for LiDAR packets (default: %(default)g s)"
    add("--listen", type=float, default=1.0, metavar="S", help=text)
