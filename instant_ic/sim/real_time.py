"""The simulation in real time with its devices on their real protocols."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from instant_ic.sim.capture_replay import CaptureReplay
from instant_ic.sim.roboclaw import RoboClawServer
from instant_ic.sim.simulation import Simulation, SimulationConfig
from instant_ic.sim.theta import ThetaServer, panorama_file
from instant_ic.sim.vlp16 import Vlp16Server
from instant_ic.util.pace import current

SERIAL_LINK = "roboclaw"
"""Name of the link to the motor controller's pseudo-terminal."""
_STEP_S = 0.01
_MAX_WAIT_S = 0.3
"""Longest wait for a running step at shutdown."""
_MAX_LAG_S = 0.25
"""Longest lag that the simulation catches up after a stall; it pauses for the rest."""
ACCEPTABLE_LAG_S = 0.15
"""Largest lag of the simulation at which the stack works as on a fast machine."""
_VISIBLE_MOTION = 1e-4
"""Smallest motion that is rendered, metres and radians: a thirtieth of a pixel of the largest preview, 0.5 m ahead."""


@dataclass(frozen=True)
class SimulatorConfig(SimulationConfig):
    """Parameters of the node ``simulator``: the simulation and its devices.

    Attributes:
        panorama: image file that the camera shows instead of the world; empty: the world.
        pcap: VLP-16 recording that is sent repeatedly instead of simulated packets; empty: simulated packets.
    """

    panorama: str = ""
    pcap: str = ""


class SimulatedDevices:
    """The enabled devices of a simulation, open until ``close``.

    Args:
        simulation: robot and world.
        serial_folder: folder of the link to the motor controller's pseudo-terminal.
        log: log for the devices' addresses.

    Raises:
        ValueError, OSError, CaptureError: a device cannot be opened.
    """

    def __init__(
        self, config: SimulatorConfig, simulation: Simulation, serial_folder: Path, log: logging.Logger
    ) -> None:
        self.scanner: Vlp16Server | CaptureReplay | None = None
        self.camera: ThetaServer | None = None
        self._base: RoboClawServer | None = None
        self._simulation = simulation
        self._seen: npt.NDArray[np.uint8] = np.empty((0, 0, 3), np.uint8)
        self._seen_from = simulation.robot.pose
        try:
            self._open(config, serial_folder, log)
        except BaseException:
            self.close()
            raise

    def _open(self, config: SimulatorConfig, serial_folder: Path, log: logging.Logger) -> None:
        simulation, lidar = self._simulation, config.lidar
        if lidar.enabled and config.pcap:
            path = Path(config.pcap).expanduser()
            self.scanner = CaptureReplay(path, lidar.host, lidar.data_port, lidar.position_port)
        elif lidar.enabled:
            self.scanner = Vlp16Server(simulation.scanner)
        if config.camera.enabled:
            if not config.panorama:
                self._see(config.camera.width, config.camera.height)  # compiles the kernels before the clock starts
            source = panorama_file(Path(config.panorama).expanduser()) if config.panorama else self._see
            self.camera = ThetaServer(config.camera, source, config.seed)
            log.info("Theta Web API on http://%s:%d", config.camera.host, self.camera.port)
        if config.base.enabled:
            link = serial_folder / SERIAL_LINK
            self._base = RoboClawServer(simulation.controller, simulation.lock, link)
            log.info("RoboClaw on %s (%s)", link, self._base.device)

    def close(self) -> None:
        for device in (self._base, self.camera, self.scanner):
            if device is not None:
                device.close()

    def _see(self, width: int, height: int) -> npt.NDArray[np.uint8]:
        """Return the camera's view, rendered again only if the robot has moved visibly."""
        pose, rgb = self._simulation.robot.pose, self._seen
        if rgb.shape != (height, width, 3) or np.abs(pose - self._seen_from).max() > _VISIBLE_MOTION:
            self._seen, self._seen_from = self._simulation.panorama(width, height).rgb, pose
        return self._seen


class RealTimeLoop:
    """A thread that keeps simulated time at the stack's time.

    Args:
        simulation: simulation to step.
        scanner: scanner whose complete packets are sent after each step; None: no scanner.
        on_fault: function called on the thread when a step fails and the loop has ended.

    Attributes:
        fault: the error that ended the loop; None while it runs.
    """

    def __init__(
        self,
        simulation: Simulation,
        scanner: Vlp16Server | CaptureReplay | None,
        on_fault: Callable[[Exception], None],
    ) -> None:
        self.fault: Exception | None = None
        self._simulation, self._scanner, self._on_fault = simulation, scanner, on_fault
        self._paused_s = self._lag_s = 0.0
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulation", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the loop, waiting at most 0.3 s for a running step."""
        self._stopped.set()
        self._thread.join(_MAX_WAIT_S)

    def take_paused_s(self) -> float:
        """Return the seconds for which stalls of the machine have paused the simulation since the last call."""
        paused, self._paused_s = self._paused_s, 0.0
        return paused

    def take_lag_s(self) -> float:
        """Return the largest lag behind the stack's time since the last call."""
        lag, self._lag_s = self._lag_s, 0.0
        return lag

    def _run(self) -> None:
        simulation, pace = self._simulation, current()
        offset = pace.steady_s() - simulation.time_s
        simulation.start_ns = pace.now_ns() - round(simulation.time_s * 1e9)
        try:
            while not self._stopped.is_set():
                lag = pace.steady_s() - offset - simulation.time_s
                if lag < _STEP_S:
                    pace.sleep(_STEP_S - lag)
                    continue
                self._lag_s = max(self._lag_s, lag)
                if lag > _MAX_LAG_S:
                    # The machine stalled. Robot and devices pause instead of catching up.
                    self._paused_s += lag - _MAX_LAG_S
                    offset += lag - _MAX_LAG_S
                    simulation.start_ns += round((lag - _MAX_LAG_S) * 1e9)
                    lag = _MAX_LAG_S
                simulation.step(lag)
                if self._scanner is not None:
                    self._scanner.pump(simulation.time_s)
        except Exception as error:  # noqa: BLE001 - a thread's fault must reach the diagnostics
            self.fault = error
            self._on_fault(error)
