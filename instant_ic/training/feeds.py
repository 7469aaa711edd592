"""Batches of stored panoramas (numpy).

A batch depends on its number alone, so that a resumed training gets the same batches as an uninterrupted one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from instant_ic.training.dataset import Sample

Batch = tuple[NDArray[np.uint8], NDArray[np.floating], NDArray[np.floating]]
"""rgb (B, H, W, 3) uint8, radial depth (B, H, W) metres, 0 = unknown, and prior (B, 6, H, W); floats as stored."""


def stack(samples: Sequence[Sample]) -> Batch:
    """Stack panoramas of one size into a batch."""
    return (
        np.stack([sample.rgb for sample in samples]),
        np.stack([sample.depth_m for sample in samples]),
        np.stack([sample.prior for sample in samples]),
    )


class Feed:
    """Batches by number: passes over stored panoramas, each in a different order.

    Threads read the next batch while the current one is used.

    Args:
        samples: panoramas for training, at least one.
        batch_size: panoramas per batch.
        seed: seed of the order.
        threads: number of reader threads (decoding images takes longer than a training step of a small network).
    """

    def __init__(self, samples: Sequence[Sample], batch_size: int, seed: int = 0, threads: int = 4) -> None:
        self.samples, self.batch_size, self.seed = samples, batch_size, seed
        self._readers = ThreadPoolExecutor(threads)
        self._ahead: dict[int, list[Future[Sample]]] = {}

    @property
    def steps_an_epoch(self) -> int:
        """Number of batches that cover all panoramas once."""
        return max(1, len(self.samples) // self.batch_size)

    def batch(self, step: int) -> Batch:
        """Return batch ``step``, or raise the error of reading it."""
        ready = self._ahead.pop(step, None) or self._read(step)
        self._ahead = {step + 1: self._read(step + 1)}
        return stack([sample.result() for sample in ready])

    def _read(self, step: int) -> list[Future[Sample]]:
        epoch, place = divmod(step, self.steps_an_epoch)
        order = np.random.default_rng((self.seed, epoch)).permutation(len(self.samples))
        first = place * self.batch_size
        picked = np.sort(np.take(order, np.arange(first, first + self.batch_size), mode="wrap"))
        return [self._readers.submit(self.samples.__getitem__, int(index)) for index in picked]

    def close(self) -> None:
        self._readers.shutdown(cancel_futures=True)
