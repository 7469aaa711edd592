"""Inputs of the arbiter, and the snapshot of one step by which guards and commands decide."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.costmap import Costmap
from instant_ic.control.moving import NOTHING_MOVES, MovingPoints
from instant_ic.control.prediction import Prediction, Predictor
from instant_ic.control.reasons import Notice, Stale
from instant_ic.control.states import Mode
from instant_ic.control.subgoal import Subgoal
from instant_ic.control.walls import WallMap
from instant_ic.util.contradiction import Contradiction

Twist2 = tuple[float, float]
"""Linear m/s, angular rad/s."""
NO_MOTION: Twist2 = (0.0, 0.0)


@dataclass(frozen=True)
class Vspace:
    """State that the virtual space reports (VspaceStatus)."""

    ready: bool = False
    training: bool = False
    failed: bool = False
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """(2,) position of the newest keyframe in the map frame, in metres."""
    ready_radius_m: float = 0.0
    message: str = ""
    expected_psnr_db: float = 0.0
    """Expected quality of the view requested last, in dB; 0 or NaN: unknown."""


@dataclass(frozen=True)
class ArbiterInputs:
    """Inputs of one step; an age is inf until the first message."""

    robot_pose: NDArray[np.float64] | None = None
    """(3,) map_from_base of the r-bot; None while unknown."""
    pose_lost_probability: float = 0.0
    """Probability that the r-bot is somewhere else; 0 without a report."""
    contradiction: Contradiction = Contradiction.NONE
    """Contradiction between wheels and LiDAR, kept until they agree again."""
    contradictions: int = 0
    """Number of contradictions that the SLAM has reported."""
    robot_velocity: Twist2 = (0.0, 0.0)
    operator_command: Twist2 = (0.0, 0.0)
    holder: str = ""
    """Sender that has the robot's lease; empty: nobody."""
    holder_sends_zeros: bool = False
    """The holder has sent zeros before, so that its silence is no release."""
    refused: tuple[str, ...] = ()
    """Senders without the lease that hold a control."""
    operator_gone: bool = False
    """The client that sent the command has left since. The command is void, whatever its age."""
    held_in_vain: bool = False
    """Nobody drives, because a client must release its controls first."""
    estop: bool = False
    estop_button: bool = False
    """The button on the robot is pressed; only releasing it ends the stop."""
    estop_why: str = ""
    """Text for the operator about a stop that was not pressed in this run; empty: the usual text."""
    scan_points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(N, 2) hits of the newest scan and 3D points in ``base_link``, at the robot's present pose."""
    blind: tuple[bool, bool] = (False, False)
    """Flags (ahead, behind) of a covered LiDAR, which measures nothing where it did before."""
    moving: MovingPoints = NOTHING_MOVES
    """People and other moving things, in ``base_link`` at the robot's present pose."""
    costmap: Costmap | None = None
    walls: WallMap | None = None
    vspace: Vspace = field(default_factory=Vspace)
    vbot_pose: NDArray[np.float64] | None = None
    """(3,) pose of the v-bot in the map frame."""
    vbot_velocity: Twist2 = (0.0, 0.0)
    nav_command: Twist2 = (0.0, 0.0)
    shown_pose: NDArray[np.float64] | None = None
    """(3,) position of the r-bot when the camera image now shown was taken, with the present heading, because the page
    turns each image to it; None: ``robot_pose``."""
    image_position: NDArray[np.float64] | None = None
    """(2,) position of the camera in the map frame for the newest image that the operator has."""
    view_position: NDArray[np.float64] | None = None
    """(2,) position of the camera in the map frame for the newest rendered view that the operator has."""
    view_after_image_s: float = 0.0
    """Seconds from the arrival of the newest image to the arrival of the newest view."""
    ages: dict[str, float] = field(default_factory=dict)
    """Seconds since the last message of scan, odometry, pose, camera, view, vbot, nav, command and vspace; also of
    points and estop_input, from their first message on."""
    usual: dict[str, float] = field(default_factory=dict)
    """Usual age of a source in seconds when its next message arrives (``freshness.Rhythm``)."""
    suspended_ns: int = 0
    """Time for which the machine was suspended (``Clock.suspended_ns``)."""
    instances: dict[tuple[str, str], bytes] = field(default_factory=dict)
    """Identity of each publisher (``Received.instance``) by source and node."""
    images_late_s: float = 0.0
    """Delay in seconds of an image from exposure to the page, or of a view from its request to the page if longer."""

    def age(self, key: str) -> float:
        """Return the age of a source in seconds; inf before its first message."""
        return self.ages.get(key, math.inf)


