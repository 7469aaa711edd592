"""When the two robots change places, and that nothing flickers: random situations, and each way out of each state."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from control_world import Loop, World, corridor, draw_map, rectangle
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic.control.arbiter import Arbiter, Decision
from instant_ic.control.arbiter_config import ArbiterConfig, SwitchConfig
from instant_ic.control.costmap import LETHAL, Costmap
from instant_ic.control.freshness import Rhythm, TimeoutConfig
from instant_ic.control.guards import way_free
from instant_ic.control.kinematics import move
from instant_ic.control.snapshot import ArbiterInputs, Vspace
from instant_ic.control.states import SOURCES, TRANSITIONS, Mode, VbotAction
from instant_ic.control.vbot import VbotConfig, VirtualRobot

NOTHING, FORWARD = (0.0, 0.0), (0.4, 0.0)
DT = 0.05
KEYS = [source.key for source in SOURCES if not source.optional] + ["vspace"]


def costmap(boxes: list[tuple[float, float]]) -> Costmap:
    """12 m x 12 m round the origin, with a box 0.3 m wide at each place."""
    costs = np.zeros((240, 240), np.uint8)
    for x, y in boxes:
        column, row = round((x + 6.0) / 0.05), round((y + 6.0) / 0.05)
        costs[max(0, row - 3) : row + 3, max(0, column - 3) : column + 3] = LETHAL
    return Costmap(costs, 0.05, np.array([-6.0, -6.0]))


def entry_patience_s() -> float:
    """Slowed to a stand, and then as long as an image and a view of that place may take."""
    timeouts = TimeoutConfig()
    return SwitchConfig().enter_timeout_s + timeouts.allowed_s("camera") + timeouts.allowed_s("view")


@pytest.fixture(scope="module", autouse=True)
def _passage() -> Iterator[None]:
    """What is behind the obstacle is not the question here, and planning takes time."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("instant_ic.control.arbiter.find_passage", lambda *_: None)
        yield


class Drive:
    """An arbiter with its inputs by hand: an r-bot that goes straight to the v-bot, through everything."""

    def __init__(self, map_: Costmap, switch: SwitchConfig | None = None) -> None:
        self.arbiter = Arbiter(ArbiterConfig(switch=switch or SwitchConfig()))
        self.map = map_
        self.robot, self.speed = np.zeros(3), NOTHING
        self.vbot = VirtualRobot(VbotConfig(), self.arbiter.config.limits)
        self.vspace = Vspace(ready=True, ready_radius_m=100.0)
        self.ages = dict.fromkeys(KEYS, 0.0)
        self.apart_m = self.view_after_picture_s = 0.0
        self.estop = False
        self.steps: list[Decision] = []
        self.obey: Decision | None = None

    def step(self, command: tuple[float, float]) -> Decision:
        said, robot = self.obey, self.robot
        if said is None or said.vbot_action == VbotAction.WITH_ROBOT:
            self.vbot.place(robot, self.speed)
        elif said.vbot_action == VbotAction.EASED:
            self.vbot.ease(robot, self.speed, DT)
        elif said.vbot_action == VbotAction.LED_BACK:
            self.vbot.lead_back(robot, DT)
        else:
            self.vbot.step(command if said.vbot_action == VbotAction.DRIVEN else NOTHING, robot, DT)
        inputs = ArbiterInputs(
            robot_pose=robot.copy(),
            robot_velocity=self.speed,
            operator_command=command,
            estop=self.estop,
            costmap=self.map,
            vspace=self.vspace,
            vbot_pose=self.vbot.pose.copy(),
            vbot_velocity=self.vbot.velocity,
            image_position=robot[:2],
            view_position=self.vbot.pose[:2] + [self.apart_m, 0.0],
            view_after_image_s=self.view_after_picture_s,
            ages=dict(self.ages),
        )
        self.obey = decision = self.arbiter.step(inputs, round(len(self.steps) * DT * 1e9))
        if decision.mode == Mode.VIRTUAL:
            gap = self.vbot.pose - robot
            self.robot = robot + np.clip(gap, -0.03, 0.03) if decision.vbot_action != VbotAction.LED_BACK else robot
            self.speed = NOTHING
        else:
            self.speed = decision.command
            self.robot = move(robot, *self.speed, DT)
        self.steps.append(decision)
        return decision

    def drive(self, seconds: float, command: tuple[float, float]) -> list[Decision]:
        return [self.step(command) for _ in range(round(seconds / DT))]

    def until(self, mode: Mode, command: tuple[float, float], seconds: float = 10.0) -> None:
        for _ in range(round(seconds / DT)):
            if self.step(command).mode == mode:
                return
        raise AssertionError(f"never {mode.name}: {self.steps[-1].mode.name}, {self.steps[-1].reason}")

    def stays(self) -> list[tuple[Mode, float]]:
        """Modes in order, with the seconds in each."""
        changes = [0, *(k for k in range(1, len(self.steps)) if self.steps[k].mode != self.steps[k - 1].mode)]
        ends = [*changes[1:], len(self.steps)]
        return [(self.steps[k].mode, (end - k) * DT) for k, end in zip(changes, ends, strict=True)]


