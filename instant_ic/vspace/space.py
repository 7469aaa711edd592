"""The virtual space: keyframes with depth, shown by warping and learnt by a field (paper, IV.A-B)."""

from __future__ import annotations

import dataclasses
import enum
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.image_quality import psnr_of_mse
from instant_ic.vspace.choice import Choice, WarpTrial, gain_db, trials
from instant_ic.vspace.composition import ComposedView, Rendering, compose, dissolve, filled_image
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.devices import cpu_device, is_out_of_memory, make_device
from instant_ic.vspace.keyframes import Keyframe, KeyframeSet, extended
from instant_ic.vspace.nerf.field import Device, FieldParameters, Lattice, Rays, Schedule, TrainingScene
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.prior import PanoramaPrior, prepare
from instant_ic.vspace.readiness import error_terms, expected_psnr_db
from instant_ic.vspace.saved import SavedSpace, TrainingProgress, read, write
from instant_ic.vspace.view import RayRenderer, View, to_8bit

T = TypeVar("T")
PROBE_COLUMNS = 64
"""Number of columns of the grid of pixels on which a view's quality is estimated."""
PARALLAX_RAD = 0.035
"""Largest displacement of surfaces by errors of the depth in a view that may be shown."""
LEAST_DEPTH_SHARE = 0.5
"""Smallest weight of the keyframes' depth in the position of the field's surfaces."""


class SpaceState(enum.IntEnum):
    """State of a space, numbered as in VspaceStatus.msg."""

    EMPTY = 0
    TRAINING = 1
    READY = 2
    FAILED = 3


@dataclass(frozen=True)
class SpaceStatus:
    """Status of the space, from which the node fills VspaceStatus.msg.

    Attributes:
        state: state of the space.
        refreshing: True while the field has not learnt the newest keyframe yet.
        psnr_db: PSNR of the training rays since the newest keyframe.
        iterations: iterations since the newest keyframe.
        train_seconds: training time since the newest keyframe.
        ready_iterations: iterations from the keyframe until READY; 0 while not ready.
        ms_per_iteration: mean time of an iteration.
        ready_radius_m: distance from the keyframe up to which views may be shown.
        converged: True if nothing is left to train.
        source: source of the views: ``field``, ``warp`` or ``mesh``.
        device: name of the backend.
        warning: problem of the device; empty if there is none.
        shows_field: True if views show the field and not the warp.
        gain_db: PSNR of the field minus that of the warp on older keyframes; NaN if it was not measured.
    """

    state: SpaceState
    psnr_db: float
    ready_radius_m: float
    converged: bool
    source: str
    device: str
    warning: str = ""
    refreshing: bool = False
    iterations: int = 0
    train_seconds: float = 0.0
    ready_iterations: int = 0
    ms_per_iteration: float = 0.0
    shows_field: bool = False
    gain_db: float = math.nan


class NotReadyError(RuntimeError):
    """Training or a view was requested before the first keyframe."""


class TrainingRun:
    """Progress of training on the newest keyframe.

    Args:
        config: parameters of the space.
        refresh: True if the field starts from its present parameters.
        colour_error: smoothed squared colour error so far; NaN before the first iteration.
    """

    def __init__(self, config: VirtualSpaceConfig, refresh: bool, colour_error: float = math.nan) -> None:
        self.schedule = Schedule(config.train, refresh)
        self.colour_error = colour_error
        self.ready_iterations, self.seconds = 0, 0.0
        self._rule = config.readiness
        self._history: deque[float] = deque(maxlen=self._rule.plateau_iterations + 1)

    @property
    def psnr_db(self) -> float:
        """PSNR of the training rays; NaN before the first iteration."""
        return psnr_of_mse(self.colour_error)

    def note(self, colour_error: float, done: bool) -> bool:
        """Record the error of an iteration; return True if the space has just become ready.

        Args:
            colour_error: mean squared colour error, colours 0 to 1.
            done: True if nothing is left to train.
        """
        first = math.isnan(self.colour_error)
        self.colour_error = colour_error if first else 0.9 * self.colour_error + 0.1 * colour_error
        self._history.append(self.psnr_db)
        full = len(self._history) == self._rule.plateau_iterations + 1
        plateau = full and self._history[-1] - self._history[0] < self._rule.plateau_db
        good = self.psnr_db >= self._rule.psnr_db and self.schedule.iteration >= 5
        if self.ready_iterations or not (good or plateau or done):
            return False
        self.ready_iterations = self.schedule.iteration
        return True


