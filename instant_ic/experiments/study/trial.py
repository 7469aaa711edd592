"""One drive of a participant: the stack of its condition, its bag, and the measures from that bag."""

from __future__ import annotations

import functools
import json
import logging
import math
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from instant_ic.bag import BagReader
from instant_ic.bag.mcap_writer import McapWriter
from instant_ic.bag.metadata import channel_metadata, own_schema
from instant_ic.bag.recover import reindex
from instant_ic.bus import LATCHED, RELIABLE
from instant_ic.experiments import teleop_figures
from instant_ic.experiments.recorded_drive import as_log
from instant_ic.experiments.stack import Stack, free_ports
from instant_ic.experiments.study.plan import Study, StudyError, save
from instant_ic.msg import ControlState, String, VspaceStatus, pose2_from_message, serialize, stamp_ns, twist_values
from instant_ic.util.private import make_folder

READY_S = 240.0
"""Longest start of a stack, seconds of its own time."""
STOP_S = 60.0
STATE, EVENTS, CONTACT, SCAN = "/ic/state", "/study/event", "/ground_truth/contact", "/scan"
ANSWERS = "/study/answers"
AHEAD_RAD = math.radians(3.0)
"""Half the sector whose median range is the distance ahead."""
ARBITERS = {name: Path(__file__).with_name(f"arbiter_{name}.py") for name in ("stop", "shared")}
log = logging.getLogger("instant_ic.study")


def scan_of(study: Study, world: str) -> Path:
    """File of the scan of a world, for the condition ``mesh``."""
    return study.folder / "scans" / f"{''.join(c if c.isalnum() else '_' for c in world)}.glb"


def make_scans(study: Study, code: str) -> None:
    """Check a participant's worlds, and scan those driven by a scan: as ``ic experiment operators``, without obstacles.

    Raises:
        StudyError: a world does not exist or has no obstacle course.
    """
    from instant_ic.experiments.illusion_truth import without
    from instant_ic.experiments.scan import QUALITIES, scan_world
    from instant_ic.experiments.teleop_worlds import straight_ahead
    from instant_ic.sim.worlds import make_world

    drives = zip((*study.worlds, study.practice_world), (*study.participants[code], ""), strict=True)
    for number, (world, method) in enumerate(drives):
        file = scan_of(study, world)
        try:
            made = make_world(world)
            if method != "mesh" or file.exists():
                continue
            course = straight_ahead(made)
            free = functools.reduce(without, course.obstacles, course.world)
            make_folder(file.parent, exist_ok=True)
            beside = file.with_suffix(".part")
            scan_world(free, course.world.spawn, QUALITIES["tripod"], study.seed + number, beside)
            beside.replace(file)
        except ValueError as error:
            raise StudyError(f"{study.folder / 'study.yaml'}: world {world}: {error}") from None


@dataclass(frozen=True)
class Drive:
    """A drive to make; ``number`` 0 is the practice."""

    study: Study
    code: str
    number: int

    @property
    def method(self) -> str:
        return "stop" if self.number == 0 else self.study.participants[self.code][self.number - 1]

    @property
    def limit_s(self) -> float:
        return self.study.limit_s if self.number else self.study.practice_s

    def arguments(self, bag: Path, run_dir: Path) -> dict[str, Any]:
        """Arguments of ``launch/sim.yaml``."""
        study = self.study
        world = study.worlds[self.number - 1] if self.number else study.practice_world
        start_x_m = study.start_x_m(self.code, self.number) if self.number else 0.0
        params = run_dir / "study.yaml"
        start = {"simulator": {"ros__parameters": {"start": [start_x_m, 0.0, 0.0]}}}
        save(params, yaml.safe_dump(start))
        found = {**study.arguments, **free_ports(), "world": world, "record": bag.absolute(), "recorder": False}
        found |= {"seed": study.seed + self.number, "params": params}
        if self.method in ARBITERS:
            found["arbiter"] = ARBITERS[self.method]
        if self.method == "mesh":
            file = scan_of(study, world).absolute()
            # The map's origin is the robot's start; the scan has the world's.
            found |= {"vspace_source": "mesh", "vspace_mesh": file, "vspace_mesh_pose": f"{-start_x_m},0,0,0"}
        return found


