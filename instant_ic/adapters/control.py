"""Conversion between messages of the control topics and the plain values of ``instant_ic.control``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import Latest
from instant_ic.bus.clock import Clock
from instant_ic.bus.transport import Received
from instant_ic.control.arbiter import STANDS_M_S, STANDS_RAD_S, Decision
from instant_ic.control.command_gate import CommandGate, GateLimits
from instant_ic.control.estop import KeptEstop
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.interruptions import WATCHED
from instant_ic.control.kinematics import extrapolate
from instant_ic.control.operator_view import OperatorView, PageReport
from instant_ic.control.robot_lease import LEASE_S, RELEASED, Lease
from instant_ic.control.snapshot import NO_MOTION, ArbiterInputs, Vspace
from instant_ic.control.states import Mode
from instant_ic.control.surroundings import ArrivedCloud, ArrivedScan, Surroundings
from instant_ic.control.walls import StaticMap, WallMap
from instant_ic.msg import (
    HARD_STOP,
    ControlState,
    MessageError,
    Odometry,
    PoseIntegrity,
    ShownPictures,
    TwistStamped,
    VspaceStatus,
    cloud_array,
    deserialize,
    grid_message,
    header,
    matrix_from_pose,
    pose2_from_message,
    pose2_message,
    stamp_ns,
    twist_message,
    twist_stamped,
    twist_values,
)
from instant_ic.util.contradiction import Contradiction


@dataclass
class ArbiterInbox:
    """Newest messages of the arbiter's topics, from which the inputs of its step are made."""

    clock: Clock
    surroundings: Surroundings
    view: OperatorView
    sources: dict[str, Latest]
    """Newest messages by source: scan, odometry, pose, vbot, nav and command."""
    points: Latest | None
    """Newest 3D points; None if they are not used."""
    shown: Latest
    vspace: Latest
    integrity: Latest | None = None
    """Newest trust in the pose; None if it is not used."""
    gate: CommandGate = field(default_factory=lambda: command_gate(TimeoutConfig()))
    """Gate with the lease of the node that drives the robot."""
    button_ns: int | None = None
    """Steady time of the last report of the robot's own emergency stop."""
    _was_gone: bool = False  # whether the driver was gone at the page's last report
    _shown_by: str = ""  # node that sent this report
    _zeros_of: str = ""  # sender of the last zero command

    def scan(self) -> ArrivedScan | None:
        """Return the newest scan."""
        latest = self.sources["scan"]
        m = latest.message
        if m is None:
            return None
        beams = (m.ranges, m.angle_min, m.angle_increment, m.range_min, m.range_max)
        return ArrivedScan(m.header.frame_id, stamp_ns(m), self._arrived_ns(latest), *beams)

    def cloud(self) -> ArrivedCloud | None:
        """Return the newest 3D points. An unreadable message is reported to the surroundings."""
        if self.points is None or self.points.message is None:
            return None
        message = self.points.message
        try:
            points = cloud_array(message)
        except MessageError as error:
            self.surroundings.refuse_points(str(error))
            return None
        return ArrivedCloud(message.header.frame_id, stamp_ns(message), self._arrived_ns(self.points), points)

    def rests(self, mode: Mode) -> bool:
        """Return whether the robot stands and no command moves it, so that nothing depends on the newest scan."""
        still = self._twist("command") == NO_MOTION == self._twist("odometry")
        return still and mode in (Mode.REAL, Mode.STOPPED)

    @property
    def lease(self) -> Lease:
        """The lease of the node that drives the robot."""
        assert self.gate.lease is not None
        return self.gate.lease

    def take_command(self, received: Received) -> bool:
        """Take a command if its sender holds or now gets the robot's lease. Return whether it was taken.

        Args:
            received: TwistStamped whose frame names the client of the publishing node.
        """
        message = deserialize(received.payload, received.type_name)
        twist = twist_values(message)
        if self.gate.check_twist(*twist) is not None:
            return False  # an invalid twist refreshes no age
        sender, given_ns = f"{received.publisher}/{message.header.frame_id}", received.given_ns(stamp_ns(message))
        moves = twist != NO_MOTION
        if sender.endswith(RELEASED):
            taken = not moves and self.lease.release(sender.removesuffix(RELEASED))
        else:
            now_ns = self.clock.steady_ns()
            # The holder's command is taken at any age, and its age then counts. Another sender's must be recent.
            age_s = 0.0 if sender == self.lease.holder else (now_ns - given_ns) / 1e9
            stands = self._stands()
            taken = self.gate.admit(*twist, age_s, sender, now_ns, given_ns=given_ns, stands=stands) is None
            if taken:
                self._zeros_of = self._zeros_of if moves else sender
                if not self._counts(self._shown_by):
                    self.shown.forget()
        if taken:
            self.sources["command"].put(message, received)
        else:
            self.sources["command"].note(received)  # a restarted console is a new client without a lease
        return taken

    def take_shown(self, received: Received, mode: Mode) -> bool:
        """Take a page's report. Return whether to step at once, for a waiting switch or because the driver was lost.

        While the robot is driven, only reports of the driver's node count, because only its pages show his images.
        """
        if not self._counts(received.publisher):
            return False
        self._shown_by = received.publisher
        message = deserialize(received.payload, received.type_name)
        self.shown.put(message, received)
        wanted = mode in (Mode.ENTERING, Mode.VIRTUAL, Mode.RETURNING)
        new = self.view.report(page_report(message), wanted, self.clock.now_ns(), self.clock.steady_ns())
        before, self._was_gone = self._was_gone, self.operator_gone()
        return (new and mode in (Mode.ENTERING, Mode.RETURNING)) or (self._was_gone and not before)

    def update_costmap(self, static: StaticMap | None) -> Any:
        """Enter the newest scan and points into the costmap. Return its message if it is due, else None."""
        scan = self.scan()
        costmap = self.surroundings.update_costmap(scan, self.cloud(), static)
        if costmap is None or scan is None or not self.surroundings.publish_due(self.clock.steady_ns()):
            return None
        x, y = costmap.origin.tolist()
        return grid_message(costmap.occupancy(), costmap.resolution, (x, y), "map", scan.stamp_ns)

    def operator_gone(self) -> bool:
        """Return whether the console has lost its driver since the newest command."""
        shown, command = self.shown.message, self.sources["command"].message
        return shown is not None and command is not None and stamp_ns(command) <= stamp_ns(shown.operator_lost)

    def ages(self, timeouts: TimeoutConfig, points_every_s: float = 0.0) -> dict[str, float]:
        """Return the seconds since the newest message of each source, for ``ArbiterInputs.ages``."""
        now_ns, steady_ns = self.clock.now_ns(), self.clock.steady_ns()
        ages = {key: _age_s(latest) for key, latest in self.sources.items()} | {"vspace": self.vspace.age_s}
        ages |= self.view.ages(page_report(self.shown.message), self.shown.age_s, steady_ns)
        if self.points is not None and self.surroundings.points_seen:
            used_s = self.surroundings.used_age_s("points", now_ns, steady_ns) - points_every_s
            ages["points"] = max(_age_s(self.points), used_s)
        if self.button_ns is not None and timeouts.estop_input > 0:
            ages["estop_input"] = (steady_ns - self.button_ns) / 1e9
        return ages

    def inputs(
        self, latch: KeptEstop, walls: WallMap | None, timeouts: TimeoutConfig, points_every_s: float = 0.0
    ) -> ArbiterInputs:
        """Return the inputs of a step now. The costmap uses a sweep of points every ``points_every_s``; 0 uses all."""
        now_ns, steady_ns = self.clock.now_ns(), self.clock.steady_ns()
        view, surroundings = self.view, self.surroundings
        ages, near = self.ages(timeouts, points_every_s), surroundings.near_points(self.scan())
        used_s = math.inf if near is None else surroundings.used_age_s("scan", now_ns, steady_ns)
        ages["scan"] = max(ages["scan"], used_s)
        pose, velocity = surroundings.robot_pose(), self._twist("odometry")
        vbot, status = self.sources["vbot"].message, self.vspace.message
        report = page_report(self.shown.message)
        trust = None if self.integrity is None else self.integrity.message
        return ArbiterInputs(
            robot_pose=pose,
            pose_lost_probability=_pose_lost_probability(trust),
            contradiction=Contradiction.NONE if trust is None else Contradiction(trust.contradiction),
            contradictions=0 if trust is None else int(trust.contradictions),
            robot_velocity=velocity,
            operator_command=self._twist("command"),
            holder=self.lease.holder,
            holder_sends_zeros=self.lease.holder == self._zeros_of != "",
            refused=self.lease.refused,
            operator_gone=self.operator_gone(),
            held_in_vain=self.lease.held_in_vain(steady_ns),
            estop=latch.pressed,
            estop_button=latch.button,
            estop_why=latch.why,
            scan_points=np.zeros((0, 2)) if near is None else near,
            blind=surroundings.blind,
            moving=surroundings.moving_points(now_ns),
            costmap=surroundings.costmap,
            walls=walls,
            vspace=Vspace() if status is None else _vspace(status),
            vbot_pose=None if vbot is None else _present_pose(vbot, now_ns),
            vbot_velocity=self._twist("vbot"),
            nav_command=self._twist("nav"),
            shown_pose=view.shown_pose(report, pose, velocity, now_ns),
            image_position=None if report is None else view.image_position(),
            view_position=None if report is None else report.view_position,
            view_after_image_s=0.0 if report is None else report.view_after_image_s,
            ages=ages,
            usual=view.usual(with_page=report is not None),
            images_late_s=view.delay_s(report),
            suspended_ns=self.clock.suspended_ns(),
            instances={(key, node): i for key in WATCHED for node, i in self.sources[key].instances.items()},
        )

    def _counts(self, node: str) -> bool:
        """Return whether a node's pages show the driver's images."""
        return not self.lease.holder or self.lease.holder.startswith(f"{node}/")

    @property
    def command(self) -> tuple[float, float]:
        """The newest command of the lease's holder (m/s, rad/s)."""
        return self._twist("command")

    def _stands(self) -> bool:
        linear, angular = self._twist("odometry")
        return abs(linear) < STANDS_M_S and abs(angular) < STANDS_RAD_S

    def _twist(self, key: str) -> tuple[float, float]:
        message = self.sources[key].message
        return (0.0, 0.0) if message is None else twist_values(message)

    def _arrived_ns(self, latest: Latest) -> int:
        return self.clock.steady_ns() - round(latest.age_s * 1e9)