class VirtualSpace(RayRenderer):
    """The newest keyframes, shown at once by warping, and one hash-grid field trained on all of them.

    A new keyframe is shown as soon as it is prepared. The field continues from its present parameters. On the CPU, the
    same calls with the same seed give the same bits, if training is limited by iterations. Not thread-safe.

    Attributes:
        config: parameters.
        device: backend of the field.
        scene: scene that the field learns; None before the first.
        trials: views of older keyframes on which field and warp are compared.
        choice: choice between field and warp.

    Example:
        >>> space = VirtualSpace(VirtualSpaceConfig())                        # doctest: +SKIP
        >>> space.set_keyframe(rgb, depth_m, map_from_camera, relative_sigma=0.05)
        >>> space.train(iterations=200)
        >>> space.render(map_from_camera, 320, 180, fov_rad=1.57).rgb
    """

    def __init__(self, config: VirtualSpaceConfig | None = None, robot: NDArray[np.bool_] | None = None) -> None:
        """Create an empty space.

        Args:
            config: parameters.
            robot: mask of the robot itself or its stand in panoramas, (H, 2 H); pixels below
                ``config.geometry.body_below_deg`` are added.

        Raises:
            ValueError: ``config.source`` is ``mesh``.
            DeviceError: the requested device is absent or does not work.
        """
        self.config = config or VirtualSpaceConfig()
        if self.config.source == "mesh":
            raise ValueError("source is mesh, which VirtualSpace cannot render; use make_space")
        self._robot = robot
        self.device, self._warning = make_device(self.config)
        if self.config.source == "auto":
            source = "field" if self.device.on_gpu else "warp"
            self.config = dataclasses.replace(self.config, source=source)
        self._shown: KeyframeSet | None = None
        self._before: KeyframeSet | None = None  # previous keyframes, until the dissolve to the newest is over
        self._views = 0  # views rendered since the dissolve began
        self.scene: TrainingScene | None = None
        self.trials: tuple[WarpTrial, ...] = ()
        self.choice = Choice(self.config.view.field_gain_db)
        self._ready = False
        self._rng = np.random.default_rng(self.config.train.seed)
        self._run = TrainingRun(self.config, refresh=False)

    @property
    def shown(self) -> KeyframeSet | None:
        """The keyframes in use, prepared for rendering; another space may ``show`` them too."""
        return self._shown

    @property
    def keyframe(self) -> PanoramaPrior | None:
        """The newest keyframe that views show."""
        return None if self._shown is None else self._shown.newest.prior

    @property
    def keyframes(self) -> tuple[PanoramaPrior, ...]:
        """All keyframes that the field learns from, newest first."""
        return () if self._shown is None else self._shown.priors

    @property
    def dissolving(self) -> bool:
        """True while views change from the previous keyframe to the newest."""
        return self._before is not None

    @property
    def _done(self) -> bool:
        """True if nothing is left to train, or if more training would not help."""
        return self._run.schedule.finished or self.choice.hopeless or self.config.source == "warp"

    def set_keyframe(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
        relative_sigma: float | NDArray[np.floating],
    ) -> None:
        """Use a new keyframe: ``prepare``, ``learn`` if a field is trained, and ``show``.

        Args: as ``prior.prepare``.

        Raises:
            KeyframeError: the keyframe cannot be used. The space does not change.
        """
        prepared = self.prepare(rgb, depth_m, map_from_camera, relative_sigma)
        if self.config.source == "field":
            self.learn(prepared)
        self.show(prepared)

    def prepare(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
        relative_sigma: float | NDArray[np.floating],
    ) -> KeyframeSet:
        """Prepare a new keyframe together with earlier ones, without changing what is shown.

        The field also learns from ``config.keyframes`` − 1 earlier keyframes, in the new one's exposure and without
        moved objects. ``config.older`` keyframes contribute pixels of surfaces hidden from the new one. Keyframes of
        another size are dropped.

        Args: as ``prior.prepare``.

        Raises:
            KeyframeError: the keyframe cannot be used.
        """
        config = self.config
        prior = prepare(
            rgb, depth_m, map_from_camera, relative_sigma, config.geometry, config.panorama_width, self._robot
        )
        return extended(prior, self._shown, config.keyframes, config.older)

    def show(self, prepared: KeyframeSet, dissolve: bool = False) -> None:
        """Show these keyframes from now on.

        Args:
            prepared: result of ``prepare``.
            dissolve: blend from the previous keyframe over the next ``view.refresh_views`` views.
        """
        self._before, self._views = self._shown if dissolve else None, 0
        self._shown = prepared
        if self.config.source == "warp":
            self._ready, self._run.ready_iterations = True, 1  # the warp is ready at once
        self._end_dissolve()

    def _end_dissolve(self) -> None:
        if self._views >= self.config.view.refresh_views - 1:
            self._before = None

    def learn(self, shown: KeyframeSet) -> None:
        """Train on these keyframes from now on, starting from the present parameters.

        If the scale has changed by more than a factor of 2, training starts from new parameters. If the device fails,
        the old space remains.
        """
        priors, old = shown.priors, self.scene
        lattice = Lattice.for_prior(priors[0], self.config.field)
        if old is not None and old.lattice.suits(lattice):
            lattice = old.lattice
        occupancy = build_occupancy(priors, self.config.geometry)
        self._learn(TrainingScene(priors, lattice, occupancy, shown.gains))
        self.trials = () if self.config.view.field_alone else trials(shown)
        self._choose()

    def _learn(self, scene: TrainingScene) -> None:
        old = self.scene
        refresh = old is not None and scene.lattice is old.lattice
        anew = old is not None and not refresh
        parameters = FieldParameters.random(self.config.field, self.config.train.seed) if anew else None
        self._on_device(lambda device: device.set_scene(scene, parameters))
        self.scene, self.trials = scene, ()
        self._ready = self._ready and (refresh or not self.config.view.field_alone)
        self._run = TrainingRun(self.config, refresh, self._run.colour_error if refresh else math.nan)
        self.choice.gain_db = math.nan  # the old gain was measured on other images

    def train(self, budget_ms: float = math.inf, iterations: int | None = None) -> None:
        """Train until a time, a number of iterations or the schedule is over, for at least one iteration.

        Raises:
            NotReadyError: there is no keyframe yet.
        """
        if self._shown is None:
            raise NotReadyError("no keyframe yet: call set_keyframe first")
        if self.scene is None:
            self.learn(self._shown)
        start = time.perf_counter()
        done, run = 0, self._run
        limit = self.config.train.iterations if iterations is None else iterations
        shape = (self.config.train.ray_columns * self.config.train.ray_rows, 3)
        while not self._done and done < limit:
            uniform, rates = self._rng.random(shape, np.float32), run.schedule.rates()
            colour, _ = self._on_device(lambda device: device.step(uniform, *rates))  # noqa: B023 - called at once
            run.schedule.iteration += 1
            done += 1
            if run.schedule.finished or run.schedule.iteration % self.config.readiness.plateau_iterations == 0:
                self._choose()
            self._ready = run.note(colour, self._done) or self._ready
            if (time.perf_counter() - start) * 1e3 >= budget_ms:
                break
        run.seconds += time.perf_counter() - start

    def _choose(self) -> None:
        """Show the field or the warp, whichever renders the older keyframes better."""
        renderings = [self._render_field(trial.rays, 0.0) for trial in self.trials]
        left = self.config.train.iterations - self._run.schedule.iteration
        self.choice.take(gain_db(self.trials, renderings), left / self.config.readiness.plateau_iterations)

    @property
    def status(self) -> SpaceStatus:
        """The present status."""
        run = self._run
        iterations = run.schedule.iteration
        if self._shown is None:
            state = SpaceState.EMPTY
        else:
            state = SpaceState.READY if self._ready else SpaceState.TRAINING
        return SpaceStatus(
            state=state,
            refreshing=self._ready and not run.ready_iterations,
            psnr_db=run.psnr_db,
            iterations=iterations,
            train_seconds=run.seconds,
            ready_iterations=run.ready_iterations if self.config.source == "field" else 0,
            ms_per_iteration=run.seconds * 1e3 / iterations if iterations else 0.0,
            ready_radius_m=self._ready_radius_m() if state == SpaceState.READY else 0.0,
            converged=self._shown is not None and self._done,
            source=self.config.source,
            device=self.device.name,
            warning=self._warning,
            shows_field=self._panorama_share == 0,
            gain_db=self.choice.gain_db,
        )

    def _ready_radius_m(self) -> float:
        """Return the distance b at which surfaces at the median depth D shift by ``PARALLAX_RAD``, about b·σ/D."""
        prior = self.keyframe
        assert prior is not None
        sigma = max(prior.relative_sigma, 1e-3)
        return min(self.config.readiness.max_radius_m, PARALLAX_RAD * prior.median_depth_m / sigma)

    def _expected(self, rays: Rays, view: ComposedView) -> float:
        """Return the expected PSNR of a rendered view, estimated from a few thousand of its pixels."""
        assert self._shown is not None
        step = max(1, rays.shape[1] // PROBE_COLUMNS)
        height, width = rays.shape
        chosen = np.arange(step // 2, height, step)[:, None] * width + np.arange(step // 2, width, step)
        chosen = chosen.reshape(-1)
        newest, seen = self._shown.newest, (view.depth[chosen], view.confidence[chosen])
        terms = error_terms(newest.prior, newest.texture, rays.some(chosen), *seen)
        return expected_psnr_db(terms, self._run.psnr_db, self._panorama_share)

    def _view(self, rays: Rays, projection: str) -> View:
        if self._shown is None:
            raise NotReadyError("no keyframe yet: call set_keyframe first")
        around = projection == "equirect"
        self._learn_what_is_rendered(around)
        view = self._composed(rays, self._shown, around)
        image = filled_image(view, rays.shape, around)
        if self._before is not None:
            before = filled_image(self._composed(rays, self._before, around), rays.shape, around)
            image = dissolve(before, image, (self._views + 1) / self.config.view.refresh_views)
            self._views += 1
            self._end_dissolve()
        depth, confidence = view.depth.reshape(rays.shape), view.confidence.reshape(rays.shape)
        return View(to_8bit(image), depth, confidence, projection, self._expected(rays, view))

    def _learn_what_is_rendered(self, around: bool) -> None:
        """Set the shown keyframes as the field's scene if a view needs the field and it has no scene yet."""
        if self.scene is None and (self._panorama_share < 1 or around):
            assert self._shown is not None
            self.learn(self._shown)

    def _composed(self, rays: Rays, shown: KeyframeSet, around: bool) -> ComposedView:
        """Render the warped keyframe or the field. A panorama (``around``) is rendered by the field."""
        share, field = self._panorama_share, None
        if share == 0 or around:
            field = self._render_field(rays, share)
        return compose(rays, None if around else shown.newest, field)

    def _render_field(self, rays: Rays, share: float) -> Rendering:
        """Render the field, in which the panorama's colours have the weight ``share``."""
        return self._on_device(lambda device: device.render_rays(rays, share, max(share, LEAST_DEPTH_SHARE)))

    def _on_device(self, work: Callable[[Device], T]) -> T:
        """Use the device. If a GPU is out of memory and ``device`` is ``auto``, continue on the CPU."""
        try:
            return work(self.device)
        except RuntimeError as error:
            if not is_out_of_memory(error) or self.config.device != "auto":
                raise
            self._warning = f"{self.device.name} is out of memory; the CPU is used from now on ({error})"
        parameters, self.device = self.device.parameters(), cpu_device(self.config.field, self.config.train)
        self.device.load(parameters)
        if self.scene is not None:
            self.device.set_scene(self.scene)
        return work(self.device)

    @property
    def _panorama_share(self) -> float:
        """Weight of the panorama's colours: 1 while the panorama is shown, 0 while the field is shown."""
        if self.config.source == "warp":
            return 1.0
        return 0.0 if self.config.view.field_alone or self.choice.field else 1.0

    def parameters(self) -> FieldParameters:
        """Return a copy of the field's present parameters."""
        return self.device.parameters()

    @property
    def _progress(self) -> TrainingProgress:
        run = self._run
        return TrainingProgress(
            *(run.psnr_db, run.schedule.iteration, run.schedule.refresh),
            *(run.ready_iterations, run.seconds, self._ready),
            shows_field=self.choice.field,
        )

    def save(self, path: str | Path) -> Path:
        """Save the shown space as one ``.npz`` file, and return the file.

        The optimiser's moments are not saved. Training that continues from a file starts with new moments.

        Args:
            path: the file or its folder.

        Raises:
            NotReadyError: there is no keyframe yet.
            OSError: the file cannot be written. An older file does not change.
        """
        if self._shown is None:
            raise NotReadyError("no keyframe yet, so there is nothing to save")
        if self.scene is None:
            self.learn(self._shown)
        assert self.scene is not None
        return write(
            path,
            SavedSpace(
                self.config, self._shown.priors, self._shown.gains, self.scene.lattice, self.parameters(),
                self._progress,
            ),
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path, device: str | None = None) -> VirtualSpace:
        """Load the space from a file or folder. On the CPU its views are bit-identical to those before saving.

        Args:
            path: the file or its folder.
            device: value of ``VirtualSpaceConfig.device``; None for the value in the file.

        Raises:
            SpaceFileError: the file is missing, damaged, not a space, or of another version.
        """
        saved = read(path)
        space = cls(saved.config if device is None else dataclasses.replace(saved.config, device=device))
        shown = KeyframeSet(tuple(Keyframe.build(prior) for prior in saved.priors), saved.gains)
        occupancy = build_occupancy(saved.priors, saved.config.geometry)
        space.device.load(saved.parameters)
        space._learn(TrainingScene(shown.priors, saved.lattice, occupancy, saved.gains))
        space.show(shown)
        progress = saved.progress
        run = space._run = TrainingRun(space.config, progress.refresh, 10 ** (-progress.psnr_db / 10))
        run.schedule.iteration = progress.iteration
        run.seconds, run.ready_iterations = progress.train_seconds, progress.ready_iterations
        space._ready = progress.ready
        space.choice.field = progress.shows_field
        # Rays differ from those before saving, but are the same each time the file is loaded.
        space._rng = np.random.default_rng((saved.config.train.seed, progress.iteration))
        return space
