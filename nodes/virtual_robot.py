"""Moves the v-bot, which the operator drives in the virtual space. In REAL, it stays at the r-bot's pose."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from instant_ic import msg
from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, main
from instant_ic.config.ranges import Checked, Plausible
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits, extrapolate
from instant_ic.control.states import VbotAction
from instant_ic.control.step_times import StepTimes
from instant_ic.control.vbot import VbotConfig, VirtualRobot
from instant_ic.control.walls import WALL_PERIOD_S, WallSearch
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.util.step_gap import StepGap


@dataclass(frozen=True)
class VirtualRobotConfig(Checked):
    """Parameters of the node ``virtual_robot``.

    Attributes:
        rate_hz: steps and messages on /vbot/odom, per second.
        state_timeout_s: s; time without /ic/state after which the v-bot stands.
    """

    rate_hz: Annotated[float, Plausible(2, 200)] = 20.0
    state_timeout_s: Annotated[float, Plausible(0.05, 2)] = 0.5
    limits: MotionLimits = field(default_factory=MotionLimits)
    footprint: Footprint = field(default_factory=Footprint)
    vbot: VbotConfig = field(default_factory=VbotConfig)


class VirtualRobotNode(Node[VirtualRobotConfig]):
    """Connects ``VirtualRobot`` to topics."""

    name = "virtual_robot"
    live_parameters = ("vbot", "limits", "state_timeout_s")

    def setup(self) -> None:
        self.robot = VirtualRobot(self.config.vbot, self.config.limits, self.config.footprint)
        self.walls = WallSearch()
        self.walls.submit = self.background(self.walls.find, self.walls.on_found).submit
        self.action: VbotAction | None = None
        self.stepped_ns = self.clock.steady_ns()
        self.gap = StepGap()
        self.odom = self.publisher("/vbot/odom", msg.Odometry, qos=SENSOR)
        self.times = StepTimes()
        timeout_s = self.config.state_timeout_s
        self.state = self.latest("/ic/state", msg.ControlState, timeout_s, LATCHED, self.on_state)
        self.subscribe("/map", msg.OccupancyGrid, lambda m: self.walls.on_map(*msg.grid_array(m)), qos=LATCHED)
        self.timer(WALL_PERIOD_S, self.walls.update)
        self.timer(1.0 / self.config.rate_hz, self.on_timer)

    def reconfigure(self, config: VirtualRobotConfig) -> None:
        super().reconfigure(config)
        self.robot.config, self.robot.limits = config.vbot, config.limits
        self.state.max_age_s = config.state_timeout_s

    def on_state(self, message: msg.ControlState) -> None:
        """Obey a changed command of the lease's holder, which the arbiter reports, at once."""
        if self.action == VbotAction.DRIVEN and self.times.command_steps(msg.twist_values(message.operator_command)):
            self.tick()

    def on_timer(self) -> None:
        if self.times.timer_steps(self.clock.steady_ns()):
            self.tick()

    def tick(self) -> None:
        now_ns, steady_ns = self.clock.now_ns(), self.clock.steady_ns()
        if self.gap.step(steady_ns, self.clock.suspended_ns()):
            self.robot.velocity = (0.0, 0.0)
        # A late timer must not make the view jump.
        dt_s = min((steady_ns - self.stepped_ns) / 1e9, 0.2)
        self.stepped_ns = steady_ns
        state = self.state.fresh
        if state is None:
            self.diagnose("state", WARN, "The arbiter does not report. The v-bot stands")
            self.robot.place(self.robot.pose, (0.0, 0.0))
            if self.action is None:
                return  # there is no pose to publish yet
        else:
            self.obey(state, dt_s)
        pose = matrix_from_pose2(self.robot.pose)
        self.odom.publish(msg.odometry_message(pose, *self.robot.velocity, "map", "vbot_base_link", now_ns))

    def obey(self, state: msg.ControlState, dt_s: float) -> None:
        """Move the v-bot by the action in the arbiter's state."""
        action, before, self.action = VbotAction(state.vbot_action), self.action, VbotAction(state.vbot_action)
        robot_pose = msg.pose2_from_message(state.robot_pose)
        robot_twist = msg.twist_values(state.robot_twist)
        age_s = (self.clock.now_ns() - msg.stamp_ns(state)) / 1e9
        # The arbiter's message is up to a period old, and the r-bot has moved since.
        target = extrapolate(msg.pose2_from_message(state.vbot_target), robot_twist, age_s)
        if before is None and action != VbotAction.WITH_ROBOT:
            self.robot.place(msg.pose2_from_message(state.vbot_pose), (0.0, 0.0))  # this node was restarted
        if action == VbotAction.WITH_ROBOT:
            self.robot.place(target, robot_twist)
        elif action == VbotAction.DRIVEN:
            stood_still = self.gap.settles(self.stepped_ns)
            self.times.obeyed = (0.0, 0.0) if stood_still else msg.twist_values(state.operator_command)
            self.robot.step(self.times.obeyed, robot_pose, dt_s, self.walls.found, float(state.vbot_limit_m_s))
        elif action == VbotAction.HELD:
            self.robot.step((0.0, 0.0), robot_pose, dt_s, self.walls.found)
        elif action == VbotAction.EASED:
            self.robot.ease(target, robot_twist, dt_s)
        else:
            self.robot.lead_back(robot_pose, dt_s, self.walls.found)
        slowed = f", slowed by {self.robot.slowed_by}" if self.robot.slowed_by else ""
        self.diagnose("state", OK, action.name.lower().replace("_", " ") + slowed)


if __name__ == "__main__":
    main(VirtualRobotNode)
