"""Read, check, start, supervise and stop launch files (docs/launch.md)."""

from instant_ic.launch.description import LaunchArgument, LaunchDescription, LaunchFileError, NodeSpec, find_launch_file
from instant_ic.launch.reader import read_arguments, read_launch_file

__all__ = [
    "LaunchArgument",
    "LaunchDescription",
    "LaunchFileError",
    "NodeSpec",
    "find_launch_file",
    "read_arguments",
    "read_launch_file",
]
