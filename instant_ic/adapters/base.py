"""Conversion between messages of the node ``crawler_base`` and the plain values of ``instant_ic.base``."""

from __future__ import annotations

from typing import Any, NamedTuple

from instant_ic.base.odometry import OdometryEstimate
from instant_ic.bus import NodeError
from instant_ic.bus.transport import Received
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.msg import (
    HARD_STOP,
    Twist,
    TwistStamped,
    deserialize,
    odometry_message,
    stamp_ns,
    twist_values,
    type_name,
)

_TWISTS = (type_name(TwistStamped), type_name(Twist))


class BaseCommand(NamedTuple):
    """A command from ``/cmd_vel``: v in m/s, w in rad/s."""

    v: float
    w: float
    stamp_ns: int
    """Stamp of the message; 0 without one."""
    given_ns: int
    """Time of the command on the steady clock."""
    hard: bool
    """True for a stop at the hard deceleration."""


def read_command(received: Received) -> BaseCommand:
    """Return the command of a Twist or TwistStamped.

    Raises:
        NodeError: the message is of another type.
    """
    name = received.type_name
    if name not in _TWISTS:
        raise NodeError(f"{received.topic} carries {name}; expected {' or '.join(_TWISTS)}")
    message: Any = deserialize(received.payload, name)
    stamp = stamp_ns(message) if hasattr(message, "header") else 0
    hard = stamp != 0 and message.header.frame_id == HARD_STOP
    return BaseCommand(*twist_values(message), stamp, received.given_ns(stamp) if stamp else received.steady_ns, hard)


def estimate_message(estimate: OdometryEstimate) -> Any:
    """Return the Odometry message of an estimate."""
    v, lateral, w = (float(part) for part in estimate.twist)
    covariances = (estimate.pose_covariance, estimate.twist_covariance)
    odom_from_base = matrix_from_pose2(estimate.pose)
    message = odometry_message(odom_from_base, v, w, "odom", "base_link", estimate.stamp_ns, *covariances)
    message.twist.twist.linear.y = lateral
    return message
