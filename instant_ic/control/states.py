"""The state machine of illusory control as data (paper, III.A): modes, guards, actions, sources, reasons.

``arbiter.py`` runs these tables with the guards of ``guards.py``; ``tests/control/diagram.py`` prints them for docs.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Mode(IntEnum):
    """Values of ControlState.mode."""

    REAL = 0
    VIRTUAL = 1
    STOPPED = 2
    ENTERING = 3
    RETURNING = 4

    @property
    def label(self) -> str:
        """Name on the operator's page, in reports and in figures."""
        return self.name.lower()

    @property
    def shows_vbot(self) -> bool:
        """True if the operator sees the virtual space."""
        return self in (Mode.VIRTUAL, Mode.RETURNING)


class VbotAction(IntEnum):
    """Values of ControlState.vbot_action: how the v-bot moves."""

    WITH_ROBOT = 0
    DRIVEN = 1
    HELD = 2
    EASED = 3
    LED_BACK = 4


class Reason(IntEnum):
    """Values of ControlState.reason_code: why the robot drives, is slowed or stands; 0: a message without a code."""

    UNKNOWN = 0
    # Driving
    DRIVE_ROBOT = 1
    DRIVE_VBOT = 2
    SWITCHING_TO_VIRTUAL = 3
    SWITCHING_TO_CAMERA = 4
    LEADING_BACK = 5
    ROBOT_CANNOT_FOLLOW = 6
    NO_SUBGOAL = 7
    # Blocked: an obstacle is ahead and no switch is possible
    OBSTACLE_AHEAD = 20
    CONTACT = 21
    NO_ROOM_TO_TURN = 22
    VSPACE_NOT_RUNNING = 23
    VSPACE_NOT_READY = 24
    VSPACE_TOO_FAR = 25
    VSPACE_TOO_POOR = 26
    NO_VIEW_FITS = 27
    JUST_RETURNED = 28
    WALL_AHEAD = 29
    NO_SPACE_BEHIND = 30
    NO_WAY_ROUND = 31
    POSE_DOUBTFUL = 32
    BLIND = 36
    # Held or stopped: nothing may move
    ESTOP = 50
    ESTOP_BUTTON = 51
    STARTING = 52
    POSE_UNKNOWN = 53
    NO_COSTMAP = 54
    IMAGES_TOO_RARE = 55
    RELEASE_CONTROLS = 56
    VSPACE_FAILED = 57
    VSPACE_LOST = 58
    POSE_LOST = 59
    INTERRUPTED = 60
    CONTRADICTION = 64
    # Held or stopped: a source is stale
    SCAN_STALE = 70
    POINTS_STALE = 71
    ODOMETRY_STALE = 72
    POSE_STALE = 73
    CAMERA_STALE = 74
    ESTOP_INPUT_STALE = 75
    VIEW_STALE = 76
    VBOT_STALE = 77
    NAV_STALE = 78
    OPERATOR_LOST = 79

    @property
    def holds(self) -> bool:
        """True if nothing may move."""
        return self >= Reason.ESTOP


@dataclass(frozen=True)
class Transition:
    """One transition: from ``source`` to ``target`` when ``guard`` holds, with ``action``."""

    source: Mode
    target: Mode
    guard: str
    action: str


def _stops(source: Mode, *more: str) -> tuple[Transition, ...]:
    guards = ("estop_pressed", "interrupted", "source_lost", "pose_lost", "contradicted", *more)
    return tuple(Transition(source, Mode.STOPPED, guard, "stop") for guard in guards)


TRANSITIONS: tuple[Transition, ...] = (
    *_stops(Mode.REAL),
    Transition(Mode.REAL, Mode.ENTERING, "obstacle_and_ready", "call_vbot"),
    *_stops(Mode.ENTERING),
    Transition(Mode.ENTERING, Mode.REAL, "vspace_not_ready", "hand_back"),
    Transition(Mode.ENTERING, Mode.REAL, "no_view_in_time", "abandon_entry"),
    Transition(Mode.ENTERING, Mode.REAL, "way_free", "hand_back"),
    Transition(Mode.ENTERING, Mode.VIRTUAL, "view_fits", "place_vbot"),
    *_stops(Mode.VIRTUAL, "vspace_lost"),
    Transition(Mode.VIRTUAL, Mode.RETURNING, "rejoined", "ease_vbot"),
    *_stops(Mode.RETURNING, "vspace_lost"),
    Transition(Mode.RETURNING, Mode.VIRTUAL, "unsafe_again", "drive_vbot_on"),
    Transition(Mode.RETURNING, Mode.REAL, "image_fits", "hand_back"),
    Transition(Mode.STOPPED, Mode.REAL, "may_resume", "hand_back"),
)
"""Transitions in order of priority: each step takes the first row of the present state whose guard holds."""

