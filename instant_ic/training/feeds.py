"""Sources of training batches: files, or worlds rendered during training (numpy).

A batch depends on its number alone, so that a resumed training gets the same batches as an uninterrupted one.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import tempfile
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.context import SpawnProcess
from types import TracebackType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from instant_ic.training.dataset import Sample
from instant_ic.training.rooms import RoomsConfig, render_rooms
from instant_ic.training.sparse import prior_of_image

Batch = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float32]]
"""rgb (B, H, W, 3) uint8, radial depth (B, H, W) metres, 0 = unknown, and prior (B, 5, H, W)."""
WORLD_TIMEOUT_S = 600.0


class FeedError(RuntimeError):
    """No further batches: a renderer exited or timed out, or there are no panoramas."""


class Samples(Protocol):
    """Panoramas by number."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Sample: ...


class Feed(Protocol):
    """Batches by number, requested in ascending order."""

    batch_size: int

    @property
    def info(self) -> dict[str, Any]:
        """Recipe, for the training record (plain values)."""
        ...

    @property
    def steps_an_epoch(self) -> int:
        """Number of batches that cover all panoramas once."""
        ...

    def batch(self, step: int) -> Batch: ...

    def close(self) -> None: ...


def stack(samples: Sequence[Sample], rng: np.random.Generator | None = None) -> Batch:
    """Stack panoramas of one size into a batch; ``rng`` draws the prior of those without one."""
    rng = rng or np.random.default_rng(0)
    priors = [prior_of_image(s.depth_m, rng) if s.prior is None else np.asarray(s.prior, np.float32) for s in samples]
    depths = [np.asarray(s.depth_m, np.float32) for s in samples]
    return np.stack([s.rgb for s in samples]), np.stack(depths), np.stack(priors)


