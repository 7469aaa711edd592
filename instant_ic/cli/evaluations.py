"""Shared options, checks and progress of the kinds of ``ic evaluate`` that drive many courses."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import check_files
from instant_ic.cli.errors import UserError
from instant_ic.cli.progress import progress


def add_options(parser: argparse.ArgumentParser, episodes: int, jobs: int, timeout_s: float, plot: str) -> None:
    """Add the options of every kind, with their defaults; ``plot`` is the help's text on the content of the plot."""
    add = parser.add_argument
    add("--episodes", type=int, default=episodes, metavar="N", help="number of courses (default: %(default)s)")
    add("--seed", type=int, default=0, help="seed of the courses and all noise (default: %(default)s)")
    add("--jobs", type=int, default=jobs, metavar="N", help="courses in parallel (default: %(default)s)")
    add("--json", type=Path, metavar="OUT", help="write all figures here")
    add("--plot", type=Path, metavar="OUT.png", help=f"plot {plot} here")
    add("--timeout", type=float, default=timeout_s, metavar="S", help="time limit (default: %(default)g s)")


def add_stack_options(parser: argparse.ArgumentParser, world: str, example: str) -> None:
    """Add the options of the kinds that run the nodes. ``world`` explains the worlds, ``example`` is a parameter."""
    parser.add_argument("--world", default="corridors", metavar="W", help=f"{world} (default: %(default)s)")
    text = f"override a parameter, for example {example}; repeatable"
    parser.add_argument("-p", "--param", action="append", default=[], metavar="NODE.KEY:=VALUE", help=text)


def print_figures(figures: Any, *files: Path | None) -> None:
    """Write figures as JSON to standard output, and to files."""
    text = json.dumps(figures, indent=2) + "\n"
    for file in files:
        if file is not None:
            file.write_text(text)
    sys.stdout.write(text)


def use_one_thread_for_matrices() -> None:
    """Keep linear algebra on one thread, since its matrices are small; call this before numpy is loaded."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def check_outputs(args: argparse.Namespace, **suffixes: str) -> None:
    """Check, before hours of driving, that the output files can be written.

    Raises:
        UserError: a folder is missing, or the file of an option in ``suffixes`` has the wrong suffix.
    """
    check_files(args.json, args.plot)
    for name, suffix in suffixes.items():
        check_files(getattr(args, name), suffix=suffix)
    if args.timeout <= 0:
        raise UserError(f"--timeout must be > 0 (got {args.timeout:g})")


@contextmanager
def errors_for_the_user() -> Iterator[None]:
    """Turn an evaluation's error about a wrong value, a failed drive or the time limit into a ``UserError``."""
    try:
        yield
    except (ValueError, RuntimeError, TimeoutError) as error:
        raise UserError(str(error)) from error


@contextmanager
def counted(what: str, total: int) -> Iterator[Callable[[str, str], None]]:
    """Yield a function to call after each drive, with a text for the progress bar and a line for logs without one."""
    done = 0
    with progress(what) as show:

        def advance(text: str, line: str) -> None:
            nonlocal done
            done += 1
            if sys.stderr.isatty():
                show(done / total, text)
            else:
                print(line, file=sys.stderr, flush=True)

        yield advance