def before_box(switch: SwitchConfig | None = None) -> Drive:
    """A robot that is let drive, 2 m before a box."""
    made = Drive(costmap([(2.0, 0.0)]), switch)
    made.until(Mode.REAL, NOTHING)
    return made


poses = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-math.pi, math.pi)).map(np.array)
twists = st.tuples(st.sampled_from([-0.4, 0.0, 0.1, 0.4]), st.sampled_from([-0.8, -0.2, 0.0, 0.3, 1.0]))
places = st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=12)


@settings(max_examples=100, deadline=None)
@given(poses, twists, twists, places)
def test_what_switches_in_and_what_switches_out_never_hold_together(
    pose: np.ndarray, velocity: tuple[float, float], command: tuple[float, float], boxes: list[tuple[float, float]]
) -> None:
    arbiter, map_ = Arbiter(), costmap(boxes)
    inputs = ArbiterInputs(
        robot_pose=pose, robot_velocity=velocity, operator_command=command, costmap=map_, ages={"command": 0.0}
    )
    arbiter.step(inputs, 0)
    snapshot = arbiter.assess(inputs, 0)
    assert snapshot.command == command
    assert not (snapshot.obstacle_ahead and way_free(snapshot))


phases = st.tuples(
    st.integers(1, 30),
    st.sampled_from([FORWARD, NOTHING, (-0.4, 0.0), (0.3, 0.6), (0.0, 0.8)]),
    st.sampled_from(["", "", "", "", "estop", "not ready", "apart", *KEYS]),
)


@settings(max_examples=25, deadline=None)
@given(places, st.lists(phases, min_size=4, max_size=14))
def test_no_flicker_and_no_motion_without_a_source_in_whatever_happens(
    boxes: list[tuple[float, float]], script: list[tuple[int, tuple[float, float], str]]
) -> None:
    made = Drive(costmap(boxes))
    made.drive(0.6, NOTHING)
    for count, command, event in script:
        made.estop, made.apart_m = event == "estop", 0.1 if event == "apart" else 0.0
        made.vspace = Vspace(ready=event != "not ready", ready_radius_m=100.0)
        made.ages = {key: 5.0 if key == event else 0.0 for key in KEYS}
        for _ in range(count):
            before = made.steps[-1].mode
            decision = made.step(command)
            if decision.mode != before:
                assert any((row.source, row.target) == (before, decision.mode) for row in TRANSITIONS)
            if event == "estop":
                assert (decision.mode, decision.command) == (Mode.STOPPED, NOTHING)
            if event in KEYS and any(s.key == event and decision.mode in s.modes for s in SOURCES):
                # What speaks in the virtual space only is missed its time-out after the change.
                late = len(made.steps) - 1 - max(k for k, d in enumerate(made.steps) if d.changed) > 6
                assert decision.command == NOTHING or not (late or event in ("scan", "odometry", "pose", "camera"))
    switch = SwitchConfig()
    stays = made.stays()
    for (mode, lasted), (then, _) in pairwise(stays):
        if (mode, then) == (Mode.VIRTUAL, Mode.RETURNING):
            assert lasted >= switch.min_virtual_s - 1e-9
        if (mode, then) == (Mode.ENTERING, Mode.REAL):
            assert lasted <= entry_patience_s() + 2 * DT
    for (first, _), (real, lasted), (then, _) in zip(stays, stays[1:], stays[2:], strict=False):
        if real == Mode.REAL and then == Mode.ENTERING and first != Mode.STOPPED:
            assert lasted >= switch.min_real_s - 1e-9


