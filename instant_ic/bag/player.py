"""Plays a bag at its own pace, or faster; the clock goes before each message."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from instant_ic.bag.errors import BagError
from instant_ic.bag.files import BagMessage, BagReader
from instant_ic.bag.recorder import EVERYTHING, TopicChoice

NEVER_PLAYED = ("/clock", "/rosout", "/heartbeat", "/diagnostics")
"""What nodes tell of themselves and the time itself: those who run now tell their own."""


@dataclass(frozen=True)
class PlayOptions:
    """How a bag is played.

    Attributes:
        rate: 2 plays twice as fast.
        start_offset_s: skip this much of the beginning; latched values of it are still sent.
        duration_s: end after this much of the bag; 0 plays to the end.
        loop: begin again at the end.
        choice: which topics.
    """

    rate: float = 1.0
    start_offset_s: float = 0.0
    duration_s: float = 0.0
    loop: bool = False
    choice: TopicChoice = EVERYTHING

    def __post_init__(self) -> None:
        """Checks the values."""
        if not self.rate > 0:
            raise ValueError(f"rate must be > 0 (got {self.rate})")
        if self.start_offset_s < 0:
            raise ValueError(f"start_offset_s must be >= 0 (got {self.start_offset_s})")
        if self.duration_s < 0:
            raise ValueError(f"duration_s must be >= 0 (got {self.duration_s})")


class BagPlayer:
    """Paces the messages of a bag; knows no bus.

    Args:
        path: the bag.
        options: how to play it.

    Raises:
        BagError: no bag, or nothing in it to play.
    """

    def __init__(self, path: Path, options: PlayOptions) -> None:
        self.options = options
        self._reader = BagReader(path)
        played = {t.topic for t in self._reader.topics if options.choice.takes(t.topic)} - set(NEVER_PLAYED)
        self.topics = [t for t in self._reader.topics if t.topic in played]
        """What will be sent."""
        self._names = {t.topic for t in self.topics}
        self.start_ns = self._reader.start_ns + int(options.start_offset_s * 1e9)
        self.end_ns = self._reader.end_ns
        if options.duration_s:
            self.end_ns = min(self.end_ns, self.start_ns + int(options.duration_s * 1e9))
        if not self.topics:
            self._reader.close()
            raise BagError(f"bag {path} has none of the topics that were asked for")
        if self.start_ns > self.end_ns:
            self._reader.close()
            raise BagError(f"bag {path} ends before start_offset_s = {options.start_offset_s}")

    def close(self) -> None:
        """Closes the bag."""
        self._reader.close()

    def play(
        self, send: Callable[[BagMessage], None], stop: threading.Event, now_s: Callable[[], float] = time.monotonic
    ) -> bool:
        """Sends every message at its time; returns at the end, or when ``stop`` is set.

        Args:
            send: called with each message, once its time has come.
            stop: ends it; also interrupts waiting.
            now_s: the clock of the pace.

        Returns:
            Whether it came to the end.
        """
        while True:
            self._send_latched_before_start(send)
            began_s = now_s()
            for message in self._reader.messages(self._names, self.start_ns, self.end_ns + 1):
                due_s = began_s + (message.stamp_ns - self.start_ns) / 1e9 / self.options.rate
                if stop.wait(max(0.0, due_s - now_s())):
                    return False
                send(message)
            if not self.options.loop:
                return True
            if stop.is_set():
                return False

    def _send_latched_before_start(self, send: Callable[[BagMessage], None]) -> None:
        """The state that the skipped part left: the last value of each latched topic; transforms, all of them."""
        latched = {topic.topic for topic in self.topics if topic.qos.latched}
        if not self.options.start_offset_s or not latched:
            return
        newest: dict[str, BagMessage] = {}
        for message in self._reader.messages(latched, None, self.start_ns):
            if message.topic == "/tf_static":  # each publisher sends its own
                send(_at(message, self.start_ns))
            else:
                newest[message.topic] = message
        for message in newest.values():
            send(_at(message, self.start_ns))


def _at(message: BagMessage, stamp_ns: int) -> BagMessage:
    return BagMessage(message.topic, message.type_name, message.payload, stamp_ns, message.qos)
