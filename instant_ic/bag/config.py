"""Parameters of the nodes ``bag_player`` and ``bag_recorder``."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated

from instant_ic.bag.player import PlayOptions
from instant_ic.bag.recorder import RecordOptions
from instant_ic.config.ranges import NotNegative, Range


@dataclass(frozen=True)
class BagPlayerConfig(PlayOptions):
    """Parameters of ``bag_player``, in addition to those of playing.

    Attributes:
        bag: folder of the bag, or a ``.mcap``, ``.db3`` or ROS 1 ``.bag`` file.
        drop_transforms: child frames whose transforms are left out of ``/tf`` because another node broadcasts them.
        publish_clock: whether to publish ``/clock``.
        delay_s: seconds for which the time stands still at the start, so that subscribers find the topics.
        wait_for: nodes that must run, with all their subscriptions connected, before playback starts.
        force: play commands and states although a base is running, which may move the robot.
    """

    bag: str = ""
    drop_transforms: tuple[str, ...] = ()
    publish_clock: bool = True
    delay_s: NotNegative = 0.5
    wait_for: tuple[str, ...] = ()
    force: bool = False

    def __post_init__(self) -> None:
        if not self.bag:
            raise ValueError("bag must name a folder (got '')")
        super().__post_init__()


@dataclass(frozen=True)
class BagRecorderConfig(RecordOptions):
    """Parameters of ``bag_recorder``, in addition to those of writing.

    Attributes:
        path: folder of the bag, which must not exist; empty creates ``runs/bag_DATE_TIME`` in the working directory. In
            snapshot mode, the folder for the snapshots.
        topics: names or patterns of the topics to record; empty records everything.
        exclude: names or patterns of the topics to leave out.
        discovery_period_s: seconds between searches for new topics.
        duration_s: seconds after which recording ends; 0 records until stopped.
        start_paused: record only after a resume command.
        snapshot_after_s: seconds after the request that a snapshot also holds.
    """

    path: str = ""
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    discovery_period_s: Annotated[float, Range(0.01, 10.0)] = 0.2
    duration_s: NotNegative = 0.0
    start_paused: bool = False
    snapshot_after_s: NotNegative = 2.0

    def folder(self) -> Path:
        """Folder of the bag."""
        if self.path:
            return Path(self.path).expanduser()
        return Path("runs") / f"{'snapshots' if self.snapshot else 'bag'}_{datetime.now():%Y%m%d_%H%M%S}"
