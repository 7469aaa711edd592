"""Playback of a bag in real time or at another rate, with pause and single steps."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.files import BagReader, TopicSummary
from instant_ic.bag.latched import LatchedValues
from instant_ic.bag.message import BagError, BagMessage
from instant_ic.bus.heartbeat import EVERY_NODES
from instant_ic.config.ranges import Checked, NotNegative, Range

NEVER_PLAYED = ("/clock", *EVERY_NODES)
"""Topics of the clock and of the nodes' reports about themselves, because running nodes publish their own."""

CLOCK_HZ = 40.0
"""Lowest rate of ``/clock``, even while paused and in gaps of the bag."""

RATES = (0.01, 100.0)
"""Smallest and largest rate that can be set during playback."""


@dataclass(frozen=True)
class BagPlayerConfig(Checked):
    """Parameters of ``bag_player``.

    Attributes:
        bag: folder of the bag, or a ``.mcap`` or ``.db3`` file.
        rate: 2 plays twice as fast.
        start_offset_s: seconds to skip at the start; latched messages from the skipped part are still published.
        duration_s: length of the played part in seconds; 0 plays to the end.
        loop: restart at the end; the time then jumps back.
        start_paused: wait at the start until resumed or stepped.
        topics: names or patterns of the topics to play; empty plays everything.
        exclude: names or patterns of the topics to leave out.
        drop_transforms: child frames whose transforms are left out of ``/tf`` because another node broadcasts them.
        publish_clock: whether to publish ``/clock``.
        delay_s: seconds to wait at the first stamp, so that subscribers find the topics.
        wait_for: nodes that must run, with all their subscriptions connected, before playback starts.
        force: play commands and states although a base is running. This may move the robot.
    """

    bag: str = ""
    rate: Annotated[float, Range(*RATES)] = 1.0
    start_offset_s: NotNegative = 0.0
    duration_s: NotNegative = 0.0
    loop: bool = False
    start_paused: bool = False
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    drop_transforms: tuple[str, ...] = ()
    publish_clock: bool = True
    delay_s: NotNegative = 0.5
    wait_for: tuple[str, ...] = ()
    force: bool = False

    def __post_init__(self) -> None:
        if not self.bag:
            raise ValueError("bag must name a folder (got '')")
        super().__post_init__()