def test_the_virtual_space_is_shown_only_once_a_view_of_the_same_place_has_come() -> None:
    made = before_box()
    made.apart_m = 0.03
    made.until(Mode.ENTERING, FORWARD)
    speeds = [d.command[0] for d in made.drive(1.5, FORWARD)]
    assert {d.mode for d in made.steps[-20:]} == {Mode.ENTERING}
    assert all(later <= earlier for earlier, later in pairwise(speeds))  # it slows meanwhile
    assert speeds[-1] < 0.2
    made.apart_m = 0.015
    assert made.step(FORWARD).mode == Mode.VIRTUAL


@pytest.mark.parametrize(
    ("apart_m", "view_after_picture_s", "enters"),
    [
        (0.03, 0.0, False),  # another place
        (0.03, 0.075, True),  # the robot has driven 3 cm in between, at 0.4 m/s
        (0.015, -0.075, False),  # the view is the older one, and yet ahead: 4.5 cm
        (0.05, 0.125, False),  # of one drive, but the eye would see 5 cm
    ],
)
def test_what_the_robot_drives_between_view_and_picture_is_no_jump(
    apart_m: float, view_after_picture_s: float, enters: bool
) -> None:
    made = before_box()
    made.apart_m, made.view_after_picture_s = apart_m, view_after_picture_s
    made.until(Mode.ENTERING, FORWARD)
    assert made.speed[0] == pytest.approx(0.4)
    made.drive(2 * DT, FORWARD)  # it slows later
    assert (made.steps[-1].mode == Mode.VIRTUAL) == enters


@pytest.mark.parametrize("lost", ["view", "apart"])
def test_without_a_fitting_view_the_entry_is_given_up_and_the_robot_stops_before_the_obstacle(lost: str) -> None:
    made = before_box()
    made.apart_m = 0.1 if lost == "apart" else 0.0
    made.ages["view"] = math.inf if lost == "view" else 0.0
    made.until(Mode.ENTERING, FORWARD)
    made.until(Mode.REAL, FORWARD, entry_patience_s() + 0.1)
    assert "No view of the virtual space fits here. Let go" in made.steps[-1].reason
    # Not tried again and again while the key is held.
    changes = made.steps[-1].transitions
    made.drive(8.0, FORWARD)
    assert made.steps[-1].transitions == changes
    assert made.steps[-1].blocked
    assert made.robot[0] + 0.3 < 1.85
    assert not any(d.mode.shows_vbot for d in made.steps)
    made.drive(2 * DT, NOTHING)
    made.until(Mode.ENTERING, FORWARD, 1.0)


def test_an_entry_ends_when_the_operator_turns_away() -> None:
    made = before_box()
    made.apart_m = 0.1
    made.until(Mode.ENTERING, FORWARD)
    made.until(Mode.REAL, (-0.4, 0.0), 0.5)
    made.drive(0.5, FORWARD)
    assert made.steps[-1].mode == Mode.REAL  # for min_real_s


def test_at_the_return_the_vbot_is_eased_onto_the_robot_gently_and_the_operator_drives_the_robot() -> None:
    made = before_box()
    made.until(Mode.VIRTUAL, FORWARD)
    made.map = costmap([])
    made.robot = made.vbot.pose + [-0.1, 0.05, math.radians(-6.0)]
    made.until(Mode.RETURNING, NOTHING)
    made.robot = made.vbot.pose + [-0.12, 0.05, math.radians(-6.0)]
    before, vbot = made.vbot.pose.copy(), VbotConfig()
    while made.step((0.3, 0.0)).mode == Mode.RETURNING:
        after = made.vbot.pose.copy()
        # Its own motion, at most 0.3 m/s, and the drawing.
        assert np.linalg.norm(after[:2] - before[:2]) <= (0.3 + vbot.ease_m_s) * DT + 1e-6
        assert abs(after[2] - before[2]) <= math.radians(vbot.ease_deg_s) * DT + 1e-6
        before = after
    assert made.steps[-1].mode == Mode.REAL
    assert np.linalg.norm(made.vbot.pose[:2] - made.robot[:2]) <= 0.02 + 0.3 * DT
    returning = [d for d in made.steps if d.mode == Mode.RETURNING]
    assert returning[-1].command[0] == pytest.approx(0.3)
    assert 0.5 < len(returning) * DT < SwitchConfig().return_timeout_s


