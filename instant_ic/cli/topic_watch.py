"""``ic topic echo``, ``hz``, ``bw``, ``delay``: print messages as they arrive, or statistics once a second."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import fmean

from instant_ic.bus.transport import Received
from instant_ic.cli.errors import UserError
from instant_ic.cli.messages import Style, csv_line, describe, field, json_line
from instant_ic.cli.observer import Observer
from instant_ic.cli.window import Rate, Window, losses, size_words
from instant_ic.msg import MessageError, deserialize, stamp_ns


def echo(args: argparse.Namespace) -> int:
    wanted = 1 if args.once else args.n
    style = Style(args.full_length, args.truncate_length, not args.no_arr, not args.no_str)
    count = 0
    with Observer(args.topic) as observer:
        observer.hint()
        for batch in observer.batches(args.timeout, 0.5):
            for received in batch:
                message = deserialize(received.payload, received.type_name)
                try:
                    value = field(message, args.field)
                except AttributeError as error:
                    raise UserError(f"{received.type_name}: {error}", 2) from None
                if args.json:
                    print(json_line(value), flush=True)
                elif args.csv:
                    print(csv_line(value, style), flush=True)
                else:
                    print(f"{describe(value, style)}\n---", flush=True)
                count += 1
                if count == wanted:
                    return 0
        if count < max(wanted, 1):
            raise observer.too_few(args.timeout)
    return 0


def rate(args: argparse.Namespace) -> int:
    with Observer(args.topic, args.use_sim_time) as observer:
        rates = {topic: Rate(args.window) for topic in observer.topics}
        _watch(
            observer,
            args.duration,
            lambda received: rates[received.topic].add(received.received_ns),
            lambda topic: rates[topic].line(observer.lost_by(topic)),
        )
        if all(one.count < 2 for one in rates.values()):
            raise observer.too_few(args.duration)
    return 0


class _Bandwidth:
    """Sizes and arrival times of the newest messages of a topic."""

    def __init__(self, window: int) -> None:
        self.sizes, self.stamps = Window(window), Window(window)

    def add(self, received: Received) -> None:
        self.sizes.add(len(received.payload))
        self.stamps.add(time.monotonic())

    def line(self) -> str:
        sizes, stamps = self.sizes.values, self.stamps.values
        if not sizes:
            return "no message yet"
        # From the first message to now, so that a pause lowers the result.
        per_s = sum(sizes) / max(time.monotonic() - stamps[0], 1e-3)
        return (
            f"{size_words(per_s)}/s from {len(sizes)} messages  size mean: {size_words(fmean(sizes))} "
            f"min: {size_words(min(sizes))} max: {size_words(max(sizes))}"
        )


def bandwidth(args: argparse.Namespace) -> int:
    with Observer(args.topic) as observer:
        flows = {topic: _Bandwidth(args.window) for topic in observer.topics}
        _watch(
            observer,
            args.duration,
            lambda received: flows[received.topic].add(received),
            lambda topic: f"{flows[topic].line()}  lost: {losses(observer.lost_by(topic))}",
        )
        if not any(flow.sizes.count for flow in flows.values()):
            raise observer.too_few(args.duration)
    return 0


def delay(args: argparse.Namespace) -> int:
    with Observer(args.topic, args.use_sim_time) as observer:
        delays = {topic: Window(args.window) for topic in observer.topics}

        def take(received: Received) -> None:
            message = deserialize(received.payload, received.type_name)
            if getattr(message, "transforms", None) is not None:
                if not message.transforms:
                    return
                message = message.transforms[-1]
            try:
                stamp = stamp_ns(message)
            except MessageError:
                raise UserError(
                    f"{received.topic}: {received.type_name} has no stamp, so its age is unknown", 2
                ) from None
            if received.received_ns:  # simulated time has started
                delays[received.topic].add((received.received_ns - stamp) / 1e9)

        def line(topic: str) -> str:
            values = delays[topic].values
            return f"average delay: {fmean(values):.4f}  {delays[topic].spread()}" if values else "no message yet"

        _watch(observer, args.duration, take, line)
        if not any(window.count for window in delays.values()):
            raise observer.too_few(args.duration)
    return 0


def _watch(observer: Observer, duration_s: float, take: Callable[[Received], None], line: Callable[[str], str]) -> None:
    """Print a line per topic each second and at the end."""
    observer.hint()
    width = max(len(topic) for topic in observer.topics) if len(observer.topics) > 1 else 0

    def print_lines() -> None:
        for topic in observer.topics:
            print(f"{topic:<{width}}  {line(topic)}" if width else line(topic), flush=True)

    next_s = time.monotonic() + 1.0
    printed_s = 0.0
    for batch in observer.batches(duration_s, 0.1):
        for received in batch:
            take(received)
        if time.monotonic() >= next_s:
            printed_s, next_s = time.monotonic(), next_s + 1.0
            print_lines()
    if time.monotonic() - printed_s > 0.2:
        print_lines()
