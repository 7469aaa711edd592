"""The ``ic`` command. Each module of ``instant_ic.cli.commands`` is a verb, with ``add_parser(subparsers)``.

These modules import their dependencies inside their functions, which keeps ``ic --help`` fast. Exit status: 0 done,
1 failed, 2 wrong usage.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import pkgutil
import signal
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from types import FrameType
from typing import IO, cast

from instant_ic.cli import commands
from instant_ic.cli.arguments import Parser
from instant_ic.cli.errors import UserError
from instant_ic.util.closing import on_end_signal
from instant_ic.util.safe_text import VisibleStream

_DESCRIPTION = "Instant IC: teleoperation that switches between a real robot and an instantly built virtual one."
_EPILOG = """examples:
  ic launch sim                         the whole stack with simulated devices
  ic launch robot --show-args           list the launch arguments
  ic topic hz /scan                     rate of a topic
  ic param set depth_estimator max_rate_hz 1
  ic top                                state and load of every node, live
  ic bag record -o drive                record all topics into the folder drive
  ic replay drive --nodes grid_slam,depth_estimator,depth_scaler -o again
  ic doctor                             check this machine
"""

_FULL = (errno.ENOSPC, errno.EDQUOT)


class _Version(argparse.Action):
    """The option ``--version``, whose text is looked up only when it is used."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib import metadata

        try:
            print(f"ic {metadata.version('instant-ic')}")
        except metadata.PackageNotFoundError:
            parser.error("the package instant-ic is not installed, so that its version is unknown: run make install")
        parser.exit()


def build_parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="ic", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--run-dir", dest="stack", metavar="DIR", help="run directory of the stack (default: $INSTANT_IC_RUN_DIR)"
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for info in sorted(pkgutil.iter_modules(commands.__path__), key=lambda info: info.name):
        module = importlib.import_module(f"{commands.__name__}.{info.name}")
        if hasattr(module, "add_parser"):
            module.add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    words = sys.argv[1:] if argv is None else argv
    launches = words[:1] == ["launch"]

    def end(signum: int, frame: FrameType | None) -> None:
        if launches:  # before the stack is up
            raise SystemExit(0)
        raise KeyboardInterrupt if signum == signal.SIGINT else _Terminated

    with on_end_signal(end):
        return _main(argv)


class _Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP. They end a command as Ctrl-C does: it stops its nodes and removes its temporary files."""


def _main(argv: Sequence[str] | None) -> int:
    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:  # the shell asks for completions
        import argcomplete

        argcomplete.autocomplete(parser)
    args = parser.parse_args(argv)
    if args.stack:
        os.environ["INSTANT_IC_RUN_DIR"] = args.stack
    status = _call(args)
    if argv is None and getattr(args, "leaves", False):
        from instant_ic.bus.process import leave

        leave(status)
    return status


def _call(args: argparse.Namespace) -> int:
    """Run the command. Texts that it prints from bags, peers and files cannot control the terminal."""
    out, err = cast("IO[str]", VisibleStream(sys.stdout)), cast("IO[str]", VisibleStream(sys.stderr))
    with redirect_stdout(out), redirect_stderr(err):
        return _status(args)


def _status(args: argparse.Namespace) -> int:
    try:
        return int(args.func(args) or 0)
    except UserError as error:
        print(f"ic: {error}", file=sys.stderr)
        return error.status
    except _Terminated:
        return 143
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # as in ic topic echo ... | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if isinstance(error, OSError) and error.filename:  # a file that cannot be read or written
            print(f"ic: {error.filename}: {error.strerror}", file=sys.stderr)
            return 1
        if isinstance(error, OSError) and error.errno in _FULL:  # an error of a write has no file name
            print(f"ic: a file could not be written: {error.strerror}. Free some space.", file=sys.stderr)
            return 1
        if type(error) in (FileNotFoundError, FileExistsError):  # raised by our code: no file name, unlike the system's
            print(f"ic: {error}", file=sys.stderr)
            return 2
        # Our own error classes have a message for the user. Any other error is a bug and keeps its traceback.
        if not type(error).__module__.startswith("instant_ic."):
            raise
        print(f"ic: {error}", file=sys.stderr)
        return 2 if type(error).__name__ in ("LaunchFileError", "ParameterError") else 1


if __name__ == "__main__":
    sys.exit(main())
