"""The whole control part in a closed loop with a flat world: the paper's section III.A, and what may go wrong."""

from __future__ import annotations

import copy
import functools
import math
from itertools import pairwise
from pathlib import Path

import diagram
import numpy as np
import pytest
from control_world import Loop, World, corridor, draw_map, rectangle

from instant_ic.control.arbiter import Arbiter
from instant_ic.control.arbiter_config import SwitchConfig
from instant_ic.control.costmap import LETHAL, Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.guards import GUARD_FUNCTIONS
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.prediction import PredictionConfig, Predictor
from instant_ic.control.snapshot import Vspace
from instant_ic.control.states import ACTIONS, GUARDS, SOURCES, TRANSITIONS, Mode

BOX = (2.5, -0.25, 3.0, 0.25)
FORWARD, NOTHING = (0.4, 0.0), (0.0, 0.0)
THROUGH = ["STOPPED", "REAL", "ENTERING", "VIRTUAL", "RETURNING", "REAL"]
DOCS = Path(__file__).resolve().parents[2] / "docs" / "control.md"


def loop(box: tuple[float, float, float, float] | None = BOX, mapped: bool = True, length: float = 16.0) -> Loop:
    """A corridor 2.4 m wide; the box is never in the map, the walls are when ``mapped``."""
    walls = corridor(length)
    world = World(walls if box is None else np.concatenate([walls, rectangle(*box)]))
    made = Loop(world, draw_map(walls, (-2, -1.2, length - 2, 1.2)) if mapped else None)
    made.start()
    return made


def drive(made: Loop, seconds: float, command: tuple[float, float]) -> None:
    for _ in range(round(seconds * 20)):
        frame = made.step(command)
        assert not made.world.contact(frame.robot), f"contact at {frame.t:.2f} s, {frame.robot}"


@pytest.mark.parametrize(
    ("box", "mapped"),
    [(BOX, True), ((2.5, -1.2, 3.0, 0.1), False)],
)
def test_through_the_box_and_back(box: tuple[float, float, float, float], mapped: bool) -> None:
    made = loop(box, mapped)
    drive(made, 23.0, FORWARD)
    assert made.modes() == THROUGH
    virtual = [f for f in made.frames if f.decision.mode == Mode.VIRTUAL]
    # The v-bot starts where the r-bot was when the picture was taken and goes straight through; the r-bot goes round.
    np.testing.assert_allclose(virtual[0].decision.vbot_start, virtual[0].robot, atol=0.07)
    inside = [f for f in virtual if box[0] < f.vbot[0] < box[2] and box[1] < f.vbot[1] < box[3]]
    assert len(inside) > 10
    assert max(abs(f.robot[1]) for f in virtual) > 0.4
    # At both switches view and picture are of the same place; in between the operator was obeyed.
    for before, after in pairwise(made.frames):
        if before.decision.mode.shows_vbot != after.decision.mode.shows_vbot:
            # Of the same place, less what the robot drives between the two: they come a step apart.
            assert np.linalg.norm(after.view[:2] - after.picture[:2]) <= 0.015 + 0.4 * 0.05
            assert abs(after.vbot[2] - after.robot[2]) <= math.radians(0.5)
    assert min(made.vbot.limits.max_linear_m_s, 0.4) == pytest.approx(made.frames[-1].command[0])
    moved = np.linalg.norm(np.diff([f.decision.vbot_pose[:2] for f in virtual], axis=0), axis=1)
    assert 0.355 < np.mean(moved[20:]) / 0.05 <= 0.4  # a tenth slower while the r-bot trails it


@pytest.mark.parametrize(
    ("vspace", "words"),
    [
        (Vspace(ready=False, message="training 1.2 s"), "not ready (training 1.2 s)"),
        (Vspace(ready=True, position=np.array([-1.0, 0.0]), ready_radius_m=1.5), "valid within 1.5 m of its keyframe"),
    ],
)
def test_without_a_virtual_space_the_robot_stops_and_says_why(vspace: Vspace, words: str) -> None:
    made = loop()
    made.vspace = vspace
    drive(made, 10.0, FORWARD)
    assert made.modes() == ["STOPPED", "REAL"]
    end = made.frames[-1]
    assert end.decision.blocked
    assert words in end.decision.reason
    assert end.command == NOTHING
    assert 2.0 < end.robot[0] + 0.30 < 2.5  # near the face at 2.5, not touching
    made.vspace = Vspace(ready=True, ready_radius_m=100.0)
    drive(made, 1.0, FORWARD)
    assert made.modes()[-1] == "VIRTUAL"


