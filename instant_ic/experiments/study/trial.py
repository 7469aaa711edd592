"""One drive of a participant: the stack of its condition, its bag, and the measures from that bag."""

from __future__ import annotations

import logging
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bag import BagReader
from instant_ic.bus import LATCHED, RELIABLE
from instant_ic.experiments import teleop_figures
from instant_ic.experiments.recorded_drive import as_log
from instant_ic.experiments.stack import Stack, free_ports
from instant_ic.experiments.study.plan import StudyError, StudyPlan
from instant_ic.msg import ControlState, VspaceStatus, pose2_from_message, stamp_ns, twist_values
from instant_ic.util.private import make_folder

READY_S = 240.0
"""Longest start of a stack, seconds of its own time."""
STOP_S = 60.0
STATE, CONTACT = "/ic/state", "/ground_truth/contact"
log = logging.getLogger("instant_ic.study")


def make_scan(folder: Path, world: str, seed: int) -> Path:
    """Return the scan of a world without its obstacles, for the condition ``mesh``; scan the world if necessary.

    Raises:
        StudyError: there is no such world, or it has no course straight ahead.
    """
    from instant_ic.experiments.scan import ScanQuality, scan_world
    from instant_ic.experiments.teleop_worlds import straight_ahead
    from instant_ic.experiments.worlds import named_world

    file = folder / "scans" / f"{''.join(c if c.isalnum() else '_' for c in world)}.glb"
    if file.exists():
        return file
    try:
        course = straight_ahead(named_world(world))
        make_folder(file.parent, exist_ok=True)
        beside = file.with_suffix(".part")
        scan_world(course.free_world, course.world.spawn, ScanQuality(), seed, beside, course.world.spawn)
    except ValueError as error:
        raise StudyError(f"{folder / 'study.yaml'}: world {world}: {error}") from None
    beside.replace(file)
    return file


def arguments(folder: Path, plan: StudyPlan, number: int, condition: str, bag: Path) -> dict[str, Any]:
    """Return the arguments of ``launch/sim.yaml`` for drive ``number``, from 0."""
    world = plan.worlds[number]
    found = {**free_ports(), "world": world, "record": bag.absolute(), "recorder": False, "seed": plan.seed + number}
    if condition == "mesh":
        found |= {"vspace_source": "mesh", "vspace_mesh": make_scan(folder, world, plan.seed).absolute()}
    elif condition == "stop":
        found["vspace"] = False
    return found


class Trial:
    """A drive on its own thread, from the stack's start to the measures.

    Attributes:
        status: ``starting``, ``ready``, ``saving``, ``done`` or ``failed``.
        console: address of the operator's page while ``ready``; empty before.
        result: measures, once ``done``.
    """

    def __init__(self, given: dict[str, Any], goal_m: float, limit_s: float) -> None:
        self.status, self.console = "starting", ""
        self.result: dict[str, Any] = {}
        self._given, self._goal_m, self._limit_s = given, goal_m, limit_s
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._guarded, name="drive", daemon=True)
        self._thread.start()

    def end(self, wait_s: float = 0.0) -> None:
        """End the drive; wait up to ``wait_s`` seconds until its stack has stopped."""
        self._end.set()
        self._thread.join(wait_s)

    def _guarded(self) -> None:
        run_dir = Path(tempfile.mkdtemp(prefix="ic-s-"))
        try:
            why = self._drive(run_dir)
            self.result = {"end": why, "bag": self._given["record"].name, **measures(self._given["record"])}
            self.status = "done"
        except Exception:
            log.exception("the drive failed")
            self.status = "failed"
        finally:
            shutil.rmtree(run_dir, ignore_errors=True)

    def _drive(self, run_dir: Path) -> str:
        """Run the stack until the goal, the time limit or ``end``; return which."""
        with Stack("sim.yaml", run_dir, self._given, pace=None) as stack:
            spaces = stack.collect("/vspace/status", VspaceStatus, LATCHED)
            states = stack.collect(STATE, ControlState, RELIABLE)

            def ready() -> bool:
                space = self._given.get("vspace") is False or any(one.state == one.READY for one in spaces[-1:])
                return self._end.is_set() or (space and bool(states) and states[-1].mode == ControlState.REAL)

            stack.wait_for(ready, READY_S, "robot that is ready to drive")
            self.console = f"http://127.0.0.1:{self._given['console_port']}/"
            self.status, why = "ready", "participant"
            began_ns = stamp_ns(states[-1]) if states else 0
            while not self._end.wait(0.01):
                stack.observer.spin_once()
                stack.check_alive("the end of the drive")
                newest = states[-1]
                if newest.mode == ControlState.REAL and pose2_from_message(newest.robot_pose)[0] >= self._goal_m:
                    why = "arrived"
                    break
                if (stamp_ns(newest) - began_ns) / 1e9 > self._limit_s:
                    why = "limit"
                    break
            self.status = "saving"
            stack.stop(STOP_S)
        return why


def measures(bag: Path) -> dict[str, Any]:
    """Return the measures of a recorded drive, from its first command to its last.

    Returns:
        ``contacts``; and with a command ``time_s``, ``driven_m`` of the shown robot, and ``obedience`` as in
        :mod:`~instant_ic.experiments.teleop_figures`.

    Raises:
        BagError: the bag cannot be read.
    """
    with BagReader(bag) as reader:
        decoders = {one.topic: reader.decoder(one) for one in reader.topics if one.topic in (STATE, CONTACT)}
        rows = [(one.topic, decoders[one.topic](one.payload)) for one in reader.messages([*decoders])]
    touching = [bool(message.data) for topic, message in rows if topic == CONTACT]
    contacts = sum(now and not was for was, now in zip([False, *touching], touching, strict=False))
    states = [message for topic, message in rows if topic == STATE]
    commanded = [n for n, one in enumerate(states) if any(twist_values(one.operator_command))]
    if not commanded or commanded[-1] - commanded[0] < 2:
        return {"contacts": contacts}
    driven = states[commanded[0] : commanded[-1] + 1]
    drive = as_log([((stamp_ns(one) - stamp_ns(driven[0])) / 1e9, one) for one in driven])
    virtual = np.array(drive.virtual)
    lengths = np.linalg.norm(np.diff(teleop_figures.shown_poses(drive)[:, :2], axis=0), axis=1)
    return {
        "contacts": contacts,
        "time_s": drive.time_s[-1],
        "driven_m": float((lengths * (virtual[1:] == virtual[:-1])).sum()),
        "obedience": teleop_figures.obedience(drive),
    }
