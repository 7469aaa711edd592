"""The command line and the result of the benchmarks."""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def parser_for(doc: str | None, with_json: bool = True) -> argparse.ArgumentParser:
    """Return a parser with a module's docstring as its help, and the option ``--json``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if with_json:
        parser.add_argument("--json", type=Path, metavar="OUT", help="also write the result here")
    return parser


def report(result: dict[str, Any], out: Path | None) -> None:
    """Print the result as JSON, and write it to a file if one is given."""
    text = json.dumps(result, indent=2)
    if out is not None:
        out.write_text(text + "\n")
    print(text, flush=True)


def note(text: str) -> None:
    """Print the progress to standard error."""
    print(text, file=sys.stderr, flush=True)


def summary(values: Sequence[float], unit: str = "ms") -> dict[str, Any]:
    """Return count, median, 99th percentile and maximum of some values, with the unit in their names."""
    if not len(values):
        return {"n": 0}
    return {
        "n": len(values),
        f"p50_{unit}": round(statistics.median(values), 2),
        f"p99_{unit}": round(float(np.percentile(values, 99)), 2),
        f"worst_{unit}": round(max(values), 2),
    }