@pytest.mark.parametrize(
    ("box", "length", "words"),
    [(None, 6.0, "A wall is in the way"), ((2.5, -1.2, 3.0, 0.8), 16.0, "no way round")],
)
def test_where_the_robot_cannot_follow_there_is_no_switch(
    box: tuple[float, float, float, float] | None, length: float, words: str
) -> None:
    made = loop(box, length=length)
    drive(made, 14.0, FORWARD)
    assert made.modes() == ["STOPPED", "REAL"]
    assert words in made.frames[-1].decision.reason
    assert made.frames[-1].command == NOTHING


def test_a_post_in_the_blind_zone_is_remembered() -> None:
    """Seen from afar, then nearer than the LiDAR can see: turning would strike it with a corner."""
    made = Loop(World(np.concatenate([corridor(), rectangle(1.0, 0.35, 1.06, 0.41)])), None)
    made.vspace = Vspace(ready=False)
    made.start()
    while made.base.pose[0] < 0.93:
        drive(made, 0.05, FORWARD)
    drive(made, 1.0, NOTHING)
    post = np.array([1.03, 0.38]) - made.base.pose[:2]
    assert np.linalg.norm(post) < 0.40  # abreast: not in the scan any more
    assert len(made.costmap.lethal_near(made.base.pose, 0.45)) > 0
    drive(made, 4.0, (0.0, 0.8))
    assert abs(made.base.pose[2]) < 0.5
    assert made.frames[-1].decision.blocked
    # The collision monitor alone, as in virtual mode, holds too.
    points = made.costmap.lethal_near(made.base.pose, 0.45)
    assert made.arbiter.rules.monitor.limit((0.0, 0.8), points).action != "free"


def test_side_walls_block_but_let_go() -> None:
    made = loop(None)
    drive(made, 12.0, (0.4, 0.1))
    assert made.modes() == ["STOPPED", "REAL"]
    assert made.frames[-1].decision.blocked
    before = made.base.pose.copy()
    drive(made, 3.0, (-0.3, 0.0))
    assert np.linalg.norm(made.base.pose[:2] - before[:2]) > 0.5


def test_tapping_forward_before_the_obstacle_does_not_flicker() -> None:
    made = loop()
    for _ in range(28):
        drive(made, 0.3, FORWARD)
        drive(made, 0.5, NOTHING)
    assert made.modes() == THROUGH[:4]


def test_stopping_inside_the_obstacle_the_robot_waits_and_goes_on() -> None:
    made = in_virtual()
    drive(made, 5.5, NOTHING)
    assert BOX[0] < made.vbot.pose[0] < BOX[2]
    waiting = made.frames[-1]
    assert waiting.decision.mode == Mode.VIRTUAL
    assert waiting.speed == pytest.approx(0.0, abs=0.01)
    drive(made, 17.0, FORWARD)
    assert made.modes() == THROUGH


def test_turning_away_before_the_obstacle_gives_the_real_view_back() -> None:
    made = loop()
    drive(made, 4.6, FORWARD)
    assert made.modes()[-1] == "VIRTUAL"
    drive(made, 3.0, (0.0, 0.8))
    drive(made, 16.0, NOTHING)
    assert made.modes() == THROUGH


@functools.cache
def _virtual() -> Loop:
    made = loop()
    drive(made, 7.0, FORWARD)
    return made


def in_virtual() -> Loop:
    """A loop after 7 s of driving forward, in VIRTUAL."""
    return copy.deepcopy(_virtual())


@pytest.mark.parametrize("key", [source.key for source in SOURCES if Mode.VIRTUAL in source.modes])
def test_each_source_lost_while_virtual_holds_then_stops(key: str) -> None:
    made = in_virtual()
    timeout = getattr(TimeoutConfig(), key)
    made.ages[key] = timeout + 0.01
    frame = made.step(FORWARD)
    assert (frame.decision.mode, frame.command) == (Mode.VIRTUAL, NOTHING)
    made.ages[key] = max(1.5, timeout) + 0.01
    assert made.step(FORWARD).decision.mode == Mode.STOPPED


