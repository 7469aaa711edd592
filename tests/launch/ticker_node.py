"""A node for the launcher's tests: sends a word ten times a second."""

from dataclasses import dataclass

from instant_ic.bus import SENSOR, Node, main
from instant_ic.msg import String


@dataclass(frozen=True)
class TickerConfig:
    pass


class Ticker(Node[TickerConfig]):
    name = "ticker"

    def setup(self) -> None:
        self.out = self.publisher("/chatter", String, qos=SENSOR)
        self.timer(0.1, lambda: self.out.publish(String(data="tick")))


if __name__ == "__main__":
    main(Ticker)
