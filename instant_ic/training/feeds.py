"""Batches of stored panoramas (numpy).

A batch depends on its number alone, so that a resumed training gets the same batches as an uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.training.dataset import Sample
from instant_ic.training.sparse import prior_of_image

Batch = tuple[NDArray[np.uint8], NDArray[np.floating], NDArray[np.floating]]
"""rgb (B, H, W, 3) uint8, radial depth (B, H, W) metres, 0 = unknown, and prior (B, 6, H, W); floats as stored."""


class FeedError(RuntimeError):
    """There are no panoramas."""


class Samples(Protocol):
    """Panoramas by number."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Sample: ...


def stack(samples: Sequence[Sample], rng: np.random.Generator | None = None) -> Batch:
    """Stack panoramas of one size into a batch; ``rng`` simulates the prior of those without one.

    Raises:
        FeedError: no LiDAR fits to any of the panoramas.
    """
    rng = rng or np.random.default_rng(0)
    priors = [prior_of_image(s.rgb, s.depth_m, rng) if s.prior is None else s.prior for s in samples]
    usable = [(sample, prior) for sample, prior in zip(samples, priors, strict=True) if prior is not None]
    if not usable:
        raise FeedError(f"no LiDAR fits to any of {len(samples)} panoramas: is their depth in metres?")
    return (
        np.stack([sample.rgb for sample, _ in usable]),
        np.stack([sample.depth_m for sample, _ in usable]),
        np.stack([prior for _, prior in usable]),
    )


class FileFeed:
    """Batches by number, requested in ascending order: passes over stored panoramas, each in a different order.

    Args:
        samples: stored panoramas.
        indices: numbers of the samples to use.
        batch_size: panoramas per batch.
        seed: seed of the order and of the simulated priors.
        info: recipe.
        threads: number of reader threads (decoding images takes longer than a training step of a small network).
    """

    def __init__(
        self,
        samples: Samples,
        indices: NDArray[np.intp],
        batch_size: int,
        seed: int = 0,
        info: dict[str, Any] | None = None,
        threads: int = 4,
    ) -> None:
        if len(indices) == 0:
            raise FeedError("no panoramas for training")
        self.samples, self.indices, self.batch_size = samples, indices, batch_size
        self.seed = seed
        self._info = info or {}
        self._readers = ThreadPoolExecutor(threads)

    @property
    def info(self) -> dict[str, Any]:
        """Recipe, for the training record (plain values)."""
        return {**self._info, "panoramas": len(self.indices)}

    @property
    def steps_an_epoch(self) -> int:
        """Number of batches that cover all panoramas once."""
        return max(1, len(self.indices) // self.batch_size)

    def batch(self, step: int) -> Batch:
        epoch, place = divmod(step, self.steps_an_epoch)
        order = np.random.default_rng((self.seed, epoch)).permutation(self.indices)
        first = place * self.batch_size
        picked = np.sort(np.take(order, np.arange(first, first + self.batch_size), mode="wrap"))
        rng = np.random.default_rng((self.seed, step))
        return stack(list(self._readers.map(lambda index: self.samples[int(index)], picked)), rng)

    def close(self) -> None:
        self._readers.shutdown(cancel_futures=True)


class MixedFeed:
    """Several feeds as one; each batch concatenates one batch of every feed."""

    def __init__(self, feeds: Sequence[FileFeed]) -> None:
        self.feeds = list(feeds)
        self.batch_size = sum(feed.batch_size for feed in feeds)

    @property
    def info(self) -> dict[str, Any]:
        return {"mixed": [{"batch_size": feed.batch_size, **feed.info} for feed in self.feeds]}

    @property
    def steps_an_epoch(self) -> int:
        return max(feed.steps_an_epoch for feed in self.feeds)

    def batch(self, step: int) -> Batch:
        parts = [feed.batch(step) for feed in self.feeds]
        rgb, depth, prior = zip(*parts, strict=True)
        return np.concatenate(rgb), np.concatenate(depth), np.concatenate(prior)

    def close(self) -> None:
        for feed in self.feeds:
            feed.close()


Feed: TypeAlias = FileFeed | MixedFeed


class Ahead:
    """A thread that prepares the next batch while the current one is used."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self._thread = ThreadPoolExecutor(1)
        self._made: dict[int, Any] = {}

    def batch(self, step: int) -> Batch:
        """Return batch ``step`` of the feed, or raise the feed's error."""
        ready = self._made.pop(step, None) or self._thread.submit(self.feed.batch, step)
        batch: Batch = ready.result()
        self._made = {step + 1: self._thread.submit(self.feed.batch, step + 1)}
        return batch

    def close(self) -> None:
        """Close the feed first: a pending batch would block the thread's shutdown."""
        self._thread.shutdown(wait=False, cancel_futures=True)
        self.feed.close()
        self._thread.shutdown()