def test_a_lost_operator_makes_the_robot_wait_in_virtual_mode_and_then_stop() -> None:
    made = in_virtual()
    assert made.frames[-1].command != NOTHING
    for age in (0.31, 1.5):
        made.ages["command"] = age
        frame = made.step(NOTHING)
        assert (frame.decision.mode, frame.command) == (Mode.VIRTUAL, NOTHING)
        assert frame.decision.reason == "The operator's link is lost. The robot has stopped."
    # Back in time, hands off: the robot closes up again.
    made.ages["command"] = 0.0
    drive(made, 0.5, NOTHING)
    assert made.frames[-1].command != NOTHING
    made.ages["command"] = 1.51
    assert made.step(NOTHING).decision.mode == Mode.STOPPED
    drive(made, 5.0, NOTHING)  # nobody is there: it stays so
    assert made.frames[-1].decision.mode == Mode.STOPPED
    assert made.frames[-1].decision.reason == "The operator's link is lost. The robot has stopped."
    made.ages["command"] = 0.0
    drive(made, 0.5, FORWARD)
    assert made.frames[-1].decision.mode == Mode.STOPPED  # back, but with a key held
    drive(made, 0.15, NOTHING)
    assert made.frames[-1].decision.mode == Mode.REAL


@pytest.mark.parametrize(("last", "resumes"), [(NOTHING, True), (FORWARD, False)])
def test_a_silent_operator_is_harmless_in_real_mode_and_counts_as_hands_off_after_a_zero_alone(
    last: tuple[float, float], resumes: bool
) -> None:
    made = loop(None)
    drive(made, 1.0, FORWARD)
    made.ages["command"] = math.inf
    drive(made, 5.0, last)
    assert made.frames[-1].decision.mode == Mode.REAL
    assert made.frames[-1].command == NOTHING
    assert made.frames[-1].decision.operator_command == NOTHING
    made.ages["scan"] = 1.6
    assert made.step(last).decision.mode == Mode.STOPPED
    made.ages["scan"] = 0.0
    drive(made, 1.0, last)
    assert (made.frames[-1].decision.mode == Mode.REAL) is resumes


@pytest.mark.parametrize("cause", ["camera", "estop"])
def test_fault_a_gap_in_the_commands_of_a_held_key_starts_a_stopped_robot(cause: str) -> None:
    made = loop(None)
    drive(made, 1.0, FORWARD)
    if cause == "estop":
        made.estop = True
    made.ages["camera"] = 1.6
    assert made.step(FORWARD).decision.mode == Mode.STOPPED
    made.ages["camera"], made.estop = 0.0, False
    drive(made, 1.0, FORWARD)  # held: it stays stopped
    for _ in range(3):
        made.ages["command"] = 0.4
        drive(made, 0.5, FORWARD)
        made.ages["command"] = 0.0
        drive(made, 0.5, FORWARD)
        assert made.frames[-1].decision.mode == Mode.STOPPED
        assert made.frames[-1].command == NOTHING
    drive(made, 0.2, NOTHING)
    drive(made, 1.0, FORWARD)
    assert made.frames[-1].decision.mode == Mode.REAL


@functools.cache
def seconds_to_entry() -> float:
    probe = loop((3.0, -0.25, 3.5, 0.25))
    while probe.modes()[-1] != "ENTERING":
        drive(probe, 0.05, FORWARD)
    return len(probe.frames) * 0.05


@pytest.mark.parametrize(
    ("training_s", "position", "training", "enters"),
    [
        (0.0, 0.0, True, True),
        (1.0, 0.0, True, True),  # learns the next keyframe for a moment
        (1.0, -4.0, True, False),  # but the robot has left the last one's radius
        (3.0, 0.0, True, False),  # learns for longer than ready_hold_s
        (1.0, 0.0, False, False),  # empty: its node was started anew
    ],
)
def test_readiness_is_held_over_the_change_of_a_keyframe(
    training_s: float, position: float, training: bool, enters: bool
) -> None:
    made = loop((3.0, -0.25, 3.5, 0.25))
    made.vspace = Vspace(ready=True, position=np.array([position, 0.0]), ready_radius_m=4.0)
    other = Vspace(training=training, position=np.array([50.0, 0.0]), message="learning")
    # By the time of the switch with a space that is ready all the time.
    drive(made, seconds_to_entry() - len(made.frames) * 0.05 - training_s - 0.05, FORWARD)
    if training_s:
        made.vspace = other
    drive(made, training_s + 0.1, FORWARD)
    assert ("ENTERING" in made.modes()) == enters


def test_a_failed_virtual_space_gives_the_real_view_back_by_way_of_a_stop() -> None:
    made = in_virtual()
    made.vspace = Vspace(failed=True, message="out of memory")
    frame = made.step(FORWARD)
    assert frame.decision.mode == Mode.STOPPED
    assert "out of memory" in frame.decision.reason
    drive(made, 1.0, NOTHING)
    assert made.frames[-1].decision.mode == Mode.REAL


