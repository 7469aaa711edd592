"""Drives the r-bot to the subgoal while the operator drives the v-bot."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from instant_ic import msg
from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, main
from instant_ic.config.ranges import Checked, Plausible
from instant_ic.control.costmap import Costmap
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.footprint import Footprint
from instant_ic.control.kinematics import MotionLimits, extrapolate
from instant_ic.control.navigator import Navigator, moving_subgoal
from instant_ic.control.planner import HybridPlanner
from instant_ic.control.states import Mode
from instant_ic.control.warmup import warm_up
from instant_ic.util.step_gap import StepGap


@dataclass(frozen=True)
class NavigatorConfig(Checked):
    """Parameters of the node ``navigator``.

    Attributes:
        controller_frequency: commands per second.
        replan_period_s: s; time between two plans.
        subgoal_timeout_s: s; age of the subgoal above which the robot stands.
        costmap_timeout_s: s; age of the costmap above which the robot stands.
        state_timeout_s: s; age of /ic/state above which nothing is published.
    """

    controller_frequency: Annotated[float, Plausible(2, 200)] = 20.0
    replan_period_s: Annotated[float, Plausible(0.02, 10)] = 0.2
    subgoal_timeout_s: Annotated[float, Plausible(0.05, 5)] = 0.5
    costmap_timeout_s: Annotated[float, Plausible(0.05, 3)] = 1.0
    state_timeout_s: Annotated[float, Plausible(0.05, 2)] = 0.3
    limits: MotionLimits = field(default_factory=MotionLimits)
    footprint: Footprint = field(default_factory=Footprint)
    follower: FollowerConfig = field(default_factory=FollowerConfig)


PRESENT_S = 0.2
"""Period of zero commands at rest, by which the arbiter notices a restart of this node in every mode."""


class NavigatorNode(Node[NavigatorConfig]):
    """Connects ``Navigator`` to topics."""

    name = "navigator"

    live_parameters = ("replan_period_s", "limits", "follower")

    def setup(self) -> None:
        if not self.lockstep:
            warm_up()
        c = self.config
        self.navigator = self.made(c)
        self.speed = 0.0
        self.grid: tuple[Any, Any] = (None, None)  # newest costmap, as message and as converted
        self.follow_timer: Any = None  # runs while the operator drives the v-bot
        self.gap = StepGap()
        self.cmd_vel = self.publisher("/nav/cmd_vel", msg.TwistStamped, qos=SENSOR)
        self.path = self.publisher("/nav/path", msg.Path, qos=SENSOR)
        self.subgoal = self.latest("/ic/subgoal", msg.PoseStamped, c.subgoal_timeout_s)
        self.costmap = self.latest("/costmap", msg.OccupancyGrid, c.costmap_timeout_s)
        self.vbot = self.latest("/vbot/odom", msg.Odometry, 0.3)
        self.state = self.latest("/ic/state", msg.ControlState, c.state_timeout_s, qos=LATCHED, callback=self.on_state)
        self.timer(PRESENT_S, self.show_presence)

    def made(self, c: NavigatorConfig) -> Navigator:
        follower = PathFollower(c.follower, c.limits, c.footprint)
        return Navigator(HybridPlanner(c.footprint), follower, c.replan_period_s)

    def reconfigure(self, config: NavigatorConfig) -> None:
        super().reconfigure(config)
        self.navigator = self.made(config)  # which plans again at once

    def on_state(self, state: msg.ControlState) -> None:
        """Follow at the controller's rate while the operator drives the v-bot. Otherwise, rest."""
        if state.mode != Mode.VIRTUAL:
            self.rest()
        elif self.follow_timer is None:
            self.follow_timer = self.timer(1.0 / self.config.controller_frequency, self.tick)
            self.tick()

    def show_presence(self) -> None:
        if self.follow_timer is None and self.state.fresh is not None:
            self.cmd_vel.publish(msg.twist_stamped(0.0, 0.0, self.clock.now_ns()))

    def rest(self) -> None:
        if self.follow_timer is not None:
            self.follow_timer.cancel()
            self.follow_timer = None
            self.navigator.reset()
        self.gap.pause()
        self.speed = 0.0
        self.diagnose("follow", OK, "waiting: the operator drives the robot")

    def tick(self) -> None:
        state = self.state.fresh
        if state is None:
            self.rest()
            return
        now_ns = self.clock.steady_ns()
        if self.gap.step(now_ns, self.clock.suspended_ns()):
            self.navigator.reset()
        command = (0.0, 0.0) if self.gap.settles(now_ns) else self.command(state)
        self.speed = command[0]
        self.cmd_vel.publish(msg.twist_stamped(*command, self.clock.now_ns()))

    def command(self, state: msg.ControlState) -> tuple[float, float]:
        """Return the twist for the r-bot. While an input is missing, diagnose it and return zero."""
        grid, goal = self.costmap.fresh, self.subgoal.fresh
        if grid is None or goal is None:
            missing = "costmap" if grid is None else "subgoal"
            self.diagnose("follow", WARN, f"There is no recent {missing}. The robot stands.")
            return 0.0, 0.0
        age_s = (self.clock.now_ns() - msg.stamp_ns(state)) / 1e9
        pose = extrapolate(msg.pose2_from_message(state.robot_pose), msg.twist_values(state.robot_twist), age_s)
        if self.grid[0] is not grid:
            occupancy, resolution, origin = msg.grid_array(grid)
            self.grid = grid, Costmap.from_occupancy(occupancy, resolution, np.array(origin))
        shown, robot = (msg.pose2_from_message(one) for one in (state.vbot_target, state.robot_pose))
        vbot = self.vbot.fresh
        own = None if vbot is None else (msg.pose2_from_message(vbot), msg.twist_values(vbot))
        subgoal, velocity = moving_subgoal(msg.pose2_from_message(goal), own, shown, robot)
        step = self.navigator.step(pose, self.speed, subgoal, self.grid[1], self.clock.steady_ns(), velocity)
        if step.replanned and (self.path.subscriber_count or self.lockstep):
            self.path.publish(msg.path_message(step.plan.poses, "map", self.clock.now_ns()))
        self.diagnose("follow", OK if step.plan.reached else WARN, step.plan.reason or step.state, state=step.state)
        return step.command


if __name__ == "__main__":
    main(NavigatorNode)