GUARDS: dict[str, str] = {
    "estop_pressed": "the emergency stop is latched",
    "source_lost": "a source that this state needs has been silent for stop_after_s (camera, views: twice their "
    "time-out if longer)",
    "interrupted": "the arbiter has not stepped for stop_after_s, or its machine was suspended; the commands of a "
    "held key have stopped for stop_after_s, or their sender has changed; crawler_base, navigator, virtual_robot or "
    "the console has restarted",
    "pose_lost": "the SLAM is lost with a probability of pose_trust.stop or more, or the pose of the r-bot or of the "
    "shown v-bot has jumped by pose_trust.jump_m or jump_deg; once the controls are released, the r-bot may drive "
    "slowly until its place is recognized",
    "contradicted": "wheels and LiDAR contradict each other for 0.5 s or 0.15 m; once the controls are released, the "
    "r-bot may drive slowly until they have agreed for 0.3 m; a contradiction that lasts stops it again",
    "vspace_lost": "the virtual space has failed, or its node is silent",
    "obstacle_and_ready": "the predicted path meets an obstacle, the virtual space is ready, and the r-bot has a way "
    "round; after an abandoned entry, a view must have fitted or the operator have let go since",
    "vspace_not_ready": "the virtual space is no longer ready",
    "no_view_in_time": "no view fits after enter_timeout_s plus the delay of an image and a view",
    "way_free": "the command is safe for the r-bot over the same horizons as in `rejoined`",
    "view_fits": "the places of the newest view and the newest camera image agree within picture_position_m and "
    "picture_yaw_deg, and the operator's command is fresh",
    "rejoined": "r-bot and v-bot have agreed for return_dwell_s and are within return_near_m, or have agreed for "
    "return_patience_s; the command is safe for the r-bot over the prediction horizon and over a longer and wider "
    "one",
    "unsafe_again": "the command leads the r-bot into an obstacle again",
    "image_fits": "the v-bot is within return_picture_m and return_picture_yaw_deg of the r-bot, the r-bot turns no "
    "faster than return_turn_rad_s, and view and image agree within the same limits; after return_timeout_s the "
    "first condition is enough, and after twice that time none is needed",
    "may_resume": "the emergency stop is released, every source has been fresh for recover_s, images arrive at least "
    "every slowest_image_s, the command has been zero for 0.1 s (or silent for 1 s if no key was held), and after "
    "`interrupted` or a lost link the operator's commands are fresh again",
}

ACTIONS: dict[str, str] = {
    "stop": "command zero; show the camera",
    "call_vbot": "request views of the v-bot's pose; slow the r-bot",
    "place_vbot": "drive and show the v-bot, from the pose of the shown image",
    "ease_vbot": "drive the r-bot, ease the v-bot onto it, and keep showing the v-bot",
    "drive_vbot_on": "drive the v-bot again, from its present pose",
    "hand_back": "drive and show the r-bot",
    "abandon_entry": "like hand_back, but no new entry until a view fits or the operator lets go",
}


@dataclass(frozen=True)
class Source:
    """An input that must be fresh. After its time-out the command is zero, after ``stop_after_s`` the mode STOPPED."""

    key: str
    name: str
    reason: Reason
    """Code of the reason while it is stale."""
    modes: tuple[Mode, ...]
    text: str = ""
    """Text for the operator while it is stale; empty: "No NAME for SECONDS."."""
    optional: bool = False
    """Needed only after its first message; a robot without 3D points drives by its flat scan."""
    steady: bool = False
    """The time-out is longer if messages are usually rare. Only images have this: sources that keep the robot off
    obstacles have fixed time-outs, so that it stops in time even on a slow machine."""


_MOVING = (Mode.REAL, Mode.ENTERING, Mode.VIRTUAL, Mode.RETURNING)
_CAMERA = (Mode.REAL, Mode.ENTERING, Mode.RETURNING)
_VIEW = (Mode.VIRTUAL, Mode.RETURNING)

SOURCES: tuple[Source, ...] = (
    Source("scan", "LiDAR scan", Reason.SCAN_STALE, _MOVING),
    Source("points", "3D points", Reason.POINTS_STALE, _MOVING, optional=True),
    Source("odometry", "wheel odometry", Reason.ODOMETRY_STALE, _MOVING),
    Source("pose", "SLAM pose", Reason.POSE_STALE, _MOVING),
    Source("camera", "camera image", Reason.CAMERA_STALE, _CAMERA, steady=True),
    Source("estop_input", "message from the emergency stop button", Reason.ESTOP_INPUT_STALE, _MOVING, optional=True),
    Source("view", "view of the virtual space", Reason.VIEW_STALE, _VIEW, steady=True),
    Source("vbot", "v-bot", Reason.VBOT_STALE, _VIEW),
    Source("nav", "path follower", Reason.NAV_STALE, (Mode.VIRTUAL,)),
    # If the operator drives the r-bot, silence just means a zero command. In VIRTUAL, the r-bot would drive on towards
    # the v-bot by itself.
    Source(
        "command",
        "operator's link",
        Reason.OPERATOR_LOST,
        (Mode.VIRTUAL,),
        "The operator's link is lost.",
    ),
)