def test_the_vbot_waits_for_a_robot_that_cannot_follow() -> None:
    made = in_virtual()
    held = made.base.pose.copy()
    made.base.step = lambda command, dt: None  # type: ignore[method-assign]  # tracks off the ground
    drive(made, 20.0, (0.5, 0.0))
    assert 2.5 < np.linalg.norm(made.vbot.pose[:2] - held[:2]) <= 3.0


def test_box_that_the_path_only_grazes_makes_one_switch_each_way() -> None:
    """The robot's half width is 0.25 m: with noise, a way along the box's edge is now free and now not."""
    walls = corridor()
    world = World(np.concatenate([walls, rectangle(2.5, 0.22, 3.0, 0.72)]))
    made = Loop(world, draw_map(walls, (-2, -1.2, 14, 1.2)), noise=np.random.default_rng(4))
    made.start()
    drive(made, 26.0, FORWARD)
    assert made.modes() == THROUGH


def test_way_back_must_be_wider_than_the_robot() -> None:
    costs = np.zeros((80, 80), np.uint8)
    costs[46:50, 30:34] = LETHAL  # x 1.5..1.7, y 0.3..0.5: the robot's side passes 0.05 m from it
    costmap = Costmap(costs, 0.05, np.array([0.0, -2.0]))
    predictor = Predictor(PredictionConfig(padding_m=0.0), MotionLimits(), Footprint())
    start, speed = np.array([0.5, 0.0, 0.0]), (0.4, 0.0)
    assert predictor.predict(start, speed, speed, costmap, extra_m=1.0).hit_index is None
    assert predictor.predict(start, speed, speed, costmap, extra_m=1.0, side_m=0.12).hit_index is not None


def test_speed_that_the_base_cannot_drive_does_not_lengthen_the_look_ahead() -> None:
    predictor = Predictor(PredictionConfig(), MotionLimits(), Footprint())
    start, command = np.zeros(3), (0.28, 0.0)
    fastest = predictor.predict(start, (MotionLimits().max_linear_m_s, 0.0), command, None)
    spike = predictor.predict(start, (5.0, 0.0), command, None)
    assert spike.poses == pytest.approx(fastest.poses)
    # 0.5 m/s: 0.1 m of latency, 0.156 m of braking at 0.8 m/s², 0.6 m of margin.
    assert spike.poses[-1, 0] == pytest.approx(0.856, abs=0.03)


def test_at_the_return_the_way_is_free_beyond_the_horizon_that_switches_in() -> None:
    made = loop()
    drive(made, 23.0, FORWARD)
    (back,) = [f for f in made.frames if f.decision.changed and f.t > 3.0 and f.decision.mode == Mode.REAL]
    predictor, switch = made.arbiter.predictor, SwitchConfig()
    speed = (back.speed, 0.0)
    free = predictor.predict(back.robot, speed, FORWARD, made.costmap, switch.return_margin_m)
    assert free.hit_index is None
    longest = free.poses[-1, 0] - back.robot[0]
    entering = predictor.predict(back.robot, speed, FORWARD, made.costmap)
    assert longest - (entering.poses[-1, 0] - back.robot[0]) == pytest.approx(0.5, abs=0.03)
    with pytest.raises(ValueError, match="return_margin_m"):
        SwitchConfig(return_margin_m=0.0)


class TestTable:
    def test_every_guard_and_action_is_explained_and_there(self) -> None:
        assert {row.guard for row in TRANSITIONS} == set(GUARDS) == set(GUARD_FUNCTIONS)
        assert {row.action for row in TRANSITIONS} == set(ACTIONS) == set(Arbiter()._actions)

    def test_every_moving_state_can_be_stopped_first(self) -> None:
        stops = ["estop_pressed", "interrupted", "source_lost", "pose_lost", "contradicted"]
        for mode in set(Mode) - {Mode.STOPPED}:
            rows = [row for row in TRANSITIONS if row.source == mode]
            assert [(row.guard, row.target) for row in rows[:5]] == [(guard, Mode.STOPPED) for guard in stops]

    @pytest.mark.parametrize("text", [diagram.state_diagram(), diagram.guard_table(), diagram.source_table()])
    def test_the_docs_show_the_table_as_it_is(self, text: str) -> None:
        assert text in DOCS.read_text(), "docs/control.md is old: print the tables of tests/control/diagram.py into it"
