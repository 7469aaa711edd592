"""Simulates the robot in a world: its devices with their real protocols, and ground truth for evaluation."""

from __future__ import annotations

import functools
from contextlib import ExitStack

from instant_ic.bus import ERROR, LATCHED, OK, RELIABLE, SENSOR, WARN, Node, NodeError, main
from instant_ic.lidar.capture import CaptureError
from instant_ic.msg import Bool, Float32, Odometry, PoseStamped, odometry_message, pose2_from_message
from instant_ic.sim.capture_replay import CaptureReplay
from instant_ic.sim.real_time import ACCEPTABLE_LAG_S, RealTimeLoop, SimulatedDevices, SimulatorConfig
from instant_ic.sim.simulation import Simulation
from instant_ic.sim.theta import ACCEPTABLE_DELAY_S
from instant_ic.sim.vlp16 import Vlp16Server
from instant_ic.util.jit import leave_out_blas
from instant_ic.util.pace import current
from instant_ic.util.paths import run_dir

_TRUTH_S = 1.0 / 30.0
_LATE_S = 0.2


class SimulatorNode(Node[SimulatorConfig]):
    """Runs the simulated robot with its three devices, and publishes the ground truth."""

    name = "simulator"

    def setup(self) -> None:
        """Create the world and open the devices."""
        if self.lockstep:
            raise NodeError("the simulator serves real devices in real time; use sim.Simulation in lockstep tests")
        self._open = ExitStack()
        self._published: tuple[bool | None, int] = (None, 0)
        self._skipped = 0
        leave_out_blas()
        try:
            self.simulation = Simulation(self.config, start_ns=self.clock.now_ns())
            self._devices = SimulatedDevices(self.config, self.simulation, run_dir() / "dev", self.log)
        except (ValueError, OSError, CaptureError) as error:
            raise NodeError(f"simulator: {error}") from error
        self._open.callback(self._devices.close)
        self.odom = self.publisher("/ground_truth/odom", Odometry, qos=SENSOR)
        self.contact = self.publisher("/ground_truth/contact", Bool, qos=LATCHED)
        fault = functools.partial(self.call_soon, self.callbacks.fault, "simulation")
        self._loop = RealTimeLoop(self.simulation, self._devices.scanner, fault)
        self._open.callback(self._loop.stop)
        self.late = self.publisher("/simulation/late", Float32, qos=SENSOR)
        self.subscribe("/simulation/put_down", PoseStamped, self._put_down, qos=RELIABLE)
        self.timer(_TRUTH_S, self._publish_truth)
        self.timer(_LATE_S, self._publish_late)
        self.timer(1.0, self._check)

    def teardown(self) -> None:
        if hasattr(self, "_open"):  # else the node has failed before its setup
            self._open.close()

    def _put_down(self, message: PoseStamped) -> None:
        """Put the robot down elsewhere in the world."""
        try:
            x, y, yaw = (float(v) for v in pose2_from_message(message))
            self.simulation.put_down((x, y, yaw))
        except ValueError as error:
            self.log.warning("/simulation/put_down is not used: %s", error)

    def _publish_truth(self) -> None:
        simulation, robot = self.simulation, self.simulation.robot
        if self.odom.subscriber_count:
            v, _, w = robot.twist
            stamp = self.clock.now_ns()
            self.odom.publish(odometry_message(simulation.world_from_base(), v, w, "world", "base_link", stamp))
        contact = (robot.contact, robot.contacts)
        if contact != self._published:
            if robot.contacts > self._published[1] and not robot.contact:
                # Report a contact that began and ended between two ticks too.
                self.contact.publish(Bool(data=True))
            self._published = contact
            self.contact.publish(Bool(data=robot.contact))

    def _publish_late(self) -> None:
        """Publish the devices' delay as a share of the acceptable delay. Above 1, the launcher slows the stack."""
        camera = self._devices.camera
        camera_s = camera.late_s if camera is not None else 0.0
        self.late.publish(Float32(max(self._loop.take_lag_s() / ACCEPTABLE_LAG_S, camera_s / ACCEPTABLE_DELAY_S)))

    def _check(self) -> None:
        loop, robot = self._loop, self.simulation.robot
        if (fault := loop.fault) is not None:
            text = f"the simulation has stopped ({type(fault).__name__}: {fault}): restart it"
            self.diagnose("simulation", ERROR, text)
            return
        level, text = (WARN, "the robot pushes against something") if robot.contact else (OK, "free")
        self.diagnose("contact", level, text, contacts=robot.contacts)
        paused_s = loop.take_paused_s()
        if paused_s > 0:
            self.diagnose("pace", WARN, f"the machine is too slow: the simulation paused for {paused_s:.2f} s")
        else:
            self.diagnose("pace", OK, current().text or "real time")
        self._check_devices()

    def _check_devices(self) -> None:
        scanner, camera = self._devices.scanner, self._devices.camera
        if isinstance(scanner, Vlp16Server):
            lost, self._skipped = scanner.skipped - self._skipped, scanner.skipped
            text = f"{lost} packets left out: the machine is too slow" if lost else "all packets sent"
            self.diagnose("lidar", WARN if lost else OK, text, sent=scanner.sent, left_out=scanner.skipped)
        elif isinstance(scanner, CaptureReplay):
            self.diagnose("lidar", OK, "recording runs", sent=scanner.sent)
        if camera is not None:
            rate, wanted = camera.rate_hz, self.config.camera.rate
            slow = camera.watched and 0 < rate < 0.8 * wanted
            if not camera.watched:
                text = "no client reads the preview"
            elif slow:
                text = f"{rate:.1f} of {wanted:.1f} images per second: the machine is too slow"
            else:
                text = f"{rate:.1f} images per second" if rate else "the preview starts"
            self.diagnose("camera", WARN if slow else OK, text, frames=camera.frames)


if __name__ == "__main__":
    main(SimulatorNode)
