"""Progress of a long command: a bar in a terminal, else lines."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from instant_ic.util.safe_text import direct

_QUIET_S = 5.0  # a command that ends within this time prints no lines
_DAY_S = 86400.0


@contextmanager
def progress(what: str) -> Iterator[Callable[..., None]]:
    """Yield a function that shows the completed share, 0 to 1, on standard error, with an optional text."""
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import Progress

        # A drive takes minutes on a slow core, so the remaining time is estimated from all drives, not the last 30 s.
        with Progress(console=Console(file=direct(sys.stderr)), speed_estimate_period=_DAY_S) as bar:
            task, shown = bar.add_task(what, total=1.0), 0.0

            def show(share: float, text: str = what) -> None:
                nonlocal shown
                if share >= 1.0 or share - shown >= 0.001:  # no update for each of a million messages
                    shown = share
                    bar.update(task, completed=share, description=text)

            yield show
        return
    began_s, printed = time.monotonic(), 0

    def print_share(share: float, text: str = what) -> None:
        nonlocal printed
        if int(share * 10) > printed and time.monotonic() - began_s > _QUIET_S:
            printed = int(share * 10)
            print(f"{text}: {10 * printed} % after {time.monotonic() - began_s:.0f} s", file=sys.stderr, flush=True)

    yield print_share
