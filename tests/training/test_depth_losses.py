"""Training losses against values worked out by hand."""

import math

import pytest
import torch

from instant_ic.training.losses import berhu, depth_loss, edge_loss, weighted_mean


def test_berhu_by_hand() -> None:
    got = berhu(torch.tensor([-0.5, 1.0, 3.0]), 1.0)
    # Linear up to 1; above (9 + 1) / 2 = 5.
    torch.testing.assert_close(got, torch.tensor([0.5, 1.0, 5.0]))


def test_weighted_mean_by_hand() -> None:
    values = torch.tensor([[[1.0, 2.0], [3.0, 100.0]]])
    valid = torch.tensor([[[True, True], [True, False]]])
    # Rows weigh 1 and 2: (1 + 2 + 2 * 3) / (1 + 1 + 2) = 9 / 4.
    assert weighted_mean(values, valid, torch.tensor([1.0, 2.0])).item() == pytest.approx(9 / 4)


def test_depth_loss_by_hand() -> None:
    truth = torch.tensor([[[2.0, 0.0], [1.0, 4.0]]])
    predicted = torch.tensor([[[1.0, 7.0], [1.0, 4.5]]])
    expected = (math.log(2) + 0.1 * 1.0 + 0.0 + math.log(4.5 / 4) + 0.1 * 0.5) / 3
    assert depth_loss(predicted, truth, torch.ones(2)).item() == pytest.approx(expected, rel=1e-5)


def test_depth_loss_has_a_gradient_below_the_cut() -> None:
    predicted = torch.full((1, 2, 2), -1.0, requires_grad=True)
    depth_loss(predicted, torch.full((1, 2, 2), 2.0), torch.ones(2)).backward()
    assert (predicted.grad < 0).all()


def test_edge_loss_counts_steps_that_the_truth_lacks() -> None:
    truth = torch.ones(1, 2, 4)
    predicted = torch.ones(1, 2, 4)
    predicted[..., 2:] = math.e
    # Across: of 4 neighbour pairs a row (the seam is one) two step by 1. Down: none.
    assert edge_loss(predicted, truth, torch.ones(2)).item() == pytest.approx(0.5)
    assert edge_loss(3 * truth, truth, torch.ones(2)).item() == pytest.approx(0.0, abs=1e-6)


def test_edge_loss_leaves_unknown_truth_out() -> None:
    truth = torch.ones(1, 2, 4)
    truth[..., 2] = 0.0
    predicted = torch.ones(1, 2, 4)
    predicted[..., 2] = 9.0
    assert edge_loss(predicted, truth, torch.ones(2)).item() == pytest.approx(0.0, abs=1e-6)
