"""``ic completion``: shell completion of verbs, topics, nodes, parameters, launch files and bags."""

from __future__ import annotations

import argparse
from typing import Any

from instant_ic.cli.arguments import verb

_HINTS = {
    "bash": 'eval "$(ic completion bash)"    in ~/.bashrc',
    "zsh": 'eval "$(ic completion zsh)"    in ~/.zshrc, after compinit',
    "fish": "ic completion fish | source    in ~/.config/fish/config.fish",
}


def add_parser(subparsers: Any) -> None:
    text = "Print the code that enables completion of ic commands with TAB. Add one of these lines:\n\n  "
    parser = verb(
        subparsers, "completion", "set up shell completion", show, "ic completion bash",
        text + "\n  ".join(_HINTS.values()), formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("shell", choices=sorted(_HINTS))


def show(args: argparse.Namespace) -> int:
    import argcomplete

    print(argcomplete.shellcode(["ic"], shell=args.shell))
    return 0
