"""``ic compile``: compile the kernels ahead of the first start."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from instant_ic.cli.arguments import verb

NODES = ("simulator", "vlp16_driver", "grid_slam", "arbiter", "navigator", "nerf")
"""Nodes that run kernels."""


def add_parser(subparsers: Any) -> None:
    verb(
        subparsers, "compile", "compile the kernels ahead of the first start", run, "ic compile",
        "Compile the numba kernels of all nodes. This takes a minute on two cores after an installation or a change "
        "of their sources. `make install` runs this command, and `ic launch` does if needed.",
    )  # fmt: skip


def run(args: argparse.Namespace | None = None) -> int:
    from instant_ic.cli.kernels import are_compiled, compile_all
    from instant_ic.cli.progress import progress

    try:
        if are_compiled():
            return 0
        print("compiling kernels (about a minute, once)", file=sys.stderr, flush=True)
        with progress("compiling kernels") as report:
            problems = compile_all(report)
    except OSError as error:  # without a folder for the cache, each node compiles for itself
        problems = [f"the kernels cannot be compiled ahead: {error}"]
    for problem in problems:
        print(f"ic: {problem}", file=sys.stderr)
    return 1 if problems else 0
