"""Batches of a training: a function of their number, whoever renders them, and errors instead of waiting for ever."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from instant_ic.training import feeds
from instant_ic.training.dataset import Sample
from instant_ic.training.feeds import Ahead, FeedError, FileFeed, MixedFeed, RenderedFeed, Renderers
from instant_ic.training.rooms import RoomsConfig, render_rooms

RECIPE = RoomsConfig(worlds=50, poses=2, height=32, first_world=300_000, interiors="random")


def marked(number: int) -> Sample:
    """A panorama whose values tell its number."""
    prior = np.full((5, 4, 8), number, np.float16)
    return Sample(np.full((4, 8, 3), number, np.uint8), np.full((4, 8), number, np.float32), number, prior)


def numbers(batch: feeds.Batch) -> list[int]:
    rgb, depth, prior = batch
    assert rgb.dtype == np.uint8 and depth.dtype == prior.dtype == np.float32
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


def test_processes_share_a_pass() -> None:
    samples = [marked(i) for i in range(12)]
    both = [FileFeed(samples, np.arange(12), 2, rank=rank, ranks=2) for rank in (0, 1)]
    assert [feed.steps_an_epoch for feed in both] == [3, 3]
    assert sorted(n for feed in both for step in range(3) for n in numbers(feed.batch(step))) == list(range(12))


def test_nothing_to_draw_from_is_an_error() -> None:
    with pytest.raises(FeedError, match="no panorama"):
        FileFeed([], np.arange(0), 2)
    with pytest.raises(FeedError, match="pool"):
        RenderedFeed(RECIPE, 8, pool=4)


@pytest.fixture
def quick_worlds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Worlds that are rendered at once: two panoramas marked with seed - 300000, and none in each fifth."""
    seeds: list[int] = []

    def render(recipe: RoomsConfig, worlds: list[int]) -> Iterator[Sample]:
        for seed in worlds:
            seeds.append(seed)
            if seed % 5 != 4:
                yield from (marked(seed - 300_000) for _ in range(recipe.poses))

    monkeypatch.setattr(feeds, "render_rooms", render)
    return seeds


def test_window_moves_on_with_the_steps(quick_worlds: list[int]) -> None:
    # Batches of 4 of which each is used twice: a world of two panoramas a step; 3 worlds at a time.
    feed = RenderedFeed(RECIPE, 4, workers=0, pool=6, reuse=2)
    batches = [numbers(feed.batch(step)) for step in range(8)]
    assert quick_worlds == [300_000 + i for i in range(10)]
    for step, batch in enumerate(batches):
        assert set(batch) <= {n for n in range(step, step + 3) if n % 5 != 4}
        assert len(batch) == 4
    again = RenderedFeed(RECIPE, 4, workers=0, pool=6, reuse=2)
    assert numbers(again.batch(6)) == batches[6]  # taken up there: it renders the window and no more
    assert quick_worlds[10:] == [300_006, 300_007, 300_008]
    assert feed.steps_an_epoch == 50 and feed.info["rendered"] == "on the fly"


def test_processes_render_worlds_of_their_own(quick_worlds: list[int]) -> None:
    for rank in (0, 1):
        RenderedFeed(RECIPE, 2, workers=0, pool=6, reuse=2, rank=rank, ranks=2).batch(0)
    assert quick_worlds == [300_000, 300_002, 300_004, 300_001, 300_003, 300_005]


def test_after_the_last_world_the_first_comes_again(quick_worlds: list[int]) -> None:
    feed = RenderedFeed(RECIPE, 4, workers=0, pool=4, reuse=1)
    feed.batch(25)
    assert quick_worlds == [300_000, 300_001]  # 25 steps of two worlds each: a pass of 50


def test_worlds_without_a_free_place_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feeds, "render_rooms", lambda recipe, worlds: iter(()))
    with pytest.raises(FeedError, match="no free place to stand"):
        RenderedFeed(RECIPE, 2, workers=0, pool=4).batch(0)


def test_mixed_batches_have_their_parts(quick_worlds: list[int]) -> None:
    stored = FileFeed([marked(200 + i) for i in range(6)], np.arange(6), 2, info={"kind": "plain"})
    feed = MixedFeed([stored, RenderedFeed(RECIPE, 3, workers=0, pool=6, reuse=2)])
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


def test_worlds_come_in_order_from_processes_and_a_dead_one_is_told() -> None:
    with Renderers(RECIPE, 1, lambda place: 300_000 + place) as renderers:
        for seed in (300_000, 300_001):
            for mine, other in zip(renderers.world(), render_rooms(RECIPE, [seed]), strict=True):
                np.testing.assert_array_equal(mine.rgb, other.rgb)
                np.testing.assert_array_equal(mine.depth_m, other.depth_m)
                np.testing.assert_array_equal(mine.prior, other.prior)
        cache = renderers._cache.name
        assert Path(cache).is_dir()
        renderers._processes[0].kill()
        with pytest.raises(FeedError, match="rendering process exited with -9 at world"):
            for _ in range(4):  # those that were already on their way may still come
                renderers.world()
    assert not Path(cache).exists()
