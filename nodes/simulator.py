"""Simulated robot in a simulated world: its devices with their real protocols, and ground truth for evaluation."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.lidar.capture import CaptureError
from instant_ic.msg import Bool, Odometry, odometry_message
from instant_ic.pace import current
from instant_ic.paths import run_dir
from instant_ic.sim.capture_replay import CaptureReplay
from instant_ic.sim.roboclaw import RoboClawServer
from instant_ic.sim.simulation import Simulation, SimulationConfig
from instant_ic.sim.theta import ThetaServer, panorama_file
from instant_ic.sim.vlp16 import Vlp16Server

_STEP_S = 0.01
_TRUTH_S = 1.0 / 30.0
#: Longest wait for a running step at shutdown.
_MOST_WAIT_S = 0.3
#: Most simulated time to catch up on at once after a stall.
_MOST_BEHIND_S = 0.25


@dataclass(frozen=True)
class SimulatorConfig(SimulationConfig):
    """Parameters.

    Attributes:
        panorama: image file that the camera shows instead of the world; empty: the world.
        pcap: VLP-16 recording to send instead of simulated packets; empty: the world.
        pcap_loop: whether to restart the recording at its end.
    """

    panorama: str = ""
    pcap: str = ""
    pcap_loop: bool = True


class SimulatorNode(Node[SimulatorConfig]):
    """One process with the robot, its three devices and the ground truth."""

    name = "simulator"

    def setup(self) -> None:
        """Create the world and open the devices."""
        if self.lockstep:
            raise NodeError("the simulator serves real devices in real time; use sim.Simulation in lockstep tests")
        config = self.config
        self._thread: threading.Thread | None = None
        self._devices: list[Any] = []
        self._stopped = threading.Event()
        self._behind_s = 0.0
        self._fault = ""
        self._told: tuple[bool | None, int] = (None, 0)
        self._skipped = 0
        try:
            self.simulation = Simulation(config, start_ns=self.clock.now_ns())
            self._warm_up()
            self._open_devices()
        except (ValueError, OSError, CaptureError) as error:
            raise NodeError(f"simulator: {error}") from error
        self.odom = self.publisher("/ground_truth/odom", Odometry, qos=SENSOR)
        self.contact = self.publisher("/ground_truth/contact", Bool, qos=LATCHED)
        self._thread = threading.Thread(target=self._run, name="simulation", daemon=True)
        self._thread.start()
        self.timer(_TRUTH_S, self._tell_truth)
        self.timer(1.0, self._check)

    def teardown(self) -> None:
        if not hasattr(self, "_stopped"):  # the node failed before its setup
            return
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(_MOST_WAIT_S)
        for device in reversed(self._devices):
            device.close()

    def _warm_up(self) -> None:
        # Compiles on first use: do it before the clock starts, not at the first image.
        if self.config.camera.enabled and not self.config.panorama:
            self.simulation.panorama(self.config.camera.width, self.config.camera.height)

    def _open_devices(self) -> None:
        config, simulation = self.config, self.simulation
        self.scanner: Vlp16Server | CaptureReplay | None = None
        self.camera: ThetaServer | None = None
        if config.lidar.enabled:
            lidar = config.lidar
            if config.pcap:
                path = Path(config.pcap).expanduser()
                self.scanner = CaptureReplay(path, lidar.host, lidar.data_port, lidar.position_port, config.pcap_loop)
            else:
                self.scanner = Vlp16Server(simulation.scanner)
            self._devices.append(self.scanner)
        if config.camera.enabled:
            source = panorama_file(Path(config.panorama).expanduser()) if config.panorama else self._see
            self.camera = ThetaServer(config.camera, source, config.seed)
            self._devices.append(self.camera)
            self.log.info("Theta Web API on http://%s:%d", config.camera.host, self.camera.port)
        if config.base.enabled:
            link = run_dir() / "dev" / config.base.link
            controller = RoboClawServer(simulation.controller, simulation.lock, link)
            self._devices.append(controller)
            self.log.info("RoboClaw on %s (%s)", link, controller.device)

    def _see(self, width: int, height: int) -> npt.NDArray[np.uint8]:
        return self.simulation.panorama(width, height).rgb

    def _run(self) -> None:
        """Keep simulated time at the stack's time (own thread)."""
        simulation, pace = self.simulation, current()
        offset = pace.steady_s() - simulation.time_s
        simulation.start_ns = pace.now_ns() - round(simulation.time_s * 1e9)
        try:
            while not self._stopped.is_set():
                wanted = pace.steady_s() - offset
                lag = wanted - simulation.time_s
                if lag < _STEP_S:
                    pace.sleep(_STEP_S - lag)
                    continue
                if lag > _MOST_BEHIND_S:
                    # The machine stalled: the robot stands too, and the devices pause instead of catching up.
                    self._behind_s += lag - _MOST_BEHIND_S
                    offset += lag - _MOST_BEHIND_S
                    simulation.start_ns += round((lag - _MOST_BEHIND_S) * 1e9)
                    lag = _MOST_BEHIND_S
                simulation.step(lag)
                if self.scanner is not None:
                    self.scanner.pump(simulation.time_s)
        except Exception as error:  # noqa: BLE001 - a thread's fault must reach the diagnostics
            self._fault = f"{type(error).__name__}: {error}"
            self.call_soon(self.fault, "simulation", error)

    def _tell_truth(self) -> None:
        simulation, robot = self.simulation, self.simulation.robot
        if self.odom.subscriber_count:
            v, _, w = robot.twist
            stamp = self.clock.now_ns()
            self.odom.publish(odometry_message(simulation.world_from_base(), v, w, "world", "base_link", stamp))
        told = (robot.contact, robot.contacts)
        if told != self._told:
            if robot.contacts > self._told[1] and not robot.contact:
                # The contact began and ended between two ticks: report it too.
                self.contact.publish(Bool(data=True))
            self._told = told
            self.contact.publish(Bool(data=robot.contact))

    def _check(self) -> None:
        robot, config = self.simulation.robot, self.config
        if self._fault:
            self.diagnose("simulation", ERROR, f"the simulation stopped: {self._fault}; restart it")
            return
        level, text = (WARN, "the robot pushes against something") if robot.contact else (OK, "free")
        self.diagnose("contact", level, text, contacts=robot.contacts)
        behind, self._behind_s = self._behind_s, 0.0
        if behind > 0:
            self.diagnose("pace", WARN, f"the machine is too slow: the simulation paused for {behind:.2f} s")
        else:
            self.diagnose("pace", OK, "real time" if current().real else f"{current().factor:g} of real time")
        if isinstance(self.scanner, Vlp16Server):
            lost, self._skipped = self.scanner.skipped - self._skipped, self.scanner.skipped
            level, text = (
                (WARN, f"{lost} packets left out: the machine is too slow") if lost else (OK, "all packets sent")
            )
            self.diagnose("lidar", level, text, sent=self.scanner.sent, left_out=self.scanner.skipped)
        elif isinstance(self.scanner, CaptureReplay):
            done = "the recording has ended" if self.scanner.finished else "recording runs"
            self.diagnose("lidar", OK, done, sent=self.scanner.sent)
        if self.camera is not None:
            rate, wanted = self.camera.rate_hz, config.camera.rate
            if not self.camera.watched:
                self.diagnose("camera", OK, "no client reads the preview", frames=self.camera.frames)
            elif 0 < rate < 0.8 * wanted:
                text = f"{rate:.1f} of {wanted:.1f} images per second: the machine is too slow"
                self.diagnose("camera", WARN, text, frames=self.camera.frames)
            else:
                text = f"{rate:.1f} images per second" if rate else "the preview starts"
                self.diagnose("camera", OK, text, frames=self.camera.frames)


if __name__ == "__main__":
    main(SimulatorNode)
