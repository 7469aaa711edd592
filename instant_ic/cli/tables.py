"""Aligned columns for the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from instant_ic.util.safe_text import direct, masked, visible

_PIPE_WIDTH = 10_000  # so that lines in a pipe or file are never broken


def print_table(rows: Iterable[Sequence[object]], headings: Sequence[str] = (), right: Sequence[int] = ()) -> None:
    """Print rows as columns, without control characters and passwords.

    Args:
        rows: cells of each row.
        headings: names of the columns; empty: no headings.
        right: indices of the columns that are aligned to the right.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, show_header=bool(headings), header_style="bold")
    cells = [[Text(visible(masked(str(cell)))) for cell in row] for row in rows]
    if not (cells or headings):
        return
    for number in range(len(headings) or max(map(len, cells), default=0)):
        heading = headings[number] if headings else ""
        table.add_column(heading, justify="right" if number in right else "left", overflow="fold")
    for row in cells:
        table.add_row(*row)
    width = None if sys.stdout.isatty() else _PIPE_WIDTH
    Console(file=direct(sys.stdout), highlight=False, width=width).print(table)
