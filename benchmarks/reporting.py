"""What the benchmarks share: the command line and the JSON result."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """Parser with a module's docstring as its help, and the option ``--json``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the result here")
    return parser


def report(result: dict[str, Any], out: Path | None) -> None:
    """Print the result as JSON, and write it to a file if there is one."""
    text = json.dumps(result, indent=2)
    if out is not None:
        out.write_text(text + "\n")
    print(text, flush=True)


def note(text: str) -> None:
    """Print the progress."""
    print(text, file=sys.stderr, flush=True)
