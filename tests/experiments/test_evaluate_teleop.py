"""``ic evaluate teleop``: figures from logs written by hand, its worlds and operators, and a drive by each method."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.cli.main import main
from instant_ic.control.states import Mode
from instant_ic.experiments import teleop, teleop_figures, teleop_worlds
from instant_ic.experiments.teleop_figures import DriveLog, Shown, Switch, TeleopDrive
from instant_ic.experiments.teleop_operator import ScriptedOperator, Sight
from instant_ic.experiments.teleop_plot import save_plot
from instant_ic.experiments.teleop_stack import SimulatedStack, StackConfig
from instant_ic.sim.contact import OccupancyMask


def log_of(speeds: list[float], commands: list[float], virtual: list[bool] | None = None) -> DriveLog:
    """A straight drive: forward m/s of the shown robot and of the command, each twentieth of a second."""
    virtual = virtual or [False] * len(speeds)
    x = 0.05 * np.concatenate([[0.0], np.cumsum(speeds)])[: len(speeds)]
    log = DriveLog()
    for k, place in enumerate(x):
        pose = np.array([place, 0.0, 0.0])
        log.time_s.append(0.05 * k)
        log.mode.append(int(Mode.VIRTUAL if virtual[k] else Mode.REAL))
        log.virtual.append(virtual[k])
        for track in (log.robot, log.estimate, log.vbot):
            track.append(pose.copy())
        log.yaw_gap_rad.append(0.0)
        log.command.append((commands[k], 0.0))
        log.blocked.append(False)
        log.reason.append("")
    return log


def ramp(n: int, late: int = 0) -> list[float]:
    """0.4 m/s from a stand at 0.8 m/s², which takes 10 steps; ``late`` steps after the command."""
    return [min(0.4, 0.04 * max(0, k + 1 - late)) for k in range(n)]


def photo(time_s: float, x: float, virtual: bool, came_s: float | None = None) -> Shown:
    return Shown(
        time_s, time_s if came_s is None else came_s, virtual, np.array([x, 0.0, 0.0]), np.array([x, 0.0]), 0.0
    )


class TestObedience:
    def test_a_robot_that_follows_its_ramps_obeys_also_when_it_is_late(self) -> None:
        for late in (0, 3):  # 0.15 s
            assert teleop_figures.obedience(log_of(ramp(60, late), [0.4] * 60)) == 1.0

    def test_a_robot_that_stands_does_not(self) -> None:
        # 20 steps of obedience, then 40 of standing under the command: once the last 0.35 s ask for full speed.
        share = teleop_figures.obedience(log_of(ramp(20) + [0.0] * 40, [0.4] * 60))
        assert share == pytest.approx(18 / 58, abs=0.02)  # of the rows between the first and the last

    def test_half_the_speed_is_no_obedience_and_five_per_cent_slip_is(self) -> None:
        half = log_of([0.2] * 60, [0.4] * 60)
        assert teleop_figures.obedience(half) < 0.2  # but for the ramp's moments
        slipping = log_of([0.95 * v for v in ramp(60)], [0.4] * 60)
        assert teleop_figures.obedience(slipping) == 1.0

    def test_only_time_under_command_counts(self) -> None:
        assert math.isnan(teleop_figures.obedience(log_of([0.0] * 20, [0.0] * 20)))

    def test_a_switch_is_no_motion(self) -> None:
        log = log_of(ramp(60), [0.4] * 60, [False] * 30 + [True] * 30)
        for k in range(30, 60):
            log.vbot[k][0] += 5.0  # the other robot is elsewhere: a jump of 5 m is no speed of 100 m/s
        assert np.nanmax(np.abs(teleop_figures.shown_speeds(log)[:, 0])) < 0.5
        assert teleop_figures.obedience(log) == 1.0


class TestSwitches:
    def test_each_change_of_the_picture_and_how_far_it_jumps(self) -> None:
        log = log_of([0.4] * 60, [0.4] * 60, [False] * 20 + [True] * 20 + [False] * 20)
        # 0.4 m/s: between pictures 0.1 s apart the eye expects 4 cm. It gets 5 cm, and on the way back 1 cm.
        # That one had come 0.05 s before already, when it was 2 cm less to expect: it is 1 cm off.
        log.pictures = [photo(0.9, 0.36, False), photo(1.0, 0.41, True), photo(1.9, 0.76, True)]
        log.pictures.append(photo(2.0, 0.77, False, came_s=1.95))
        into, back = teleop_figures.find_switches(log)
        assert (into.to_virtual, back.to_virtual) == (True, False)
        assert into.position_error_m == pytest.approx(0.01, abs=1e-6)
        assert back.position_error_m == pytest.approx(0.01, abs=1e-6)
        assert into.yaw_error_deg == 0.0

    def test_without_pictures_the_jump_is_not_known(self) -> None:
        (switch,) = teleop_figures.find_switches(log_of([0.0] * 4, [0.0] * 4, [False, False, True, True]))
        assert math.isnan(switch.position_error_m)

    def test_yaw_error_is_that_between_the_robots(self) -> None:
        log = log_of([0.0] * 4, [0.0] * 4, [False, False, True, True])
        log.yaw_gap_rad[1] = math.radians(-3.0)  # afterwards the v-bot is another's: driven, or set beside the r-bot
        (switch,) = teleop_figures.find_switches(log)
        assert switch.yaw_error_deg == pytest.approx(3.0)

    def test_flicker_is_what_is_taken_back_at_once(self) -> None:
        def at(time_s: float, to_virtual: bool) -> Switch:
            return Switch(time_s, to_virtual, 0.0, 0.0)

        calm = [at(1.0, True), at(9.0, False), at(20.0, True), at(30.0, False)]
        assert teleop_figures.count_flicker(calm) == 0
        assert teleop_figures.count_flicker([*calm, at(31.5, True), at(32.0, False)]) == 2

    def test_the_longest_a_picture_stays(self) -> None:
        pictures = [photo(t, 0.0, False) for t in (1.0, 1.2, 1.4, 2.1, 2.3)]
        assert teleop_figures.longest_freeze_s(pictures, 2.4) == pytest.approx(0.7)
        assert teleop_figures.longest_freeze_s(pictures, 4.0) == pytest.approx(1.7)  # it never came back

    def test_a_stall_is_standing_under_command(self) -> None:
        log = log_of(ramp(20) + [0.0] * 30, [0.4] * 40 + [0.0] * 10)
        assert teleop_figures.longest_stall_s(log) == pytest.approx(1.0, abs=0.1)

    def test_obstacles_met(self) -> None:
        log = log_of([0.4] * 60, [0.4] * 60)  # to x = 1.2
        assert teleop_figures.obstacles_met(log, np.array([[2.0, 0.0], [2.6, 0.0], [0.0, 5.0]])) == 1


def test_summary_by_hand() -> None:
    def drive(index: int, method: str, seconds: float, completed: bool, switches: int) -> TeleopDrive:
        made = [Switch(float(k), k % 2 == 0, 0.01 * (k + 1), 0.1, 20.0 + k) for k in range(switches)]
        return TeleopDrive(
            index, method, completed, seconds=seconds, way_m=8.0, driven_m=8.8, obstacles=1,
            obedience=1.0 - 0.1 * index, switches=made, mode_seconds={"real": seconds}, gap_max_m=math.nan,
        )  # fmt: skip

    ic = [drive(0, "ic", 20.0, True, 2), drive(1, "ic", 60.0, True, 2)]
    stop = [drive(0, "stop", 30.0, True, 0), drive(1, "stop", 90.0, False, 0)]
    figures = teleop_figures.summary(ic)
    assert figures["obedience"] == pytest.approx((20 * 1.0 + 60 * 0.9) / 80)  # by time
    assert figures["switches_per_obstacle"] == 1.0 == figures["switches_to_virtual_per_obstacle"]
    assert figures["switch_position_error_m"] == 0.02  # the worst
    assert figures["switch_psnr_db"] == 20.5
    met = teleop_figures.targets(figures)
    assert met["switch_position_error_m <= 0.02"] and met["contacts == 0"] and not met["obedience >= 0.98"]
    standing = teleop_figures.summary(stop)
    assert standing["switches_per_obstacle"] == 0.0 and standing["switch_psnr_db"] is None
    assert not teleop_figures.targets(standing)["one switch each way an obstacle"]
    settings = teleop.TeleopSettings(episodes=2, methods=("ic", "stop"))
    assert teleop_figures.targets(standing)["switch_position_error_m <= 0.02"] is None  # there was no switch
    told = json.loads(json.dumps(teleop.report(ic + stop, settings), allow_nan=False))
    assert set(told["methods"]) == {"ic", "stop"} and len(told["each"]) == 4 and "tracks" not in told["each"][0]


def test_without_obstacles_nothing_is_divided_by_them() -> None:
    figures = teleop_figures.summary([TeleopDrive(0, "ic", True, seconds=9.0, way_m=0.0, driven_m=3.0)])
    assert figures["switches_per_obstacle"] is None and figures["path_ratio_mean"] is None
    met = teleop_figures.targets(figures)
    assert met["one switch each way an obstacle"] is None and met["contacts == 0"] is True


class TestWorlds:
    def test_corridors_are_passable_and_their_obstacles_in_the_way(self) -> None:
        for index in range(3):
            course = teleop_worlds.make_course("corridors", 7, index)
            plan = teleop_worlds.floor_plan(course.world)
            points = [np.array(course.world.spawn[:2]), *course.goals]
            assert teleop_worlds.route(plan, np.zeros(3), course.goals, teleop_worlds.SPARE_M) is not None
            for one in course.obstacles:
                # The line that the operator drives meets its circle, give or take half the robot's width.
                ways = [(a, b - a) for a, b in pairwise(points)]
                off = min(
                    float(np.linalg.norm(a + d * np.clip(d @ ([one.x, one.y] - a) / (d @ d), 0, 1) - [one.x, one.y]))
                    for a, d in ways
                )
                assert off < 0.25
        again = teleop_worlds.make_course("corridors", 7, 2)
        assert again.obstacles == course.obstacles and np.array_equal(again.goals, course.goals)

    def test_in_another_world_he_drives_straight_on_to_the_wall(self) -> None:
        course = teleop_worlds.make_course("corridor", 0, 0)
        # The corridor's far wall is at 12 m, what is seen as wall begins at 11.15 (a poster's edge or the wall itself).
        assert course.goals[0] == pytest.approx([9.9, 0.0], abs=0.2)
        (box,) = course.obstacles
        assert (box.x, box.y) == pytest.approx((4.25, 0.0), abs=0.06)


def sight(time_s: float, pose: tuple[float, float, float], speed: float = 0.4, **given: bool) -> Sight:
    here = np.array(pose)
    return Sight(time_s, here, given.get("virtual", False), given.get("stopped", False), (speed, 0.0), here)


class TestOperator:
    plan = OccupancyMask(np.zeros((200, 400), bool), np.array([-1.0, -2.0]), 0.025)

    def test_he_turns_to_the_goal_then_drives_and_lets_go_there(self) -> None:
        he = ScriptedOperator(np.array([[4.0, 0.0]]), self.plan)
        assert he.command(sight(0.0, (0.0, 0.0, 0.0))) == (0.4, 0.0)
        assert he.command(sight(0.1, (0.0, 0.0, -1.0))) == (0.0, 0.8)
        assert he.command(sight(0.2, (3.9, 0.0, 0.0))) == (0.0, 0.0) and he.done

    def test_held_up_he_looks_backs_off_and_drives_round(self) -> None:
        he = ScriptedOperator(np.array([[4.0, 0.0]]), self.plan)
        commands = [he.command(sight(0.05 * k, (1.0, 0.0, 0.0), speed=0.0)) for k in range(80)]
        assert commands[25] == (0.4, 0.0) and commands[40][0] == -0.2 and he.detours == 1
        # In the virtual space he pushes on: there is nothing to see.
        he = ScriptedOperator(np.array([[4.0, 0.0]]), self.plan)
        assert all(he.command(sight(0.05 * k, (1.0, 0.0, 0.0), 0.0, virtual=True))[0] == 0.4 for k in range(80))

    def test_he_gives_up_at_last(self) -> None:
        he = ScriptedOperator(np.array([[4.0, 0.0]]), self.plan)
        for k in range(1000):
            he.command(sight(0.05 * k, (1.0, 0.0, 0.0), speed=0.0))
        assert he.gave_up and he.detours == 5

    def test_stopped_he_lets_go(self) -> None:
        he = ScriptedOperator(np.array([[4.0, 0.0]]), self.plan)
        assert he.command(sight(0.0, (0.0, 0.0, 0.0), stopped=True)) == (0.0, 0.0)
        assert he.command(sight(0.5, (0.0, 0.0, 0.0))) == (0.0, 0.0)
        assert he.command(sight(1.1, (0.0, 0.0, 0.0))) == (0.4, 0.0)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--episodes", "0"], "episodes must be at least 1"),
        (["--methods", "ic,magic"], "method must be one of"),
        (["--world", "nowhere"], "neither corridor"),
        (["--jobs", "0"], "jobs must be at least 1"),
        (["-p", "no_node.key:=1"], "expected NODE.KEY:=VALUE"),
        (["-p", "arbiter.no_key:=1"], "unknown parameter 'no_key'"),
        (["--json", "/no/such/folder/out.json"], "does not exist"),
    ],
)
def test_wrong_words_are_told(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "teleop", "--episodes", "1", "--jobs", "1", *words]) in (1, 2)
    assert told in " ".join(capsys.readouterr().err.split())


@pytest.fixture(scope="module")
def short_course() -> teleop_worlds.Course:
    """The simulator's corridor, its box 4 m ahead; half a metre of it."""
    world = teleop_worlds.make_course("corridor", 0, 0).world
    return teleop_worlds.Course(world, np.array([[0.7, 0.0]]), ())


