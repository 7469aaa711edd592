"""Progress of a long command: a bar in a terminal, a line per 10 % elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_QUIET_S = 5.0  # a command that ends within this time prints no lines


@contextmanager
def progress(what: str) -> Iterator[Callable[[float], None]]:
    """Yield a function that takes the completed share, 0 to 1, and shows it on standard error."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress

        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task(what, total=1.0)
            shown = [0.0]

            def draw(share: float) -> None:
                if share >= 1.0 or share - shown[0] >= 0.001:
                    shown[0] = share
                    bar.update(task, completed=share)

            yield draw
        return
    began_s = time.monotonic()
    printed = [0]

    def print_share(share: float) -> None:
        tenth = int(share * 10)
        if tenth > printed[0] and time.monotonic() - began_s > _QUIET_S:
            printed[0] = tenth
            print(f"{what}: {10 * tenth} % after {time.monotonic() - began_s:.0f} s", file=sys.stderr, flush=True)

    yield print_share
