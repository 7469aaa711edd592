"""One switch each way for each obstacle, however rare, late or uneven images and scans are. All in simulated time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from rate_world import FORWARD, NOTHING, Rates, RateWorld

from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.kinematics import MotionLimits
from instant_ic.msg import ControlState, twist_values
from instant_ic.util import pace

BOX = (2.2, -0.25, 2.7, 0.25)
THROUGH = ["STOPPED", "REAL", "ENTERING", "VIRTUAL", "RETURNING", "REAL"]


@pytest.fixture
def world() -> Iterator[Callable[..., RateWorld]]:
    """Makes worlds that are let drive."""
    made: list[RateWorld] = []

    def make(boxes: tuple[tuple[float, float, float, float], ...] = (BOX,), **rates: float) -> RateWorld:
        made.append(RateWorld(list(boxes), Rates(**rates)))
        assert made[-1].drive(NOTHING, 12.0, lambda: made[-1].modes[-1:] == ["REAL"]), made[-1].state.reason
        return made[-1]

    yield make
    for one in made:
        one.close()


def into_virtual(world: RateWorld) -> None:
    assert world.drive(FORWARD, 20.0, lambda: world.modes[-1] == "VIRTUAL"), world.changes


@pytest.mark.parametrize(
    "rates",
    [
        {"camera_hz": 30},
        {"camera_hz": 1, "view_hz": 1},
        {"camera_hz": 5, "view_hz": 1.2, "view_delay_s": 0.8},
        {"camera_hz": 15, "camera_delay_s": 0.8, "view_delay_s": 0.3, "jitter": 0.5},
        {"camera_hz": 10, "lost": 0.15, "seed": 2},  # no three views in a row are lost
        {"camera_hz": 5, "view_delay_s": 0.2, "jitter": 0.5, "scan_jitter_s": 0.1, "stall_s": 0.8},
    ],
    ids=lambda rates: " ".join(f"{key}={value}" for key, value in rates.items()),
)
def test_one_switch_each_way_at_every_rate(world: Callable[..., RateWorld], rates: dict[str, float]) -> None:
    made = world(**rates)
    made.drive(FORWARD, 60.0, lambda: made.modes[-1] in ("REAL", "STOPPED") and len(made.modes) > 2)
    assert made.modes == THROUGH, made.changes
    made.drive(FORWARD, 1.0)
    assert made.modes == THROUGH, made.changes
    assert not made.contact
    assert made.base.pose[0] > BOX[2]  # round the box, not back


def test_nothing_depends_on_the_pace_of_the_process(world: Callable[..., RateWorld]) -> None:
    """Every threshold is in the stack's time: at another pace of the machine's clock the same happens, bit for bit."""
    as_always = world(camera_hz=5)
    into_virtual(as_always)
    try:
        pace.use(pace.Pace.from_now(0.02))
        paced = world(camera_hz=5)
        into_virtual(paced)
    finally:
        pace.use(pace.Pace())
    assert [(s.mode, s.reason, twist_values(s.applied_command)) for s in paced.states] == [
        (s.mode, s.reason, twist_values(s.applied_command)) for s in as_always.states
    ]


@pytest.mark.parametrize("camera_hz", [1, 3, 30])
def test_a_lost_camera_stops_the_robot_by_its_own_rhythm_and_within_a_bounded_distance(
    world: Callable[..., RateWorld], camera_hz: float
) -> None:
    made = world(boxes=(), camera_hz=camera_hz)
    made.drive(FORWARD, 3.0)
    assert made.base.v > 0.2  # driveable, without a stop at each image
    assert all(speed > 0.2 for t, speed in made.speeds if t > made.time_s - 1.5)
    limit_m_s = TimeoutConfig().image_travel_m / TimeoutConfig().allowed_s("camera", 1.0 / camera_hz)
    assert made.base.v <= min(FORWARD[0], limit_m_s) + 0.01
    # A slow camera slows the robot, and the operator reads why.
    assert (f"one camera image in {1 / camera_hz:.1f} s" in made.state.reason) == (limit_m_s < FORWARD[0])
    # Right after an image: the next never comes.
    newest = made.console.feed.display.image_stamp_ns
    assert made.run(1.5 / camera_hz + 0.1, lambda: made.console.feed.display.image_stamp_ns != newest)
    made.silent.add("camera")
    began_s, began_x = made.time_s, made.base.pose[0]
    assert made.run(2.0, lambda: twist_values(made.state.applied_command) == NOTHING)
    assert made.time_s - began_s <= TimeoutConfig().allowed_s("camera", 1.0 / camera_hz) + 0.06  # a step
    assert made.state.reason_code == ControlState.REASON_CAMERA_STALE
    assert made.run(3.0, lambda: made.modes[-1] == "STOPPED")
    # What is driven on one image, and then the base's latency and its braking.
    travel_m, speed = TimeoutConfig().image_travel_m, FORWARD[0]
    braking_m = speed * 0.15 + speed**2 / (2 * MotionLimits().max_linear_accel_m_s2)
    assert made.base.pose[0] - began_x <= travel_m + braking_m


def test_a_camera_that_becomes_slow_slows_the_robot_after_two_late_images(world: Callable[..., RateWorld]) -> None:
    made = world(boxes=(), camera_hz=5)
    made.drive(FORWARD, 2.0)
    made.one_image_of = 5
    made.drive(FORWARD, 3.5)
    began = len(made.speeds)
    made.drive(FORWARD, 3.0)
    assert made.modes == ["STOPPED", "REAL"], made.changes
    assert min(speed for _, speed in made.speeds[began:]) > 0.2  # slower, without a stop at each image
    assert "Slowed to" in made.state.reason
    made.one_image_of = 1
    made.drive(FORWARD, 5.0)
    assert made.base.v == pytest.approx(FORWARD[0], abs=0.01)
    assert "Slowed" not in made.state.reason


def test_lost_views_stop_both_robots_in_the_virtual_space_at_one_view_per_second(
    world: Callable[..., RateWorld],
) -> None:
    made = world(camera_hz=5, view_hz=1)
    into_virtual(made)
    made.drive(FORWARD, 7.0)
    assert made.modes[-1] == "VIRTUAL"
    moving = [s for s in made.states[-20:] if twist_values(s.applied_command) != NOTHING]
    assert len(moving) == 20  # slowly, but without a stop at each view
    limit = TimeoutConfig().image_travel_m / TimeoutConfig().allowed_s("view", 1.0)
    assert max(abs(twist_values(s.applied_command)[0]) for s in moving) <= limit + 0.01
    made.silent.add("view")
    began_s = made.time_s
    assert made.run(3.0, lambda: twist_values(made.state.applied_command) == NOTHING)
    assert made.time_s - began_s <= 1.0 + 0.3 + 0.06
    assert made.state.reason_code == ControlState.REASON_VIEW_STALE
    assert made.run(3.0, lambda: made.modes[-1] == "STOPPED")


def test_images_that_are_too_rare_are_refused_and_the_reason_says_so() -> None:
    made = RateWorld([BOX], Rates(camera_hz=0.7))
    made.drive(NOTHING, 15.0)
    made.drive(FORWARD, 4.0)
    assert made.modes == ["STOPPED"]
    assert any("waits for a camera image every 1.1 s or more often" in s.reason for s in made.states[-60:])
    assert made.base.pose[0] == 0.0
    made.close()


def test_a_scan_that_comes_before_its_transform_holds_by_its_age_and_does_not_stop_the_machine(
    world: Callable[..., RateWorld],
) -> None:
    made = world(boxes=(), camera_hz=10)
    made.drive(FORWARD, 1.0)
    made.silent.add("tf")
    made.run(0.25)
    assert made.modes[-1] == "REAL"
    made.silent.clear()
    made.run(0.5)
    assert made.modes[-1] == "REAL"
    assert made.state.reason_code == ControlState.REASON_DRIVE_ROBOT
    # Without any transform the last scan that could be placed grows old as a silent LiDAR does.
    made.silent.add("tf")
    assert made.run(1.0, lambda: twist_values(made.state.applied_command) == NOTHING)
    assert made.run(3.0, lambda: made.modes[-1] == "STOPPED")
