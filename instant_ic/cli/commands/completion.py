"""``ic completion``: shell completion of verbs, topics, nodes, parameters, launch files and bags."""

from __future__ import annotations

import argparse
from typing import Any

_HINTS = {
    "bash": 'eval "$(ic completion bash)"    in ~/.bashrc',
    "zsh": 'eval "$(ic completion zsh)"    in ~/.zshrc, after compinit',
    "fish": "ic completion fish | source    in ~/.config/fish/config.fish",
}


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "completion",
        help="set up shell completion",
        description="Print the code that enables completion of ic commands with TAB. Add one of these lines:\n\n  "
        + "\n  ".join(_HINTS.values()),
        epilog="example: ic completion bash",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("shell", choices=sorted(_HINTS))
    parser.set_defaults(func=show)


def show(args: argparse.Namespace) -> int:
    """Print the shell code."""
    import argcomplete

    print(argcomplete.shellcode(["ic"], shell=args.shell))
    return 0
