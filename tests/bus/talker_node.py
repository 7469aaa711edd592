"""A node for tests that need another process."""

from dataclasses import dataclass

from instant_ic.bus import LATCHED, RELIABLE, Node, main
from instant_ic.msg import String


@dataclass(frozen=True)
class TalkerConfig:
    period_s: float = 0.02
    text: str = "hello"


class Talker(Node[TalkerConfig]):
    name = "talker"

    def setup(self) -> None:
        self.out = self.publisher("/chatter", String, RELIABLE)
        self.map = self.publisher("/greeting", String, LATCHED)
        self.map.publish(String(data=self.config.text))
        self.count = 0
        self.timer(self.config.period_s, self.tick)

    def tick(self) -> None:
        self.count += 1
        self.out.publish(String(data=f"{self.config.text} {self.count}"))


if __name__ == "__main__":
    main(Talker)