class BagPlayer:
    """Pacing of a bag's messages, independent of the bus. Its controls may be called from any thread.

    Raises:
        BagError: there is no bag, or the selection is empty.
    """

    def __init__(self, options: BagPlayerConfig) -> None:
        self.options = options
        choice = TopicChoice(options.topics, options.exclude)
        self._reader = BagReader(Path(options.bag).expanduser())
        self.left_out: dict[str, str] = {}
        """Topics and types that are not sent, with the reason."""
        chosen: dict[str, TopicSummary] = {}
        # A publisher has one type: if a topic has several, play the one with the most messages.
        for topic in sorted(self._reader.topics, key=lambda topic: -topic.count):
            if topic.topic in NEVER_PLAYED or not choice.takes(topic.topic):
                continue
            if why := topic.problem or ("the topic also has another type" if topic.topic in chosen else ""):
                self.left_out[f"{topic.topic} ({topic.type_name}, {topic.count} messages)"] = why
            else:
                chosen[topic.topic] = topic
        self.topics = [chosen[topic] for topic in sorted(chosen)]
        """Topics to send."""
        self._types = {t.topic: t.type_name for t in self.topics}
        self.start_ns = self._reader.start_ns + int(options.start_offset_s * 1e9)
        self.end_ns = self._reader.end_ns
        if options.duration_s:
            self.end_ns = min(self.end_ns, self.start_ns + int(options.duration_s * 1e9))
        if not self.topics:
            self._reader.close()
            why = "".join(f"; {topic}: {words}" for topic, words in self.left_out.items())
            raise BagError(f"bag {options.bag} has none of the selected topics{why}")
        if self.start_ns > self.end_ns:
            self._reader.close()
            raise BagError(f"bag {options.bag} ends before start_offset_s = {options.start_offset_s}")
        self.position_ns = self.start_ns
        """Current time in the bag."""
        self.sent = 0
        """Messages sent."""
        self.latest_s = 0.0
        """Delay of the latest message in seconds: positive if the machine or the receiver is slower than the bag."""
        self.rate = options.rate
        """Playback speed; 2 plays twice as fast."""
        self.paused = options.start_paused
        self._steps = 0
        self._anchor_s = 0.0
        self._anchor_ns = self.start_ns
        self._lock = threading.Lock()
        self._now_s: Callable[[], float] = time.monotonic

    def close(self) -> None:
        self._reader.close()

    # -- controls ----------------------------------------------------------------------------------

    def set_rate(self, rate: float) -> None:
        """Change the playback speed.

        Raises:
            ValueError: the rate is outside :data:`RATES`.
        """
        if not RATES[0] <= rate <= RATES[1]:
            raise ValueError(f"rate must lie in {RATES[0]:g}..{RATES[1]:g} (got {rate})")
        with self._lock:
            self._anchor(self.position_ns)
            self.rate = rate

    def pause(self) -> None:
        self.paused = True

    def resume(self) -> None:
        with self._lock:
            self._anchor(self.position_ns)
            self.paused = False

    def step(self, count: int = 1) -> None:
        """Send the next ``count`` messages, then pause.

        Raises:
            ValueError: ``count`` is less than 1.
        """
        if count < 1:
            raise ValueError(f"count must be >= 1 (got {count})")
        with self._lock:
            self.paused = True
            self._steps += count

    def status(self) -> dict[str, Any]:
        return {
            "state": "paused" if self.paused else "playing",
            "position_s": round((self.position_ns - self.start_ns) / 1e9, 3),
            "length_s": round((self.end_ns - self.start_ns) / 1e9, 3),
            "rate": self.rate,
            "sent": self.sent,
            "late_s": round(self.latest_s, 3),
        }

    # -- playing -----------------------------------------------------------------------------------

    def play(
        self,
        send: Callable[[BagMessage], None],
        stop: threading.Event,
        now_s: Callable[[], float] = time.monotonic,
        on_clock: Callable[[int], None] = lambda stamp_ns: None,
    ) -> bool:
        """Send every message at its time; return at the end, or when ``stop`` is set.

        Args:
            send: called with each message when it is due.
            stop: ends playback; also interrupts waiting.
            now_s: monotonic time in seconds.
            on_clock: called with the bag's time at the start and then periodically. Between two calls, read
                :attr:`position_ns`.

        Returns:
            Whether playback reached the end.
        """
        self._now_s = now_s
        while True:
            self.position_ns = self.start_ns
            on_clock(self.start_ns)
            self._send_latched_before(send)
            with self._lock:
                self._anchor(self.start_ns)
            self._play_once(send, stop, on_clock)
            if stop.is_set():
                return False
            if not self.options.loop:
                return True

    def _play_once(
        self, send: Callable[[BagMessage], None], stop: threading.Event, on_clock: Callable[[int], None]
    ) -> None:
        period_s = 1.0 / CLOCK_HZ
        next_clock_s = self._now_s() + period_s
        for message in self._messages(set(self._types), self.start_ns, self.end_ns + 1):
            while True:
                if stop.is_set():
                    return
                now_s = self._now_s()
                with self._lock:
                    if self._steps and self.paused:
                        self._steps -= 1
                        self._anchor(message.stamp_ns)
                        break
                    due_s = self._anchor_s + (message.stamp_ns - self._anchor_ns) / 1e9 / self.rate
                    if not self.paused:
                        if now_s >= due_s:
                            self.latest_s = max(self.latest_s, now_s - due_s)
                            break
                        at_ns = self._anchor_ns + int((now_s - self._anchor_s) * self.rate * 1e9)
                        self.position_ns = min(max(self.position_ns, at_ns), message.stamp_ns)
                if now_s >= next_clock_s:
                    next_clock_s = now_s + period_s
                    on_clock(self.position_ns)
                stop.wait(period_s if self.paused else min(due_s - now_s, max(0.0, next_clock_s - now_s)))
            self.position_ns = max(self.position_ns, message.stamp_ns)
            send(message)
            self.sent += 1

    def _messages(self, topics: set[str], start_ns: int | None, stop_ns: int) -> Iterator[BagMessage]:
        messages = self._reader.messages(topics, start_ns, stop_ns, current=True)
        return (message for message in messages if message.type_name == self._types[message.topic])

    def _anchor(self, stamp_ns: int) -> None:
        self._anchor_s, self._anchor_ns = self._now_s(), stamp_ns

    def _send_latched_before(self, send: Callable[[BagMessage], None]) -> None:
        """Send the state at the end of the skipped part: the last value of each latched topic, and all transforms."""
        latched = {topic.topic for topic in self.topics if topic.qos.latched}
        if self.start_ns == self._reader.start_ns or not latched:
            return
        values = LatchedValues()
        for message in self._messages(latched, None, self.start_ns):
            values.put(message)
        for value in values.values():
            send(replace(value, stamp_ns=self.start_ns))
