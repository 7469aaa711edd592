"""Commands from outside the run directory: their topics and limits."""

from __future__ import annotations

from dataclasses import dataclass

from instant_ic.config.ranges import Checked, Positive
from instant_ic.control.command_gate import CommandGate, GateLimits
from instant_ic.control.robot_lease import Lease

DRIVE, STOP = "/operator/cmd_vel", "/operator/estop"
COMMANDS = {DRIVE: "geometry_msgs/msg/TwistStamped", STOP: "std_msgs/msg/Bool"}
"""Topics that a remote operator may send, with their types."""


@dataclass(frozen=True)
class CommandLimits(Checked):
    """Limits for commands from outside.

    Attributes:
        max_age_s: s; an older command is refused. The clocks of both machines must agree better than this.
        lease_s: s; other senders' commands are refused until the driving sender has been silent for this long.
        max_linear_mps: m/s; a faster command is refused. The arbiter limits the commands that pass.
        max_angular_rps: rad/s; a faster command is refused.
    """

    max_age_s: Positive = 0.3
    lease_s: Positive = 2.0
    max_linear_mps: Positive = 2.0
    max_angular_rps: Positive = 4.0

    def gate(self) -> CommandGate:
        """Return a gate with these limits and its own lease."""
        limits = GateLimits(self.max_age_s, self.max_age_s, self.max_linear_mps, self.max_angular_rps)
        return CommandGate(limits, Lease(self.lease_s))
