"""Holds the first four large messages of /x until it is killed."""

import sys
import threading
from pathlib import Path

from local_bus import Bus, wait_for

reader = Bus(Path(sys.argv[1])).reader()
wait_for(lambda: len(reader.poll()) >= 4)
sys.stdout.write(f"holding {len(reader.received)}\n")
sys.stdout.flush()
threading.Event().wait(120)