@pytest.mark.parametrize("method", ["ic", "stop"])
def test_each_method_drives(method: str, short_course: teleop_worlds.Course, tmp_path: Path) -> None:
    settings = teleop.TeleopSettings(episodes=1, world="corridor", depth="lidar", methods=(method,), pictures=False)
    stacks: list[SimulatedStack] = []

    def make_stack(world: teleop_worlds.World, config: StackConfig) -> SimulatedStack:
        stacks.append(SimulatedStack(world, config))
        return stacks[-1]

    (drive,) = teleop.run_episode(settings, 0, None, (method,), make_stack, short_course)
    save_plot(tmp_path / "drive.png", [drive], settings)
    assert cv2.imread(str(tmp_path / "drive.png")).std() > 10
    assert drive.completed and drive.contacts == 0 and not drive.switches
    assert 1.0 < drive.seconds < 4.0
    # He lets go where the picture, 0.2 s old, is 0.25 m before the goal; then come the command's way and braking.
    assert drive.driven_m == pytest.approx(0.75, abs=0.15)
    assert drive.obedience > 0.9
    assert drive.longest_freeze_s < 0.35 and (drive.keyframes > 0) == (method == "ic")
    nodes = set(stacks[0].nodes)
    assert {"crawler_base", "vlp16_driver", "grid_slam", "arbiter", "navigator", "console"} <= nodes
    assert ("nerf" in nodes) == (method == "ic")


def test_the_stack_refuses_what_it_cannot_run() -> None:
    with pytest.raises(ValueError, match="method must be one of ic, stop"):
        StackConfig(method="magic")


def test_the_camera_s_images_have_the_size_of_its_preview(short_course: teleop_worlds.Course) -> None:
    words = ("theta_camera.theta.width:=640", "theta_camera.theta.height:=320", "theta_camera.theta.rate_hz:=8")
    with SimulatedStack(short_course.world, StackConfig(overrides=words)) as stack:
        image = cv2.imdecode(np.frombuffer(stack.photo_jpeg(), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (320, 640, 3)


def test_a_command_reaches_the_base_late(short_course: teleop_worlds.Course) -> None:
    config = StackConfig(method="stop", command_latency_s=(0.2, 0.2))
    with SimulatedStack(short_course.world, config) as stack:
        while stack.state is None or stack.state.mode != Mode.REAL:
            stack.step(lambda: (0.0, 0.0))
            assert stack.time_s < 5.0
        began = stack.time_s
        while stack.robot[0] < 0.005:
            stack.step(lambda: (0.4, 0.0))
            assert stack.time_s < began + 2.0
        assert stack.time_s - began > 0.25
