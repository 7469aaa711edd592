"""Batches of a training: a function of their number, with the error of reading them."""

import numpy as np
import pytest

from instant_ic.training.dataset import DatasetError, Sample
from instant_ic.training.feeds import Feed


def marked(number: int) -> Sample:
    """A panorama whose values tell its number."""
    prior = np.full((6, 4, 8), number, np.float16)
    return Sample(np.full((4, 8, 3), number, np.uint8), np.full((4, 8), number, np.float32), number, prior)


def test_a_pass_shows_each_panorama_once_and_each_pass_another_order() -> None:
    feed = Feed([marked(i) for i in range(12)], 3, seed=5)

    def numbers(step: int) -> list[int]:
        rgb, depth, prior = feed.batch(step)
        assert (rgb.dtype, depth.dtype, prior.dtype) == (np.uint8, np.float32, np.float16)  # as stored
        np.testing.assert_array_equal(prior[:, 4], depth)
        np.testing.assert_array_equal(rgb[..., 0], depth)
        return [int(value) for value in depth[:, 0, 0]]

    assert feed.steps_an_epoch == 4
    passes = [[n for step in range(first, first + 4) for n in numbers(step)] for first in (0, 4)]
    assert sorted(passes[0]) == sorted(passes[1]) == list(range(12))
    assert passes[0] != passes[1]
    assert numbers(2) == passes[0][6:9]
    feed.close()


def test_the_error_of_reading_ahead_arrives_with_its_batch() -> None:
    class Damaged(list[Sample]):
        def __getitem__(self, index: int) -> Sample:  # type: ignore[override]
            raise DatasetError("damaged")

    feed = Feed(Damaged([marked(0)]), 1)
    with pytest.raises(DatasetError, match="damaged"):
        feed.batch(0)
    feed.close()