class FileFeed:
    """Passes over stored panoramas, each in a different order.

    Args:
        samples: the panoramas.
        indices: indices of the panoramas to use.
        batch_size: of this process.
        seed: of the order.
        rank, ranks: this process among those that train together; each gets its own part of a pass.
        info: recipe.
        threads: number of reader threads (decoding images takes longer than a training step of a small network).
    """

    def __init__(
        self,
        samples: Samples,
        indices: NDArray[np.intp],
        batch_size: int,
        seed: int = 0,
        rank: int = 0,
        ranks: int = 1,
        info: dict[str, Any] | None = None,
        threads: int = 4,
    ) -> None:
        if len(indices) == 0:
            raise FeedError("no panoramas for training")
        self.samples, self.indices, self.batch_size = samples, indices, batch_size
        self.seed, self.rank, self.ranks = seed, rank, ranks
        self._info = info or {}
        self._readers = ThreadPoolExecutor(threads)

    @property
    def info(self) -> dict[str, Any]:
        return {**self._info, "panoramas": len(self.indices)}

    @property
    def steps_an_epoch(self) -> int:
        return max(1, len(self.indices) // (self.batch_size * self.ranks))

    def batch(self, step: int) -> Batch:
        epoch, place = divmod(step, self.steps_an_epoch)
        order = np.random.default_rng((self.seed, epoch)).permutation(self.indices)
        first = (place * self.ranks + self.rank) * self.batch_size
        picked = np.sort(np.take(order, np.arange(first, first + self.batch_size), mode="wrap"))
        rng = np.random.default_rng((self.seed, step, self.rank))
        return stack(list(self._readers.map(lambda index: self.samples[int(index)], picked)), rng)

    def close(self) -> None:
        self._readers.shutdown(cancel_futures=True)


class RenderedFeed:
    """Samples from a window of worlds that advances with the training; background processes render ahead.

    Args:
        recipe: of the worlds. After the last world the first comes again.
        batch_size: of this process.
        seed: of the choice within the window.
        workers: rendering processes; 0 renders in this one.
        pool: panoramas in the window.
        reuse: average number of uses of a panorama (rotated, mirrored and coloured differently each time).
        rank, ranks: this process among those that train together; each renders its own worlds.
    """

    def __init__(
        self,
        recipe: RoomsConfig,
        batch_size: int,
        seed: int = 0,
        workers: int = 1,
        pool: int = 96,
        reuse: float = 3.0,
        rank: int = 0,
        ranks: int = 1,
    ) -> None:
        if reuse < 1 or pool < batch_size:
            raise FeedError(f"reuse must be 1 or more, pool no less than a batch (got {reuse}, {pool}, {batch_size})")
        self.recipe, self.batch_size, self.seed = recipe, batch_size, seed
        self.workers, self.pool, self.reuse, self.rank, self.ranks = workers, pool, reuse, rank, ranks
        self._worlds = max(1, -(-pool // recipe.poses))
        self._window: deque[list[Sample]] = deque(maxlen=self._worlds)
        self._next = 0
        self._renderers: Renderers | None = None

    @property
    def info(self) -> dict[str, Any]:
        return {**self.recipe.as_dict(), "rendered": "on the fly", "pool": self.pool, "reuse": self.reuse}

    @property
    def steps_an_epoch(self) -> int:
        return max(1, round(self.recipe.count * self.reuse / (self.batch_size * self.ranks)))

    def batch(self, step: int) -> Batch:
        last = self._worlds + int(step * self.batch_size / (self.reuse * self.recipe.poses))
        if self._renderers is None or last - self._worlds > self._next:
            self.close()
            self._next = last - self._worlds
            self._renderers = Renderers(self.recipe, self.workers, self._seed, self._next)
        while self._next < last:
            self._window.append(self._renderers.world())
            self._next += 1
        choice = [sample for world in self._window for sample in world]
        if not choice:
            raise FeedError(
                f"no free place to stand in {self._worlds} worlds from seed {self._seed(self._next - 1)} on"
            )
        rng = np.random.default_rng((self.seed, self.rank, step))
        return stack(
            [choice[i] for i in rng.choice(len(choice), self.batch_size, replace=len(choice) < self.batch_size)]
        )

    def _seed(self, place: int) -> int:
        return self.recipe.first_world + (place * self.ranks + self.rank) % self.recipe.worlds

    def close(self) -> None:
        if self._renderers is not None:
            self._renderers.close()
        self._renderers = None
        self._window.clear()


class MixedFeed:
    """Combines feeds: each batch concatenates one batch of every feed."""

    def __init__(self, feeds: Sequence[Feed]) -> None:
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


class Ahead:
    """Prepares the next batch in a thread while the current one is used."""

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


class Renderers:
    """Processes that render worlds in the order of their positions; :meth:`world` returns them one by one.

    Args:
        recipe: of the worlds.
        workers: processes; 0 renders in this one.
        seed_of: world seed of a position 0, 1, 2...
        first: position to start with.
    """

    def __init__(self, recipe: RoomsConfig, workers: int, seed_of: Callable[[int], int], first: int = 0) -> None:
        self.recipe, self.seed_of, self._place = recipe, seed_of, first
        self._processes: list[SpawnProcess] = []
        self._asked: list[Any] = []
        self._given: list[Any] = []
        self._cache: tempfile.TemporaryDirectory[str] | None = None
        if workers == 0:
            return
        context = multiprocessing.get_context("spawn")
        # Baked light of worlds that are rendered only once would evict everything else from the user's cache.
        self._cache = tempfile.TemporaryDirectory(prefix="instant_ic-render-")
        for _ in range(workers):
            asked, given = context.SimpleQueue(), context.Queue()
            process = context.Process(
                target=_render, args=(recipe, self._cache.name, os.getpid(), asked, given), daemon=True
            )
            process.start()
            # Else the end of a process in the middle of a message would never be noticed.
            given._writer.close()  # type: ignore[attr-defined]
            self._processes.append(process)
            self._asked.append(asked)
            self._given.append(given)
        self._ordered = first
        for _ in range(2 * workers):
            self._order()

    def _order(self) -> None:
        self._asked[self._ordered % len(self._asked)].put(self.seed_of(self._ordered))
        self._ordered += 1

    def world(self) -> list[Sample]:
        """Panoramas of the next world; empty if the world has no free place for the camera.

        Raises:
            FeedError: a renderer failed, exited or took longer than ``WORLD_TIMEOUT_S``.
        """
        place = self._place
        self._place += 1
        if not self._processes:
            return list(render_rooms(self.recipe, [self.seed_of(place)]))
        which = place % len(self._processes)
        end = time.monotonic() + WORLD_TIMEOUT_S
        while True:
            try:
                samples, error = self._given[which].get(timeout=1.0)
                break
            except (queue.Empty, EOFError, OSError) as none:
                if not isinstance(none, queue.Empty):  # the pipe ends between two messages, or within one
                    self._processes[which].join(10)
                if not self._processes[which].is_alive():
                    code = self._processes[which].exitcode
                    raise FeedError(f"a rendering process exited with {code} at world {self.seed_of(place)}") from None
                if time.monotonic() > end:
                    raise FeedError(
                        f"world {self.seed_of(place)} took over {WORLD_TIMEOUT_S:.0f} s to render"
                    ) from None
        if error:
            raise FeedError(f"world {self.seed_of(place)} could not be rendered:\n{error}")
        self._order()
        return list(samples)

    def close(self) -> None:
        """Stop the processes."""
        for process in self._processes:
            process.kill()  # SIGTERM would not end a stopped process
        for process in self._processes:
            process.join(10)
        self._processes = []
        if self._cache is not None:
            self._cache.cleanup()

    def __enter__(self) -> Renderers:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _render(recipe: RoomsConfig, cache: str, parent: int, asked: Any, given: Any) -> None:
    """Main function of a rendering process; exits with its parent."""
    import signal
    import threading

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the training, which then stops this process
    threading.Thread(target=watch, daemon=True).start()
    os.environ["XDG_CACHE_HOME"] = cache
    while True:
        seed = asked.get()
        try:
            given.put((list(render_rooms(recipe, [seed])), None))
        except Exception:
            given.put(([], traceback.format_exc()))  # the training raises it and stops
            raise