def test_the_robot_is_let_close_up_before_the_return_but_not_waited_for_when_it_does_not() -> None:
    switch = SwitchConfig()
    for gap_m, seconds in ((0.02, switch.return_dwell_s), (0.10, switch.return_patience_s)):
        made = before_box()
        made.until(Mode.VIRTUAL, FORWARD)
        made.drive(switch.min_virtual_s, FORWARD)
        made.map, waited = costmap([]), 0
        for away_m in (0.3, *[gap_m] * 100):  # it stays so far off, whatever its command
            made.robot = made.vbot.pose - [away_m, 0.0, 0.0]
            if made.step(NOTHING).mode == Mode.RETURNING:
                break
            agreed = made.steps[-1].pose_gap_m < 0.15
            waited = waited + 1 if agreed else 0
        assert made.steps[-1].mode == Mode.RETURNING
        assert seconds <= waited * DT <= seconds + 0.3


def test_the_camera_is_not_shown_again_while_the_robot_turns_fast() -> None:
    made = before_box()
    made.until(Mode.VIRTUAL, FORWARD)
    made.map = costmap([])
    made.until(Mode.RETURNING, (0.0, 0.8))
    made.drive(2.0, (0.0, 0.8))
    assert made.steps[-1].mode == Mode.RETURNING
    made.until(Mode.REAL, (0.0, 0.1), 1.0)
    # Not for ever: after return_timeout_s it goes on.
    made = before_box()
    made.until(Mode.VIRTUAL, FORWARD)
    made.map = costmap([])
    made.until(Mode.RETURNING, (0.0, 0.8))
    made.until(Mode.REAL, (0.0, 0.8), SwitchConfig().return_timeout_s + 0.1)


def returning() -> Drive:
    """A robot on its way back to the camera, which view and image do not let it reach yet."""
    made = before_box()
    made.until(Mode.VIRTUAL, FORWARD)
    made.map = costmap([])
    made.apart_m = 0.1
    made.until(Mode.RETURNING, FORWARD)
    return made


def test_a_return_is_broken_off_when_the_command_is_no_longer_safe() -> None:
    made = returning()
    made.map = costmap([(made.robot[0] + 0.9, made.robot[1])])
    assert made.step(FORWARD).mode == Mode.VIRTUAL
    assert made.steps[-1].vbot_action == VbotAction.DRIVEN


def test_a_late_camera_makes_a_return_wait_and_not_switch_back_and_a_lost_one_stops() -> None:
    made = returning()
    made.apart_m = 0.0
    for age_s in (0.31, 0.7, 1.5):
        made.ages["camera"] = age_s
        decision = made.step(FORWARD)
        assert (decision.mode, decision.command) == (Mode.RETURNING, NOTHING)
    made.ages["camera"] = 1.51
    assert made.step(FORWARD).mode == Mode.STOPPED


def test_no_entry_where_the_view_would_be_bad_and_an_unknown_quality_is_none() -> None:
    for psnr, mode in ((9.0, Mode.REAL), (0.0, Mode.ENTERING), (math.nan, Mode.ENTERING), (15.0, Mode.ENTERING)):
        made = before_box()
        made.vspace = Vspace(ready=True, ready_radius_m=100.0, expected_psnr_db=psnr)
        made.drive(4.0, FORWARD)
        assert (Mode.ENTERING in {d.mode for d in made.steps}) == (mode == Mode.ENTERING)
        if mode == Mode.REAL:
            assert "too poorly (9 dB expected, 12 dB needed)" in made.steps[-1].reason


def test_without_views_in_the_virtual_space_both_robots_stand() -> None:
    made = before_box()
    made.until(Mode.VIRTUAL, FORWARD)
    made.drive(0.5, FORWARD)
    made.ages["view"] = 0.36
    decision = made.step(FORWARD)
    assert (decision.command, decision.vbot_action) == (NOTHING, VbotAction.HELD)
    assert "No view of the virtual space for 0.4 s" in decision.reason
    stood = made.drive(0.6, FORWARD) and made.vbot.pose.copy()
    made.drive(0.6, FORWARD)
    np.testing.assert_allclose(made.vbot.pose, stood, atol=1e-9)
    made.ages["view"] = 1.6
    assert made.step(FORWARD).mode == Mode.STOPPED