@dataclass(frozen=True)
class Snapshot:
    """The immutable state by which guards and commands of one step decide."""

    config: ArbiterConfig
    predictor: Predictor
    inputs: ArbiterInputs
    mode: Mode
    in_mode_s: float
    """Seconds since the last change of mode."""
    command: Twist2
    """The operator's command; zero when stale."""
    fresh: bool
    """The operator's command is not stale, and its client is still connected."""
    last_command: Twist2
    """The operator's last command that was not zero."""
    idle_s: float
    """Seconds since the last command that was not zero."""
    stale: tuple[Stale, ...]
    """Stale sources that the present mode needs."""
    lost: tuple[Stale, ...]
    """Stale sources that have been silent for too long: the robot must go to STOPPED."""
    stale_in_real: tuple[Stale, ...]
    """Stale sources that REAL needs."""
    fresh_s: float
    """Seconds for which every source that REAL needs has been fresh; -1 while one is stale."""
    vspace: Vspace
    """The virtual space, held for a short time while it learns its next keyframe."""
    target: NDArray[np.float64]
    """(3,) pose of the r-bot as it is, or will be, shown."""
    vbot_pose: NDArray[np.float64]
    gap_m: float
    """Distance between v-bot and target."""
    yaw_gap_rad: float
    yaw_gap_before_rad: float
    """Yaw gap of the previous step."""
    agree_s: float
    """Seconds for which the two robots have agreed; -1 while they do not."""
    prediction: Prediction | None
    """Predicted trajectory of the driven robot."""
    since_return_s: float
    """Seconds since the last return or abandoned entry; inf: none."""
    awaits_operator: bool
    """STOPPED because the operator's link was lost."""
    slow_s: float
    """Seconds for which the v-bot has driven slower than commanded."""
    let_go_s: float
    """Seconds for which fresh commands have been zero; -1 while they are stale or not zero."""
    held: bool = False
    """The sender of the last motion has not let go yet; its silence is no release."""
    interrupted: Notice | None = None
    """Event since the previous step after which the controls must be released; None if there was none."""
    settles: bool = False
    """The arbiter did not run for a while, and has run again for less than ``SETTLE_S``."""
    pose_lost: bool = False
    """The SLAM is lost, and the robot has not been stopped for it yet."""
    pose_jumped: bool = False
    """The r-bot's pose has jumped since the previous step."""
    contradicted: bool = False
    """Wheels and LiDAR contradict each other, and the robot has not been stopped for it yet."""
    vbot_jumped: bool = False
    """The v-bot's pose has jumped: the r-bot would follow it to a place where nobody drove it."""
    no_view_fits: bool = False
    """An entry was abandoned. Since then no view has fitted, and the operator has not let go."""
    leading_back: bool = False
    """The v-bot returns to the r-bot by itself."""
    subgoal: Subgoal | None = None
    against_switch: Notice | None = None
    """Reason why no switch is possible in REAL with an obstacle ahead; None if one is, or no obstacle is ahead."""

    @property
    def pose_doubtful(self) -> bool:
        """True if the r-bot must drive slowly because its pose may be wrong."""
        return self.inputs.pose_lost_probability >= self.config.pose_trust.slow

    @property
    def must_be_slow(self) -> bool:
        """True if the r-bot must drive slowly because its pose or its measured motion may be wrong."""
        return self.pose_doubtful or self.inputs.contradiction != Contradiction.NONE

    @property
    def obstacle_ahead(self) -> bool:
        """True if the predicted path meets an obstacle."""
        return self.prediction is not None and self.prediction.hit_index is not None
