"""Kinematics, odometry and limits, by hand and by properties."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.base.config import LimitsConfig, SkidSteerConfig
from instant_ic.base.kinematics import SkidSteer
from instant_ic.base.limits import TwistLimiter
from instant_ic.base.odometry import UNMEASURED_VARIANCE, WheelOdometry, unwrap_counts

GEOMETRY = SkidSteerConfig(track_width=0.4, track_width_multiplier=1.5, pulses_per_metre=4000.0)
SECOND = 1_000_000_000


def test_turning_on_the_spot_by_hand() -> None:
    # Effective width 0.4 * 1.5 = 0.6 m: 1 rad/s needs -0.3 and +0.3 m/s.
    base = SkidSteer(GEOMETRY)
    np.testing.assert_allclose(base.tracks_from_twist(0.0, 1.0), [-0.3, 0.3])
    np.testing.assert_allclose(base.motors_from_tracks([-0.3, 0.3]), [-1200.0, 1200.0])
    np.testing.assert_allclose(base.twist_from_tracks([-0.3, 0.3]), [0.0, 0.0, 1.0], atol=1e-15)


def test_sideways_slip_when_the_centre_of_rotation_lies_ahead() -> None:
    base = SkidSteer(SkidSteerConfig(x_icr=0.05))
    # v_y = -w * x_icr
    np.testing.assert_allclose(base.twist_from_tracks(base.tracks_from_twist(0.2, 0.8)), [0.2, -0.04, 0.8])


def test_wiring_swaps_and_inverts() -> None:
    base = SkidSteer(SkidSteerConfig(left_motor=2, invert_right=True, pulses_per_metre=1000.0))
    motors = base.motors_from_tracks([0.1, 0.2])
    np.testing.assert_allclose(motors, [-200.0, 100.0])  # M1 drives the right track, backwards
    np.testing.assert_allclose(base.tracks_from_motors(motors), [0.1, 0.2])


@given(st.floats(-2, 2), st.floats(-3, 3), st.sampled_from([1, 2]), st.booleans(), st.booleans())
def test_twist_to_motors_and_back(v: float, w: float, left: int, invert_left: bool, invert_right: bool) -> None:
    base = SkidSteer(SkidSteerConfig(left_motor=left, invert_left=invert_left, invert_right=invert_right))
    tracks = base.tracks_from_motors(base.motors_from_tracks(base.tracks_from_twist(v, w)))
    np.testing.assert_allclose(base.twist_from_tracks(tracks)[[0, 2]], [v, w], atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1))
def test_counts_unwrap_by_the_shorter_way(before: int, step: int) -> None:
    now = (before + step) % 2**32
    assert unwrap_counts(np.array([before]), np.array([now])).tolist() == [step]


def test_straight_drive_over_the_counters_wrap() -> None:
    odometry = WheelOdometry(GEOMETRY)
    assert odometry.update([2**32 - 1000, 2**32 - 1000], SECOND) is None
    estimate = odometry.update([1000, 1000], 2 * SECOND)  # 2000 pulses, 0.5 m
    assert estimate is not None
    np.testing.assert_allclose(estimate.pose, [0.5, 0.0, 0.0])
    np.testing.assert_allclose(estimate.twist, [0.5, 0.0, 0.0])


def test_half_circle_lands_where_geometry_says() -> None:
    # Radius 1 m, to the left, in steps of one degree: ends at (0, 2), looking back.
    odometry = WheelOdometry(GEOMETRY)
    base = SkidSteer(GEOMETRY)
    angle = np.linspace(0.0, np.pi, 181)
    estimate = None
    for step, a in enumerate(angle):
        pulses = np.round(base.motors_from_tracks([(1 - 0.3) * a, (1 + 0.3) * a])).astype(np.int64) % 2**32
        estimate = odometry.update(pulses, (step + 1) * SECOND // 10)
    assert estimate is not None
    np.testing.assert_allclose(estimate.pose[:2], [0.0, 2.0], atol=1e-3)
    assert abs(abs(estimate.pose[2]) - np.pi) < 2e-3


def test_covariance_grows_with_distance_and_more_with_turns() -> None:
    def after(left: int, right: int) -> np.ndarray:
        odometry = WheelOdometry(GEOMETRY)
        odometry.update([0, 0], SECOND)
        estimate = odometry.update([left % 2**32, right % 2**32], 2 * SECOND)
        assert estimate is not None
        assert np.linalg.eigvalsh(estimate.pose_covariance).min() >= 0.0
        return estimate.pose_covariance

    still, half, one, turn = after(0, 0), after(2000, 2000), after(4000, 4000), after(-1200, 1200)
    assert still[5, 5] == 0.0
    np.testing.assert_allclose([half[5, 5], one[5, 5]], [0.2e-3, 0.4e-3])  # 0.0004 rad^2/m
    np.testing.assert_allclose(turn[5, 5], 1e-2, rtol=1e-9)  # one radian
    assert one[2, 2] == one[3, 3] == one[4, 4] == UNMEASURED_VARIANCE


def test_twist_variance_grows_with_the_turn_rate() -> None:
    odometry = WheelOdometry(GEOMETRY)
    odometry.update([0, 0], SECOND)
    slow = odometry.update([2**32 - 120, 120], 2 * SECOND)
    fast = odometry.update([2**32 - 1320, 1320], 3 * SECOND)
    assert slow is not None and fast is not None
    assert fast.twist_covariance[5, 5] > 5.0 * slow.twist_covariance[5, 5]


def test_impossible_jump_is_left_out_and_counted() -> None:
    odometry = WheelOdometry(GEOMETRY)
    odometry.update([100_000, 100_000], SECOND)
    odometry.update([104_000, 104_000], 2 * SECOND)
    assert odometry.update([0, 0], 2 * SECOND + SECOND // 30) is None  # the controller forgot its counts
    assert odometry.rejected == 1
    estimate = odometry.update([400, 400], 3 * SECOND)
    assert estimate is not None
    np.testing.assert_allclose(estimate.pose, [1.1, 0.0, 0.0])
    assert odometry.update([400, 400], 3 * SECOND) is None  # no time has passed


def test_reading_that_follows_a_late_one_too_soon_is_no_jump_and_the_next_has_its_motion() -> None:
    odometry = WheelOdometry(GEOMETRY)
    odometry.update([0, 0], SECOND)
    assert odometry.update([80, 80], SECOND + SECOND // 200) is None  # 2 cm, 4 m/s by the times
    assert odometry.rejected == 0
    estimate = odometry.update([160, 160], SECOND + SECOND // 10)
    assert estimate is not None
    np.testing.assert_allclose(estimate.pose, [0.04, 0.0, 0.0])
    np.testing.assert_allclose(estimate.twist, [0.4, 0.0, 0.0])


def test_limiter_ramps_as_worked_out_by_hand() -> None:
    limiter = TwistLimiter(LimitsConfig(0.5, 1.0, 0.8, 2.0))
    assert limiter.step(0.5, 0.0, 0.1) == pytest.approx((0.08, 0.0))
    assert limiter.step(0.5, 1.0, 0.5) == pytest.approx((0.48, 1.0))
    assert limiter.step(0.5, 1.0, 0.5) == pytest.approx((0.5, 1.0))
    assert limiter.step(0.0, 0.0, 0.25) == pytest.approx((0.3, 0.5))
    limiter.reset()
    assert (limiter.v, limiter.w) == (0.0, 0.0)
    with pytest.raises(ValueError, match="finite"):
        limiter.step(float("nan"), 0.0, 0.1)


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0, 0.2)), min_size=1, max_size=50))
def test_limiter_never_exceeds_its_limits(commands: list[tuple[float, float, float]]) -> None:
    limits = LimitsConfig()
    limiter = TwistLimiter(limits)
    before = (0.0, 0.0)
    for v, w, dt_s in commands:
        now = limiter.step(v, w, dt_s)
        assert abs(now[0]) <= limits.max_linear_m_s + 1e-12 and abs(now[1]) <= limits.max_angular_rad_s + 1e-12
        assert abs(now[0] - before[0]) <= limits.max_linear_accel_m_s2 * dt_s + 1e-12
        assert abs(now[1] - before[1]) <= limits.max_angular_accel_rad_s2 * dt_s + 1e-12
        before = now
