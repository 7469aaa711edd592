"""``ic interface``: message types and their fields."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli import completion
from instant_ic.cli.arguments import group, verb
from instant_ic.cli.errors import UserError


def add_parser(subparsers: Any) -> None:
    verbs = group(
        subparsers, "interface", "list and show message types",
        "List message types and show their fields with units and frames.",
        "ic interface show instant_ic_msgs/msg/Keyframe",
    )  # fmt: skip
    text = "List the message types of ROS 2 and of this project."
    verb(verbs, "list", "all message types", list_types, "ic interface list", text)
    text = "message types of one package"
    package = verb(verbs, "package", text, list_package, "ic interface package instant_ic_msgs")
    package.add_argument("package", metavar="NAME", completer=completion.packages)
    shown = verb(
        verbs, "show", "definition of a message type", show, "ic interface show sensor_msgs/msg/LaserScan",
        "Show the definition of a message type, with the fields of nested types.",
    )  # fmt: skip
    shown.add_argument("type", metavar="TYPE", help="full or short name", completer=completion.types)
    shown.add_argument("--all-comments", action="store_true", help="also show the comments of nested types")


def list_types(args: argparse.Namespace) -> int:
    from instant_ic.msg import typestore

    print("Messages:")
    for name in sorted(typestore().types):
        print(f"    {name}")
    return 0


def list_package(args: argparse.Namespace) -> int:
    from instant_ic.cli.names import near
    from instant_ic.msg import typestore

    types = sorted(typestore().types)
    found = [name for name in types if name.split("/")[0] == args.package]
    if not found:
        packages = {name.split("/")[0] for name in types}
        raise UserError(f"no package {args.package!r} ({near(args.package, packages, 'see ic interface list')})", 2)
    print("\n".join(found))
    return 0


def show(args: argparse.Namespace) -> int:
    from instant_ic.cli.names import find_type
    from instant_ic.msg.definition import expanded_definition

    print(expanded_definition(find_type(args.type), args.all_comments))
    return 0
