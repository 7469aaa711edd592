"""``ic top``: CPU, memory, rates and losses of every node."""

from __future__ import annotations

from typing import Any

from instant_ic.cli.arguments import positive, verb


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add = verb(
        subparsers, "top", "CPU, memory, rates and losses of every node, live", "top.show", "ic top --once",
        "Show CPU, memory, rates (measured/nominal) and losses of every node, once a second.",
    ).add_argument  # fmt: skip
    add("--once", action="store_true", help="print one table and exit (default without a terminal)")
    add("--sort", choices=("cpu", "memory", "name", "lost"), default="cpu", help="default: %(default)s")
    add("-d", "--delay", type=positive, default=1.0, metavar="S", help="update period (default: 1)")
