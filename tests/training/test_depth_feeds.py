"""Batches of a training: a function of their number, and errors instead of waiting for ever."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from instant_ic.training import feeds
from instant_ic.training.dataset import Sample
from instant_ic.training.feeds import Ahead, FeedError, FileFeed, MixedFeed


def marked(number: int) -> Sample:
    """A panorama whose values tell its number."""
    prior = np.full((6, 4, 8), number, np.float16)
    return Sample(np.full((4, 8, 3), number, np.uint8), np.full((4, 8), number, np.float32), number, prior)


def numbers(batch: feeds.Batch) -> list[int]:
    rgb, depth, prior = batch
    assert (rgb.dtype, depth.dtype, prior.dtype) == (np.uint8, np.float32, np.float16)  # as stored
    np.testing.assert_array_equal(prior[:, 4], depth)
    np.testing.assert_array_equal(rgb[..., 0], depth)
    return [int(value) for value in depth[:, 0, 0]]


def test_a_pass_shows_each_panorama_once_and_each_pass_another_order() -> None:
    feed = FileFeed([marked(i) for i in range(20)], np.arange(4, 16), 3, seed=5)
    assert feed.steps_an_epoch == 4 and feed.info == {"panoramas": 12}
    passes = [[n for step in range(first, first + 4) for n in numbers(feed.batch(step))] for first in (0, 4)]
    assert sorted(passes[0]) == sorted(passes[1]) == list(range(4, 16))
    assert passes[0] != passes[1]
    assert numbers(feed.batch(2)) == passes[0][6:9]
    feed.close()


def test_nothing_to_draw_from_is_an_error() -> None:
    with pytest.raises(FeedError, match="no panorama"):
        FileFeed([], np.arange(0), 2)


def test_mixed_batches_have_their_parts() -> None:
    stored = FileFeed([marked(200 + i) for i in range(6)], np.arange(6), 2, info={"kind": "plain"})
    feed = MixedFeed([stored, FileFeed([marked(i) for i in range(6)], np.arange(6), 3)])
    got = numbers(feed.batch(0))
    assert feed.batch_size == len(got) == 5
    assert min(got[:2]) >= 200 and max(got[2:]) < 200
    assert [part["batch_size"] for part in feed.info["mixed"]] == [2, 3]
    feed.close()


def test_next_batch_is_made_ahead_and_its_error_arrives() -> None:
    asked = []

    def batch(step: int) -> feeds.Batch:
        asked.append(step)
        if step == 2:
            raise FeedError("no more")
        return feeds.stack([marked(step)])

    ahead = Ahead(SimpleNamespace(batch=batch, close=lambda: asked.append("closed")))
    assert numbers(ahead.batch(0)) == [0] and numbers(ahead.batch(1)) == [1]
    with pytest.raises(FeedError, match="no more"):
        ahead.batch(2)
    ahead.close()
    assert asked == [0, 1, 2, "closed"]


def test_closing_does_not_wait_for_a_batch_that_does_not_come() -> None:
    closed = threading.Event()

    def batch(step: int) -> feeds.Batch:
        if step and not closed.wait(60):
            raise AssertionError("closing waited for the batch")
        return feeds.stack([marked(step)])

    ahead = Ahead(SimpleNamespace(batch=batch, close=closed.set))
    ahead.batch(0)
    begin = time.monotonic()
    ahead.close()
    assert time.monotonic() - begin < 50


def test_a_panorama_that_no_lidar_fits_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = Sample(np.zeros((4, 8, 3), np.uint8), np.full((4, 8), 9, np.float32), 9)
    monkeypatch.setattr(feeds, "prior_of_image", lambda rgb, depth_m, rng: None)
    assert numbers(feeds.stack([marked(1), odd, marked(2)])) == [1, 2]
    with pytest.raises(FeedError, match="no LiDAR fits to any of 1 panoramas"):
        feeds.stack([odd])