class Trial:
    """A drive on its own thread, from the stack's start to the measures.

    Attributes:
        status: ``starting``, ``ready``, ``saving``, ``done`` or ``failed``.
        console: address of the stack's page while ``ready``; empty before.
        result: measures, once ``done``.
        pace: seconds of the stack per second of the machine.
    """

    def __init__(self, drive: Drive, bag: Path) -> None:
        self.drive, self.bag = drive, bag
        self.status, self.console = "starting", ""
        self.result: dict[str, Any] = {}
        self.pace = 1.0
        self._end = threading.Event()
        self._why = "participant"
        self._thread = threading.Thread(target=self._guarded, name="drive", daemon=True)
        self._thread.start()

    def end(self, why: str = "participant", wait_s: float = 0.0) -> None:
        """End the drive; with ``wait_s`` wait until its stack has stopped."""
        if not self._end.is_set():
            self._why = why
        self._end.set()
        if wait_s:
            self._thread.join(wait_s)

    def _guarded(self) -> None:
        run_dir = Path(tempfile.mkdtemp(prefix="ic-s-"))
        try:
            self._run(run_dir)
            self.status = "done"
        except Exception:
            log.exception("drive %d of %s failed", self.drive.number, self.drive.code)
            self.status = "failed"
        finally:
            shutil.rmtree(run_dir, ignore_errors=True)

    def _run(self, run_dir: Path) -> None:
        arguments = self.drive.arguments(self.bag, run_dir)
        slowest, reached_s = math.inf, 0.0
        with Stack("sim.yaml", run_dir, arguments, pace=None) as stack:
            events = stack.observer.publisher(EVENTS, String, qos=LATCHED)
            spaces = stack.collect("/vspace/status", VspaceStatus, LATCHED)
            states = stack.collect(STATE, ControlState, RELIABLE)
            without_space = arguments.get("vspace") is False

            def ready() -> bool:
                space = without_space or any(one.state == one.READY for one in spaces[-1:])
                return self._end.is_set() or (space and bool(states) and states[-1].mode == ControlState.REAL)

            def note(event: str) -> int:
                """Publish an event with the newest state's stamp: the observer's clock knows no slow motion."""
                at_ns = stamp_ns(states[-1]) if states else time.time_ns()
                events.publish_bytes(serialize(String(data=event)), at_ns)
                return at_ns

            stack.wait_for(ready, READY_S, "robot that is ready to drive")
            self.console = f"http://127.0.0.1:{arguments['console_port']}"
            self.status = "ready"
            began_ns = note("begin")
            while not self._end.wait(0.01):
                stack.observer.spin_once()
                stack.check_alive("the end of the drive")
                self.pace = stack.pace
                slowest = min(slowest, self.pace)
                passed_s = (stamp_ns(states[-1]) - began_ns) / 1e9
                if passed_s > self.drive.limit_s:
                    self.end("limit")
                reached_s = passed_s if not self._arrived(states[-1]) else reached_s
                if passed_s - reached_s > 1.0:
                    self.end("arrived")
            self.status = "saving"
            note(self._why)
            time.sleep(0.3)  # for the recorder to take the event
            stack.stop(STOP_S)
        self.result = {"end": self._why, "slowest_pace": slowest, "bag": self.bag.name}
        if self.drive.number:
            self.result |= measures(self.bag)

    def _arrived(self, state: Any) -> bool:
        """Whether the r-bot has driven far enough, and is the robot shown."""
        x, _, _ = pose2_from_message(state.robot_pose)
        return bool(self.drive.number and state.mode == ControlState.REAL and x >= self.drive.study.goal_m)


def add_answers(bag: Path, step: str, answers: dict[str, Any]) -> None:
    """Add the answers after a drive to its bag: one message, as JSON, in a file of its own.

    Raises:
        OSError, BagError: it cannot be written; the drive's own messages stay as they are.
    """
    file = McapWriter(bag / f"{bag.name}_{step}.mcap")
    schema = own_schema(String.__msgtype__)
    channel = file.add_channel(ANSWERS, file.add_schema(schema), channel_metadata(LATCHED))
    text = json.dumps({"questionnaire": step, "answers": answers}, ensure_ascii=False)
    file.write(channel, time.time_ns(), serialize(String(data=text)))
    if (full := file.finish()) is not None:
        raise full
    reindex(bag)


def measures(bag: Path) -> dict[str, Any]:
    """Measures of a recorded drive, from its first command to its end.

    Returns:
        ``time_s``; ``driven_m`` of the shown robot; ``obedience`` and ``longest_stall_s`` as in
        :mod:`~instant_ic.experiments.teleop_figures`; ``switches`` into the virtual space; ``virtual_s`` in it;
        ``contacts``; ``ahead_m``: free distance ahead of the r-bot at the end, None if unknown or another robot is
        shown. Only ``contacts`` without a command.

    Raises:
        BagError: the bag cannot be read.
    """
    with BagReader(bag) as reader:
        decoders = {
            one.topic: reader.decoder(one) for one in reader.topics if one.topic in (STATE, EVENTS, CONTACT, SCAN)
        }
        rows = [(one.topic, one.stamp_ns, decoders[one.topic](one.payload)) for one in reader.messages([*decoders])]
    ends = [at for topic, at, message in rows if topic == EVENTS and message.data != "begin"]
    end_ns = ends[-1] if ends else rows[-1][1] if rows else 0
    rows = [row for row in rows if row[1] <= end_ns]
    touching = [bool(message.data) for topic, _, message in rows if topic == CONTACT]
    found: dict[str, Any] = {
        "contacts": sum(now and not was for was, now in zip([False, *touching], touching, strict=False))
    }
    states = [message for topic, _, message in rows if topic == STATE]
    commanded = [n for n, one in enumerate(states) if any(twist_values(one.operator_command))]
    if not commanded or len(states) - commanded[0] < 3:
        return found
    driven = states[commanded[0] :]
    drive = as_log([((stamp_ns(one) - stamp_ns(driven[0])) / 1e9, one) for one in driven])
    steps = np.diff(teleop_figures.shown_poses(drive)[:, :2], axis=0)
    virtual = np.array(drive.virtual)
    lengths = np.linalg.norm(steps, axis=1) * (virtual[1:] == virtual[:-1])
    scans = [message for topic, _, message in rows if topic == SCAN]
    return found | {
        "time_s": drive.time_s[-1],
        "driven_m": float(lengths.sum()),
        "obedience": teleop_figures.obedience(drive),
        "longest_stall_s": teleop_figures.longest_stall_s(drive),
        "switches": int((virtual[1:] & ~virtual[:-1]).sum()),
        "virtual_s": float(virtual.sum()) * teleop_figures.STEP_S,
        "ahead_m": ahead_m(scans[-1]) if scans and not drive.virtual[-1] else None,
    }


def ahead_m(scan: Any) -> float | None:
    """Median range straight ahead in a LaserScan; None if nothing was hit."""
    ranges = np.asarray(scan.ranges, np.float64)
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    seen = ranges[(np.abs(np.angle(np.exp(1j * angles))) < AHEAD_RAD) & np.isfinite(ranges) & (ranges > 0)]
    return float(np.median(seen)) if seen.size else None
