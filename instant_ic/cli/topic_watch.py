"""``ic topic echo``, ``hz``, ``bw``, ``delay``: print messages as they arrive, or statistics once a second."""

from __future__ import annotations

import argparse
import time
from collections import deque
from collections.abc import Mapping
from statistics import fmean, pstdev

from instant_ic.bus.transport import Received
from instant_ic.cli.errors import UserError
from instant_ic.cli.messages import describe, field, json_line
from instant_ic.cli.observer import TopicObserver
from instant_ic.msg import MessageError, deserialize, stamp_ns


def echo(args: argparse.Namespace) -> int:
    """Print messages as they arrive."""
    wanted = 1 if args.once else args.n
    count = 0
    with TopicObserver(args.topic) as observer:
        observer.hint()
        for received in (one for batch in observer.batches(args.timeout, 0.5) for one in batch):
            message = deserialize(received.payload, received.type_name)
            try:
                value = field(message, args.field)
            except AttributeError as error:
                raise UserError(f"{received.type_name}: {error}", 2) from None
            text = json_line(value) if args.json else f"{describe(value, None if args.full_length else 12)}\n---"
            print(text, flush=True)
            count += 1
            if count == wanted:
                return 0
        if count < max(wanted, 1):
            raise observer.too_few(args.timeout)
    return 0


class Rate:
    """Rate of a topic from the arrival times of its messages."""

    def __init__(self, window: int) -> None:
        self._gaps_s: deque[float] = deque(maxlen=window)
        self._last_ns: int | None = None

    def add(self, received: Received) -> None:
        """Add the arrival of a message. The count restarts when time jumps back, as with a bag that loops."""
        now_ns = received.received_ns
        if self._last_ns is not None and now_ns < self._last_ns:
            self._gaps_s.clear()
        elif self._last_ns is not None:
            self._gaps_s.append((now_ns - self._last_ns) / 1e9)
        self._last_ns = now_ns

    def line(self) -> str:
        """Return the mean rate and the spread of the gaps between messages."""
        if not self._gaps_s:
            return ""
        mean_s = fmean(self._gaps_s)
        return f"average rate: {1 / mean_s if mean_s > 0 else float('inf'):.3f}  {_spread(self._gaps_s)}"


class Bandwidth:
    """Sizes and arrival times of the newest messages of a topic."""

    def __init__(self, window: int) -> None:
        self._sizes: deque[int] = deque(maxlen=window)
        self._arrivals_s: deque[float] = deque(maxlen=window)

    def add(self, received: Received) -> None:
        """Add one message."""
        self._sizes.append(len(received.payload))
        self._arrivals_s.append(time.monotonic())

    def line(self) -> str:
        """Return the bytes per second and the sizes of the messages."""
        if not self._sizes:
            return ""
        # The time from the first message to now counts, so that a pause lowers the result.
        per_s = sum(self._sizes) / max(time.monotonic() - self._arrivals_s[0], 1e-3)
        return (
            f"{size_text(per_s)}/s from {len(self._sizes)} messages  size mean: {size_text(fmean(self._sizes))} "
            f"min: {size_text(min(self._sizes))} max: {size_text(max(self._sizes))}"
        )


class Delay:
    """Age of the newest messages of a topic on arrival, by their stamps."""

    def __init__(self, window: int) -> None:
        self._ages_s: deque[float] = deque(maxlen=window)

    def add(self, received: Received) -> None:
        """Add one message.

        Raises:
            UserError: the message's type has no stamp.
        """
        message = deserialize(received.payload, received.type_name)
        if getattr(message, "transforms", None) is not None:
            if not message.transforms:
                return
            message = message.transforms[-1]
        try:
            stamp = stamp_ns(message)
        except MessageError:
            raise UserError(f"{received.topic}: {received.type_name} has no stamp, so its age is unknown", 2) from None
        self._ages_s.append((received.received_ns - stamp) / 1e9)

    def line(self) -> str:
        """Return the mean and the spread of the ages."""
        return f"average delay: {fmean(self._ages_s):.4f}  {_spread(self._ages_s)}" if self._ages_s else ""


def rate(args: argparse.Namespace) -> int:
    """Print rates once a second."""
    return _watch(args, Rate)


def bandwidth(args: argparse.Namespace) -> int:
    """Print bandwidths once a second."""
    return _watch(args, Bandwidth)


def delay(args: argparse.Namespace) -> int:
    """Print ages of messages once a second."""
    return _watch(args, Delay)


def _watch(args: argparse.Namespace, kind: type[Rate | Bandwidth | Delay]) -> int:
    """Print a line for each topic every second and at the end."""
    with TopicObserver(args.topic) as observer:
        watched = {topic: kind(args.window) for topic in observer.topics}
        width = max(map(len, watched)) if len(watched) > 1 else 0

        def print_lines() -> None:
            for topic, statistics in watched.items():
                text = f"{statistics.line() or 'too few messages yet'}  lost: {losses(observer.lost_by(topic))}"
                print(f"{topic:<{width}}  {text}" if width else text, flush=True)

        observer.hint()
        next_s = time.monotonic() + 1.0
        printed_s = 0.0
        for batch in observer.batches(args.duration, 0.1):
            for received in batch:
                watched[received.topic].add(received)
            if time.monotonic() >= next_s:
                printed_s, next_s = time.monotonic(), next_s + 1.0
                print_lines()
        if time.monotonic() - printed_s > 0.2:
            print_lines()
        if not any(statistics.line() for statistics in watched.values()):
            raise observer.too_few(args.duration)
    return 0


def _spread(values: deque[float]) -> str:
    """Return minimum, maximum, standard deviation and number of values in seconds, as text."""
    return f"min: {min(values):.4f}s max: {max(values):.4f}s std dev: {pstdev(values):.5f}s window: {len(values)}"


def losses(lost_by: Mapping[str, int]) -> str:
    """Return the number of lost messages in total and by publisher as text: ``3 (vlp16_driver 3)``."""
    by = ", ".join(f"{publisher} {count}" for publisher, count in sorted(lost_by.items()))
    return f"{sum(lost_by.values())} ({by})" if by else "0"


def size_text(size: float) -> str:
    """Return a number of bytes with a unit: ``1.25 MB``."""
    for factor, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size >= factor:
            return f"{size / factor:.2f} {unit}"
    return f"{size:.0f} B"
