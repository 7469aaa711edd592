"""A node to look at with every verb of ``ic``; also run as a user's own file by ``ic run``."""

import time
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from instant_ic.bus import LATCHED, RELIABLE, SENSOR, Node, main
from instant_ic.config.ranges import Checked, Positive, Range
from instant_ic.msg import Bool, LaserScan, String, TwistStamped, scan_message, twist_stamped


@dataclass(frozen=True)
class Inner(Checked):
    """Group.

    Attributes:
        depth: how deep.
        share: how much of it.
    """

    depth: int = 3
    share: Annotated[float, Range(0, 1)] = 0.5


@dataclass(frozen=True)
class TalkerConfig(Checked):
    """Parameters.

    Attributes:
        rate_hz: scans a second.
        label: a word.
        late_s: how old the stamps are.
        drives: whether it commands the robot.
        sleep_s: how long its callback of /sleep takes.
        inner: group.
    """

    rate_hz: Positive = 50.0
    label: str = "hello"
    late_s: float = 0.25
    drives: bool = False
    sleep_s: float = 3.0
    inner: Inner = field(default_factory=Inner)


class Talker(Node[TalkerConfig]):
    """Publishes what the tests look for, and repeats what it hears on /order."""

    name = "talker"
    live_parameters = ("label", "late_s", "inner.share")

    def setup(self) -> None:
        self.scans = self.publisher("/scan", LaserScan, qos=SENSOR)
        self.flag = self.publisher("/flag", Bool, qos=LATCHED)
        self.flag.publish(Bool(data=True))
        self.heard = self.publisher("/heard", String, qos=RELIABLE)
        if self.config.drives:
            self.drive = self.publisher("/cmd_vel", TwistStamped, qos=SENSOR)
            self.timer(0.1, lambda: self.drive.publish(twist_stamped(0.0, 0.0, self.clock.now_ns())))
        self.subscribe("/order", TwistStamped, self.on_order, qos=RELIABLE)
        self.subscribe("/sleep", Bool, lambda _: time.sleep(self.config.sleep_s), qos=RELIABLE)
        self.timer(1 / self.config.rate_hz, self.tick)

    def on_order(self, message: TwistStamped) -> None:
        self.log.debug("order")
        self.log.warning("ordered %s", message.twist.linear.x)
        self.heard.publish(String(data=f"{message.twist.linear.x} {message.header.frame_id}{message.header.stamp.sec}"))

    def tick(self) -> None:
        ranges = np.arange(40, dtype=np.float32)
        stamp = self.clock.now_ns() - int(self.config.late_s * 1e9)
        self.scans.publish(scan_message(ranges, -1.0, 0.05, 0.1, 30.0, self.config.label, stamp))


if __name__ == "__main__":
    main(Talker)
