"""Decides which robot the operator drives, as the only publisher of /cmd_vel (paper, III.A)."""

from __future__ import annotations

from instant_ic import msg
from instant_ic.adapters.control import ArbiterInbox, command_limits, command_message, control_state
from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Latest, Node, main
from instant_ic.bus.transport import Received
from instant_ic.control.arbiter import Arbiter, Decision
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.estop import KeptEstop
from instant_ic.control.operator_view import OperatorView
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.sources import STEP_AFTER_S
from instant_ic.control.step_times import REST_COSTMAP_S, REST_STEP_S, StepTimes
from instant_ic.control.surroundings import Surroundings
from instant_ic.control.walls import WALL_PERIOD_S, WallSearch
from instant_ic.control.warmup import warm_up
from instant_ic.geometry.poses import matrix_from_pose2


class ArbiterNode(Node[ArbiterConfig]):
    """Connects ``Arbiter`` and ``Surroundings`` to topics."""

    name = "arbiter"
    live_parameters = (*("limits", "prediction", "collision_monitor", "passage", "switch", "timeouts"),)

    def setup(self) -> None:
        c = self.config
        if not self.lockstep:
            warm_up()
        self.arbiter = Arbiter(c)
        self.surroundings = Surroundings(c.costmap, c.footprint, self.tf)
        self.view = OperatorView(self.tf)
        self.walls = WallSearch()
        self.walls.submit = self.background(self.walls.find, self.walls.on_found).submit
        self.latch = KeptEstop(self.run_dir, self.clock.now_ns())
        if self.latch.pressed:
            self.log.warning("emergency stop: %s", self.latch.why or "still pressed from before this start")
        self.times = StepTimes()
        self.warn_of_protection()
        self.cmd_vel = self.publisher("/cmd_vel", msg.TwistStamped, qos=SENSOR)
        self.state = self.publisher("/ic/state", msg.ControlState, qos=LATCHED)
        self.subgoal = self.publisher("/ic/subgoal", msg.PoseStamped, qos=SENSOR)
        self.trajectory = self.publisher("/ic/trajectory", msg.Path, qos=SENSOR)
        self.costmap_out = self.publisher("/costmap", msg.OccupancyGrid, qos=SENSOR)
        sources = {
            "scan": self.latest("/scan", msg.LaserScan, 10.0),
            "odometry": self.latest("/wheel/odom", msg.Odometry, 10.0),
            "pose": self.latest("/pose", msg.PoseWithCovarianceStamped, 10.0),
            "vbot": self.latest("/vbot/odom", msg.Odometry, 10.0),
            "nav": self.latest("/nav/cmd_vel", msg.TwistStamped, 10.0),
            "command": Latest(self.clock, 10.0),
        }
        points = self.latest("/lidar/points", msg.PointCloud2, 10.0) if c.costmap.points.enabled else None
        shown = Latest(self.clock, 1.0)
        vspace = self.latest("/vspace/status", msg.VspaceStatus, 60.0, qos=LATCHED)
        # A doubt holds until the next report. A dead SLAM shows in the age of /pose.
        integrity = self.latest("/slam/integrity", msg.PoseIntegrity, float("inf"))
        self.inbox = ArbiterInbox(self.clock, self.surroundings, self.view, sources, points, shown, vspace, integrity)
        self.inbox.gate.limits = command_limits(c.timeouts)
        self.subscribe("/map", msg.OccupancyGrid, lambda m: self.walls.on_map(*msg.grid_array(m)), qos=LATCHED)
        self.subscribe_received("/operator/cmd_vel", self.on_command, qos=SENSOR, message_class=msg.TwistStamped)
        self.subscribe_received("/view/shown", self.on_shown, qos=SENSOR, message_class=msg.ShownPictures)
        self.subscribe_received("/operator/estop", self.on_estop, qos=LATCHED, message_class=msg.Bool)
        self.subscribe_received("/robot/estop", self.on_button, qos=LATCHED, message_class=msg.Bool)
        # Only the image's age matters, so it is never decoded here.
        self.subscribe_received("/camera/image/compressed", lambda r: self.view.camera_image(r.published_ns), SENSOR)
        self.timer(WALL_PERIOD_S, self.walls.update)
        self.timer(1.0 / c.costmap.update_frequency, self.update_costmap)
        self.cancel_extra = lambda: None  # cancels the extra step between two timer steps
        self.timer(1.0 / c.rate_hz, self.on_timer)

    def reconfigure(self, config: ArbiterConfig) -> None:
        self.arbiter.reconfigure(config)
        self.inbox.gate.limits = command_limits(config.timeouts)
        super().reconfigure(config)
        self.warn_of_protection()

    def warn_of_protection(self) -> None:
        """Show a warning while a protection is off."""
        if off := self.config.unprotected_by:
            text = "the robot does not stop before obstacles. Switch it on and restart with unprotected: false"
            self.diagnose("protection", WARN, f"Protection is off ({', '.join(off)}): {text}")
        else:
            self.diagnose("protection", OK, "on")

    def teardown(self) -> None:
        if hasattr(self, "cmd_vel"):
            self.cmd_vel.publish(msg.twist_stamped(0.0, 0.0, self.clock.now_ns(), msg.HARD_STOP))

    def on_estop(self, received: Received) -> None:
        """Obey a press at once, and a release only if ``EstopLatch`` permits it."""
        pressed, holder = bool(msg.deserialize(received.payload, received.type_name).data), self.inbox.lease.holder
        if refused := self.latch.hear(pressed, received.publisher, received.publish_ns, self.clock.now_ns(), holder):
            self.log.warning("emergency stop: %s", refused)
        self.step_and_save()

    def on_button(self, received: Received) -> None:
        """Obey the robot's own emergency stop. After its button is released, the operator must release the stop."""
        pressed = bool(msg.deserialize(received.payload, received.type_name).data)
        self.inbox.button_ns = received.published_ns
        self.latch.hear_button(pressed, received.publisher, received.publish_ns)
        self.step_and_save()

    def step_and_save(self) -> None:
        """Step at once, then save the emergency stop, so that it survives a restart of a node or of the machine."""
        try:
            self.tick()
        finally:  # also if the step fails
            self.diagnose_all(self.latch.save())

    def on_command(self, received: Received) -> None:
        """Take a command of the lease's holder, and step at once if the command has changed."""
        lease, before = self.inbox.lease, self.inbox.lease.holder
        taken = self.inbox.take_command(received)
        if lease.holder != before:
            self.log.info("%s", lease.diagnosis.text)
        if taken and self.times.command_steps(self.inbox.command):
            self.tick()

    def on_timer(self) -> None:
        if self.times.timer_steps(self.clock.steady_ns(), self.inbox.rests(self.arbiter.mode)):
            self.tick()

    def on_shown(self, received: Received) -> None:
        if self.inbox.take_shown(received, self.arbiter.mode):
            self.tick()

    def update_costmap(self) -> None:
        if self.times.costmap_due(self.clock.steady_ns(), self.inbox.rests(self.arbiter.mode)):
            grid = self.inbox.update_costmap(self.walls.map)
            self.diagnose_all(*self.surroundings.findings.values())
            if grid is not None:
                self.costmap_out.publish(grid)

    def tick(self) -> None:
        rests = self.inbox.rests(self.arbiter.mode)
        if self.times.begin_step(self.clock.steady_ns(), rests):
            self.update_costmap()  # so that the first command of a drive is checked against the present obstacles
        now_ns = self.clock.now_ns()
        points_every_s = REST_COSTMAP_S if rests else 0.0
        inputs = self.inbox.inputs(self.latch, self.walls.found, self.config.timeouts, points_every_s)
        self.times.obeyed = inputs.operator_command
        # The steady clock is used, so that setting the clock back does not make a stale source look fresh.
        decision = self.arbiter.step(inputs, self.clock.steady_ns())
        self.cmd_vel.publish(command_message(decision, now_ns))
        self.publish_decision(decision, inputs, now_ns)
        # Step at the next time-out if the timer may be later, so that time-outs are exact.
        self.cancel_extra()
        stale_in_s = self.arbiter.stale_in_s(inputs, self.clock.steady_ns())
        if stale_in_s < max(REST_STEP_S, 1.0 / self.config.rate_hz):
            self.cancel_extra = self.timer(stale_in_s + STEP_AFTER_S, self.tick).cancel

    def publish_decision(self, decision: Decision, inputs: ArbiterInputs, now_ns: int) -> None:
        self.state.publish(control_state(decision, inputs, now_ns))
        if decision.changed:
            self.log.info("%s: %s", decision.mode.label, decision.reason)
        self.diagnose_all(decision.diagnosis, self.inbox.lease.diagnosis, *self.surroundings.findings.values())
        if not (self.times.shown or decision.changed):
            return
        if decision.subgoal is not None:
            self.subgoal.publish(msg.pose_stamped(matrix_from_pose2(decision.subgoal.pose), "map", now_ns))
        if self.trajectory.subscriber_count or self.lockstep:
            self.trajectory.publish(msg.path_message(decision.trajectory[::4], "map", now_ns))


if __name__ == "__main__":
    main(ArbiterNode)
