"""Sends large numbered messages on /x until it is killed."""

import sys
import time
from pathlib import Path

from local_bus import LARGE, Bus, numbered

out = Bus(Path(sys.argv[1])).publisher()
for i in range(1, 100_000):
    out.send(numbered(i, LARGE))
    time.sleep(0.01)