def command_gate(timeouts: TimeoutConfig) -> CommandGate:
    """Return the arbiter's gate, where a recent command takes the robot's lease if it is free."""
    return CommandGate(command_limits(timeouts), Lease(LEASE_S))


def command_limits(timeouts: TimeoutConfig) -> GateLimits:
    """Return the limits of the arbiter's gate. The age of a command with a future stamp counts from its arrival."""
    return GateLimits(max_age_s=timeouts.command, max_ahead_s=math.inf)


def page_report(shown: ShownPictures | None) -> PageReport | None:
    """Return the report of the operator's page; None without one."""
    if shown is None:
        return None
    return PageReport(
        image_stamp_ns=stamp_ns(shown.picture_stamp),
        image_age_s=float(shown.picture_age_s),
        view_id=int(shown.view_id),
        view_age_s=float(shown.view_age_s),
        view_delay_s=float(shown.view_delay_s),
        view_position=matrix_from_pose(shown.view_pose)[:2, 3],
    )


def command_message(decision: Decision, now_ns: int) -> TwistStamped:
    """Return the message for ``/cmd_vel``. Its frame demands a hard stop if the decision does."""
    return twist_stamped(*decision.command, now_ns, HARD_STOP if decision.hard else "base_link")


def control_state(decision: Decision, inputs: ArbiterInputs, now_ns: int) -> ControlState:
    """Return the ControlState of one step of the arbiter."""
    return ControlState(
        header=header("map", now_ns),
        mode=int(decision.mode),
        reason=decision.reason,
        estop=decision.estop,
        blocked=decision.blocked,
        transitions=decision.transitions,
        robot_pose=pose2_message(np.zeros(3) if inputs.robot_pose is None else inputs.robot_pose),
        vbot_start=pose2_message(decision.vbot_start),
        vbot_pose=pose2_message(decision.vbot_pose),
        operator_command=twist_message(*decision.operator_command),
        applied_command=twist_message(*decision.command),
        pose_gap_m=decision.pose_gap_m,
        yaw_gap_rad=decision.yaw_gap_rad,
        time_to_obstacle_s=decision.time_to_obstacle_s,
        shown=ControlState.SHOWN_VIRTUAL if decision.mode.shows_vbot else ControlState.SHOWN_REAL,
        vbot_action=int(decision.vbot_action),
        vbot_target=pose2_message(decision.vbot_target),
        robot_twist=twist_message(*inputs.robot_velocity),
        vbot_limit_m_s=decision.vbot_limit_m_s,
        reason_code=int(decision.reason_code),
        holder=inputs.holder,
    )


def _pose_lost_probability(trust: PoseIntegrity | None) -> float:
    probability = 0.0 if trust is None else float(trust.lost_probability)
    return probability if 0.0 <= probability <= 1.0 else 1.0  # NaN or out of range: do not trust the pose


def _age_s(latest: Latest) -> float:
    """Return the seconds since the newest message by its stamp; inf without a message."""
    return math.inf if latest.message is None else latest.stamp_age_s


def _present_pose(odometry: Odometry, now_ns: int) -> NDArray[np.float64]:
    """Return the pose (3,) extrapolated to now, because the message is up to a period old."""
    pose = pose2_from_message(odometry)
    return extrapolate(pose, twist_values(odometry), (now_ns - stamp_ns(odometry)) / 1e9)


def _vspace(status: VspaceStatus) -> Vspace:
    return Vspace(
        ready=status.state == VspaceStatus.READY,
        training=status.state == VspaceStatus.TRAINING,
        failed=status.state == VspaceStatus.FAILED,
        position=matrix_from_pose(status.keyframe_pose)[:2, 3],
        ready_radius_m=float(status.ready_radius_m),
        message=status.message,
        expected_psnr_db=float(status.expected_psnr_db),
    )
