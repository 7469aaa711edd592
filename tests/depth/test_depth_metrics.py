"""Metrics and weights against values worked out by hand."""

import numpy as np
import pytest

from instant_ic.depth.metrics import DepthMetrics, depth_metrics, mean_metrics, solid_angle_weights


def test_metrics_by_hand() -> None:
    truth = np.array([[2.0, 4.0], [0.0, 5.0]])
    predicted = np.array([[3.0, 4.0], [9.0, 4.5]])
    got = depth_metrics(predicted, truth)
    # Errors 1, 0, 0.5 over 2, 4, 5 m (the pixel without truth does not count):
    assert got.mre == pytest.approx((0.5 + 0.0 + 0.1) / 3)
    assert got.mae_m == pytest.approx(1.5 / 3)
    assert got.rmse_m == pytest.approx(np.sqrt((1 + 0 + 0.25) / 3))
    # Ratios 1.5, 1, 1.111: under 1.25 two of three, under 1.5625 all.
    assert got.delta1 == pytest.approx(2 / 3)
    assert got.delta2 == got.delta3 == 1.0
    # Ratios d / t 1.5, 1, 0.9: their median is 1.
    assert got.scale_error_median == 0
    assert got.pixels == 3


def test_weights_by_hand() -> None:
    truth, predicted = np.array([[1.0, 1.0], [1.0, 1.0]]), np.array([[2.0, 2.0], [1.0, 1.1]])
    got = depth_metrics(predicted, truth, weights=np.array([[1.0], [3.0]]))
    # Errors 1, 1, 0, 0.1 with weights 1, 1, 3, 3 of 8.
    assert got.mre == got.mae_m == pytest.approx((1 + 1 + 0 + 0.3) / 8)
    assert got.rmse_m == pytest.approx(np.sqrt((1 + 1 + 0 + 0.03) / 8))
    assert got.delta1 == pytest.approx(6 / 8)
    # In order 1 (3), 1.1 (3), 2 (2): half of 8 lies within 1.1. Unweighted the median lies between 1.1 and 2.
    assert got.scale_error_median == pytest.approx(0.1)
    assert depth_metrics(predicted, truth).scale_error_median == pytest.approx(0.55)
    with pytest.raises(ValueError, match="no valid pixel"):
        depth_metrics(predicted, truth, weights=np.zeros((2, 1)))


def test_unusable_prediction_is_a_full_error() -> None:
    got = depth_metrics(np.array([np.nan, -1.0, 0.0, 2.0]), np.array([2.0, 2.0, 2.0, 2.0]))
    assert got.mre == pytest.approx(0.75)
    assert got.delta3 == pytest.approx(0.25)


def test_mean_counts_every_map_the_same() -> None:
    a = DepthMetrics(0.1, 1.0, 2.0, 0.5, 0.6, 0.7, 0.02, 10)
    b = DepthMetrics(0.3, 3.0, 4.0, 0.7, 0.8, 0.9, 0.04, 990)
    got = mean_metrics([a, b])
    assert got.mre == pytest.approx(0.2)
    assert got.rmse_m == pytest.approx(3.0)
    assert got.scale_error_median == pytest.approx(0.03)
    assert got.pixels == 1000


def test_solid_angle_of_four_rows() -> None:
    # Edges at 90, 45, 0 degrees: sines 1, 0.7071, 0; a band's area is their difference: 0.2929 and 0.7071.
    half = np.sqrt(0.5)
    expected = np.array([1 - half, half, half, 1 - half]) / 0.5
    np.testing.assert_allclose(solid_angle_weights(4), expected, rtol=1e-6)
    assert solid_angle_weights(256).mean() == pytest.approx(1.0, rel=1e-6)
