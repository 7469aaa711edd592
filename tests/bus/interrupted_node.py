"""A node that is interrupted just while it holds the locks of its own bus."""

import os
import signal
import time
from dataclasses import dataclass

from instant_ic.bus import Node, main


@dataclass(frozen=True)
class InterruptedConfig:
    pass


class Interrupted(Node[InterruptedConfig]):
    name = "interrupted"

    def setup(self) -> None:
        self.timer(0.05, self.tick)

    def tick(self) -> None:
        with self._transport.read_lock:  # as inside any call of the transport
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)

    def teardown(self) -> None:
        self.log.info("left in order")


if __name__ == "__main__":
    main(Interrupted)