def test_a_vbot_left_inside_an_obstacle_is_led_back_gently_and_told_and_a_command_ends_it() -> None:
    walls = corridor()
    made = Loop(World(np.concatenate([walls, rectangle(2.5, -0.25, 3.0, 0.25)])), draw_map(walls, (-2, -1.2, 14, 1.2)))
    made.start()
    while made.vbot.pose[0] < 2.6:
        made.step(FORWARD)
    while "The view goes back to the robot in 2 s" not in made.step(NOTHING).decision.reason:
        assert len(made.frames) < 600
    while made.frames[-1].decision.vbot_action != VbotAction.LED_BACK:
        made.step(NOTHING)
    assert made.frames[-1].t - max(f.t for f in made.frames if f.decision.operator_command != NOTHING) >= 5.95
    start, waits = made.vbot.pose.copy(), made.base.pose.copy()
    for _ in range(10):
        frame = made.step(NOTHING)
        assert frame.command == NOTHING
        assert "the view goes back to the robot. Drive to continue" in frame.decision.reason
    assert 0.02 < np.linalg.norm(made.vbot.pose[:2] - start[:2]) <= 0.1
    assert made.step(FORWARD).decision.vbot_action == VbotAction.DRIVEN
    while made.decision.mode.shows_vbot:
        before = made.vbot.pose[:2].copy()
        made.step(NOTHING)
        assert np.linalg.norm(made.vbot.pose[:2] - before) <= (0.4 + 0.12) * DT
        assert len(made.frames) < 1600
    np.testing.assert_allclose(made.base.pose[:2], waits[:2], atol=1.0)
    assert made.decision.mode == Mode.REAL


def test_the_way_back_does_not_lead_through_a_wall() -> None:
    from instant_ic.control.walls import WallMap

    wall = np.array([[[0.5, -3.0], [0.5, 1.0]]])
    walls = WallMap(draw_map(wall, (-4.0, -4.0, 4.0, 4.0)))
    vbot = VirtualRobot(VbotConfig(), Arbiter().config.limits)
    vbot.place(np.array([-0.5, 0.0, math.pi / 2]), NOTHING)
    for yaw, metres in ((math.pi / 2, 2.0), (0.0, 2.0), (-math.pi / 2, 1.5)):  # round the wall's end
        while abs(vbot.pose[2] - yaw) > 0.05 or abs(vbot.velocity[1]) > 0.01:
            vbot.step((0.0, float(np.clip(2.0 * (yaw - vbot.pose[2]), -1.0, 1.0))), vbot.pose, DT)
        for _ in range(round(metres / 0.4 / DT)):
            vbot.step(FORWARD, vbot.pose, DT)
    assert vbot.pose[0] > 1.0 and vbot.pose[1] < 0.9  # behind it
    robot = np.array([-0.5, 0.0, 0.0])
    for _ in range(round(60 / DT)):
        vbot.lead_back(robot, DT, walls)
        assert walls.distance(vbot.pose[:2]) > 0.04
    np.testing.assert_allclose(vbot.pose, robot, atol=0.01)


def test_the_slowest_images_that_may_be_set_have_a_known_rhythm() -> None:
    """An age of 2 s counts as a pause; images that rare would keep the robot from starting, whatever is allowed."""
    with pytest.raises(ValueError, match="slowest_image_s"):
        TimeoutConfig(slowest_image_s=1.6)
    slowest, rhythm = TimeoutConfig(slowest_image_s=1.5).slowest_image_s, Rhythm()
    for _ in range(5):
        rhythm.heard(1.25 * slowest)
    assert math.isfinite(rhythm.usual_s)


def test_a_source_is_late_by_its_own_rhythm() -> None:
    timeouts, rhythm = TimeoutConfig(), Rhythm()
    assert timeouts.allowed_s("camera", rhythm.usual_s) == pytest.approx(0.625)  # not known yet
    for age in (0.1, 0.1, 0.12, 0.1, 7.0, -3.0, 0.1):  # a pause and a clock that was set tell nothing
        rhythm.heard(age)
    assert timeouts.allowed_s("camera", rhythm.usual_s) == pytest.approx(0.3)
    for _ in range(20):
        rhythm.heard(0.33)
    assert timeouts.allowed_s("camera", rhythm.usual_s) == pytest.approx(0.43)
    # Whatever the rhythm, a stop comes within 0.3 s of when the next image was due, up to slowest_image_s.
    for period in np.linspace(0.01, timeouts.slowest_image_s, 50):
        assert timeouts.allowed_s("camera", float(period)) <= period + 0.3
