"""The state machine of illusory control as data (paper, III.A): states, guards, actions, sources.

``diagram.py`` prints these tables for the docs; ``arbiter.py`` runs them.
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
    def shows_vbot(self) -> bool:
        """Whether the operator sees the virtual space."""
        return self in (Mode.VIRTUAL, Mode.RETURNING)


class VbotAction(IntEnum):
    """Values of ControlState.vbot_action: how the v-bot moves."""

    WITH_ROBOT = 0
    DRIVEN = 1
    HELD = 2
    EASED = 3
    LED_BACK = 4


@dataclass(frozen=True)
class State:
    """Meaning of a mode: which robot the operator drives, what is shown, what the other robot does."""

    driven: str
    shown: str
    other: str


STATES: dict[Mode, State] = {
    Mode.REAL: State("r-bot", "camera", "the v-bot moves with the r-bot"),
    Mode.ENTERING: State(
        "r-bot, slowing to a stand within enter_timeout_s",
        "camera",
        "the v-bot waits for its first view where the shown image was taken",
    ),
    Mode.VIRTUAL: State("v-bot", "virtual space", "the r-bot drives to the subgoal"),
    Mode.RETURNING: State("r-bot", "virtual space", "the v-bot moves as the r-bot and is eased onto it"),
    Mode.STOPPED: State("nobody", "camera", "both stand"),
}


@dataclass(frozen=True)
class Transition:
    """One transition: from ``source`` to ``target`` when ``guard`` holds, with ``action``."""

    source: Mode
    target: Mode
    guard: str
    action: str


TRANSITIONS: tuple[Transition, ...] = (
    Transition(Mode.REAL, Mode.STOPPED, "estop_pressed", "stop"),
    Transition(Mode.REAL, Mode.STOPPED, "source_lost", "stop"),
    Transition(Mode.REAL, Mode.ENTERING, "obstacle_and_ready", "call_vbot"),
    Transition(Mode.ENTERING, Mode.STOPPED, "estop_pressed", "stop"),
    Transition(Mode.ENTERING, Mode.STOPPED, "source_lost", "stop"),
    Transition(Mode.ENTERING, Mode.REAL, "entry_moot", "hand_back"),
    Transition(Mode.ENTERING, Mode.VIRTUAL, "view_fits", "place_vbot"),
    Transition(Mode.VIRTUAL, Mode.STOPPED, "estop_pressed", "stop"),
    Transition(Mode.VIRTUAL, Mode.STOPPED, "source_lost", "stop"),
    Transition(Mode.VIRTUAL, Mode.STOPPED, "vspace_lost", "stop"),
    Transition(Mode.VIRTUAL, Mode.RETURNING, "rejoined", "ease_vbot"),
    Transition(Mode.RETURNING, Mode.STOPPED, "estop_pressed", "stop"),
    Transition(Mode.RETURNING, Mode.STOPPED, "source_lost", "stop"),
    Transition(Mode.RETURNING, Mode.STOPPED, "vspace_lost", "stop"),
    Transition(Mode.RETURNING, Mode.VIRTUAL, "unsafe_again", "drive_vbot_on"),
    Transition(Mode.RETURNING, Mode.REAL, "picture_fits", "hand_back"),
    Transition(Mode.STOPPED, Mode.REAL, "may_resume", "hand_back"),
)
"""In order: the first row of the present state whose guard holds is taken, at most one per step."""

GUARDS: dict[str, str] = {
    "estop_pressed": "the emergency stop is latched",
    "source_lost": "a source that this state needs has been silent for stop_after_s (camera, views: for twice their "
    "time-out, if that is longer)",
    "vspace_lost": "the virtual space has failed, or its node is silent",
    "obstacle_and_ready": "the predicted path meets an obstacle, the virtual space is ready, the r-bot has a way "
    "round; after an abandoned entry, also: a view fits, or the operator let go",
    "entry_moot": "the virtual space is no longer ready; no view fits after enter_timeout_s plus the delay of an image "
    "and a view; or the command is safe for the r-bot as in `rejoined`",
    "view_fits": "the places of the newest view and the newest camera image agree within picture_position_m and "
    "picture_yaw_deg",
    "rejoined": "r-bot and v-bot agree for return_dwell_s, to within return_near_m or for return_patience_s; the "
    "command is safe for the r-bot over the prediction horizon and over a longer and wider one",
    "unsafe_again": "the command leads the r-bot into an obstacle again",
    "picture_fits": "the v-bot is on the r-bot within return_picture_m and return_picture_yaw_deg, the r-bot turns no "
    "faster than return_turn_rad_s, and view and image agree as closely (after return_timeout_s the first is enough, "
    "after twice that nothing is required)",
    "may_resume": "the emergency stop is released, every source has been fresh for recover_s, images arrive at least "
    "every slowest_image_s, the command is zero or silent, and a lost operator's link that caused the stop is back",
}

ACTIONS: dict[str, str] = {
    "stop": "command zero; show the camera",
    "call_vbot": "request views of the v-bot's pose; slow the r-bot",
    "place_vbot": "drive and show the v-bot, from the pose of the shown image",
    "ease_vbot": "drive the r-bot, ease the v-bot onto it, keep showing the v-bot",
    "drive_vbot_on": "drive the v-bot again, from its present pose",
    "hand_back": "drive and show the r-bot",
}


@dataclass(frozen=True)
class Source:
    """An input that must be fresh: beyond its time-out the command is zero; beyond ``stop_after_s``, STOPPED."""

    key: str
    name: str
    modes: tuple[Mode, ...]
    words: str = ""
    """Text for the operator when it is lost; empty: "no NAME for SECONDS"."""
    optional: bool = False
    """Needed only after its first message: a robot without 3D points drives by its flat scan."""
    steady: bool = False
    """It has its own rate: the time-out is longer if its messages are usually rare. Images only: sources that keep the
    robot off obstacles have fixed time-outs, so that it stops in time on a slow machine too."""


OPERATOR_LOST = "the operator's link is lost, the robot waits"

_MOVING = (Mode.REAL, Mode.ENTERING, Mode.VIRTUAL, Mode.RETURNING)

SOURCES: tuple[Source, ...] = (
    Source("scan", "LiDAR scan", _MOVING),
    Source("points", "3D points", _MOVING, optional=True),
    Source("odometry", "wheel odometry", _MOVING),
    Source("pose", "SLAM pose", _MOVING),
    Source("camera", "camera image", (Mode.REAL, Mode.ENTERING, Mode.RETURNING), steady=True),
    Source("estop_input", "message from the emergency stop button", _MOVING, optional=True),
    Source("view", "view of the virtual space", (Mode.VIRTUAL, Mode.RETURNING), steady=True),
    Source("vbot", "v-bot", (Mode.VIRTUAL, Mode.RETURNING)),
    Source("nav", "path follower", (Mode.VIRTUAL,)),
    # Where the operator drives the r-bot, silence is only a zero command; in VIRTUAL the r-bot would go on to the
    # v-bot by itself.
    Source("command", "operator's link", (Mode.VIRTUAL,), OPERATOR_LOST),
)
