"""Parsers of the commands, and the types of their arguments."""

from __future__ import annotations

import argparse
import importlib
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from instant_ic.cli.errors import UserError


class Parser(argparse.ArgumentParser):
    """A parser whose ``add_argument`` also takes the argument's completer (``cli.completion``)."""

    def add_argument(self, *names: Any, completer: Any = None, **options: Any) -> argparse.Action:
        action = super().add_argument(*names, **options)
        if completer is not None:
            action.completer = completer  # type: ignore[attr-defined]
        return action


def group(subparsers: Any, name: str, words: str, description: str, example: str = "") -> Any:
    """Add a command that has verbs; return the object to which :func:`verb` adds them."""
    epilog = f"example: {example}" if example else None
    parser = subparsers.add_parser(name, help=words, description=description, epilog=epilog)
    return parser.add_subparsers(metavar="VERB", required=True)


def verb(
    verbs: Any, name: str, words: str, run: str | Callable[[argparse.Namespace], int], example: str,
    description: str = "", **options: Any,
) -> Any:  # fmt: skip
    """Add a command or a verb, and return its parser.

    Args:
        verbs: the subparsers, or the result of :func:`group`.
        name: name of the command on the command line.
        words: line in the list of commands; also the description if there is no other.
        run: function of the command, or MODULE.FUNCTION in ``instant_ic.cli``, which is imported when the command runs.
        example: a command line for the help.
        description: first paragraph of the help.
        **options: other options of ``add_parser``.
    """

    def imported(args: argparse.Namespace) -> int:
        module, _, function = str(run).rpartition(".")
        status: int = getattr(importlib.import_module(f"instant_ic.cli.{module}"), function)(args)
        return status

    description = description or f"{words[0].upper()}{words[1:]}."
    parser = verbs.add_parser(name, help=words, description=description, epilog=f"example: {example}", **options)
    parser.set_defaults(func=run if callable(run) else imported)
    return parser


def check_files(*files: Path | None, suffix: str = "") -> None:
    """Check, before long work, that files can be written.

    Raises:
        UserError: a folder is missing, or a name has the wrong suffix.
    """
    for file in files:
        if file is not None and not file.expanduser().absolute().parent.is_dir():
            raise UserError(f"{file}: the folder {file.parent} does not exist", 2)
        if file is not None and suffix and file.suffix.lower() != suffix:
            raise UserError(f"{file}: the name must end in {suffix}", 2)


def positive(text: str) -> float:
    """Read a number > 0."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"must be > 0 (got {text})")
    return value


def positive_int(text: str) -> int:
    """Read a whole number > 0."""
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be > 0 (got {text})")
    return value


def not_negative(text: str) -> int:
    """Read a whole number >= 0."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be >= 0 (got {text})")
    return value


def numbers(form: str) -> Callable[[str], list[float]]:
    """Return the type of an argument such as ``x,y,z,yaw``: one finite number for each name."""

    def parse(text: str) -> list[float]:
        try:
            values = [float(word) for word in text.split(",")]
        except ValueError:
            values = []
        if len(values) != len(form.split(",")) or not all(map(math.isfinite, values)):
            raise argparse.ArgumentTypeError(f"must be {form}: {len(form.split(','))} numbers (got {text!r})")
        return values

    return parse


def size(text: str) -> tuple[int, int]:
    """Read a size in pixels, ``640x360``."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"must look like 640x360 (got {text!r})")
    return int(match[1]), int(match[2])


def launch_values(words: Sequence[str]) -> dict[str, str]:
    """Return the values of a launch file's arguments, given as ``KEY:=VALUE``.

    Raises:
        UserError: an argument has another form.
    """
    values: dict[str, str] = {}
    for word in words:
        name, separator, value = word.partition(":=")
        if not separator or not name:
            raise UserError(f"{word!r}: expected KEY:=VALUE", 2)
        values[name] = value
    return values
