"""The virtual space: keyframes' panoramas and depth, shown by warping and learnt by a field (paper, IV.A-B)."""

from __future__ import annotations

import dataclasses
import enum
import functools
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
from instant_ic.vspace.agreement import exposure_gains, moved
from instant_ic.vspace.choice import Choice, WarpTrial, gain_db, trials
from instant_ic.vspace.composition import ComposedView, Rendering, compose, dissolve, filled_image, to_8bit
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.devices import is_out_of_memory, make_device
from instant_ic.vspace.keyframes import Keyframe, KeyframeSet, recent, spread
from instant_ic.vspace.nerf.field import Device, FieldParameters, Floats, Lattice, Rays, Schedule, TrainingScene
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.prior import PanoramaPrior, prepare
from instant_ic.vspace.readiness import Texture, error_terms, expected_psnr_db
from instant_ic.vspace.saved import SavedSpace, TrainingProgress, read, write
from instant_ic.vspace.view import RayRenderer, View, checked_pose, perspective_rays

T = TypeVar("T")
_PROBE = (64, 36)  # pixels of the image that readiness is judged by
_PARALLAX_RAD = 0.035  # displacement of surfaces by the depth's error that is still fit to show
_LEAST_DEPTH_SHARE = 0.5  # of the keyframe's depth in where the field's surfaces lie


class SpaceState(enum.IntEnum):
    """Numbers as in VspaceStatus.msg."""

    EMPTY = 0
    TRAINING = 1
    READY = 2
    FAILED = 3


@dataclass(frozen=True)
class TrainStats:
    """Result of one ``train`` call: its iterations and wall time; PSNR is a running mean over training rays since the
    newest keyframe, dB, NaN before the first iteration.
    """

    iterations: int
    psnr_db: float
    elapsed_ms: float
    converged: bool


@dataclass(frozen=True)
class SpaceStatus:
    """SpaceState of the space; fields as in VspaceStatus.msg.

    Training figures are since the newest keyframe. ``refreshing``: the field has not learnt that one yet.
    """

    state: SpaceState
    refreshing: bool
    psnr_db: float
    iterations: int
    train_seconds: float
    """Training time since the newest keyframe."""
    ready_iterations: int
    """Iterations from the keyframe until READY, 0 while not ready."""
    ms_per_iteration: float
    ready_radius_m: float
    """Distance from the keyframe up to which views may be shown."""
    converged: bool
    source: str
    """Source of the views: ``field``, ``warp`` or ``mesh``."""
    device: str
    warning: str = ""
    """Problem of the device; empty when there is none."""
    shows_field: bool = False
    gain_db: float = math.nan
    """PSNR of the field above the warp's on older keyframes; NaN where it was not measured."""


class NotReadyError(RuntimeError):
    """Training or a view was requested before the first keyframe."""


class VirtualSpace(RayRenderer):
    """The newest keyframes, shown at once by warping, and one hash-grid field trained on all of them.

    A new keyframe is shown from the moment it is taken; the field goes on from what it has learnt. One thread at a
    time. The same calls with the same seed give
    the same bits on the CPU, as long as training is asked for by iterations and not by time.

    Example:
        >>> space = VirtualSpace(VirtualSpaceConfig())                        # doctest: +SKIP
        >>> space.set_keyframe(rgb, depth_m, map_from_camera, relative_sigma=0.05)
        >>> space.train(iterations=200).psnr_db
        >>> space.render(map_from_camera, 320, 180, fov_rad=1.57).rgb
    """

    def __init__(self, config: VirtualSpaceConfig | None = None, robot: NDArray[np.bool_] | None = None) -> None:
        """Create an empty space.

        Args:
            config: parameters.
            robot: image (H, 2 H): true where panoramas show the robot itself or its stand, besides what
                ``config.geometry.body_below_deg`` says.

        Raises:
            ValueError: parameters that do not fit; DeviceError: a device that is not there.
        """
        self.config = config or VirtualSpaceConfig()
        if self.config.source == "mesh":
            raise ValueError("source is mesh: nothing is learnt there; use make_space, which renders the mesh")
        self._robot = robot
        self._device, self._warning = make_device(self.config)
        if self.config.source == "auto":
            source = "field" if self._device.on_gpu else "warp"
            self.config = dataclasses.replace(self.config, source=source)
        self._shown: KeyframeSet | None = None
        self._before: KeyframeSet | None = None  # shown before, until the newest has taken over
        self._pictures = 0  # rendered since then
        self._scene: TrainingScene | None = None  # what the field learns
        self._trials: tuple[WarpTrial, ...] = ()
        self._choice = Choice(self.config.picture.field_gain_db)
        self._texture: tuple[PanoramaPrior, Texture] | None = None
        self._ready = False
        self._colour_error = math.nan
        self._rng = np.random.default_rng(self.config.train.seed)
        self._reset_run(refresh=False)

    def _reset_run(self, refresh: bool) -> None:
        self._schedule = Schedule(self.config.train, refresh)
        if not refresh:
            self._colour_error = math.nan
        self._history: deque[float] = deque(maxlen=self.config.readiness.plateau_iterations + 1)
        self._ready_iterations = 0
        self._train_seconds = 0.0

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
        """Whether the next views still change, from the keyframe before into the newest."""
        return self._before is not None

    @property
    def _psnr_db(self) -> float:
        return psnr_of_mse(self._colour_error)

    @property
    def _done(self) -> bool:
        """Whether nothing is left to train, or it would not help."""
        return self._schedule.finished or self._choice.hopeless or self.config.source == "warp"

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
            KeyframeError: the keyframe is no good; the old space stays as it was.
        """
        prepared = self.prepare(rgb, depth_m, map_from_camera, relative_sigma)
        if self.config.source == "field":
            self.learn(prepared)
        self.show(prepared)

    def take_keyframe(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
        relative_sigma: float | NDArray[np.floating],
    ) -> None:
        """Show a new keyframe, into which views dissolve; ``learn`` may follow.

        Args: as ``prior.prepare``.

        Raises:
            KeyframeError: the keyframe is no good; the old space stays as it was.
        """
        self.show(self.prepare(rgb, depth_m, map_from_camera, relative_sigma), dissolve=True)

    def prepare(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
        relative_sigma: float | NDArray[np.floating],
    ) -> KeyframeSet:
        """Prepare a new keyframe, with the earlier ones that are kept; changes nothing that is shown.

        The field learns from ``config.keyframes`` − 1 earlier keyframes too, in the new one's exposure and without
        moved objects. ``config.older`` keyframes give their pixels of what is hidden from the new one. Keyframes of
        another size are dropped.

        Args: as ``prior.prepare``.

        Raises:
            KeyframeError: the keyframe is no good.
        """
        config = self.config
        prior = prepare(
            rgb, depth_m, map_from_camera, relative_sigma, config.geometry, config.panorama_width, self._robot
        )
        before = () if self._shown is None else (*self._shown.keyframes, *self._shown.kept)
        size = (prior.rgb.shape, prior.inverse_depth.shape)
        before = tuple(one for one in before if (one.prior.rgb.shape, one.prior.inverse_depth.shape) == size)
        older = config.keyframes - 1
        shown = self._together((Keyframe.build(prior), *before[:older]))
        first = shown.newest
        if not config.older:
            return shown
        kept = recent((first, *before[older:]))[1:]
        others = [
            (one.prior, exposure_gains([first.prior, one.prior])[1]) for one in spread((first, *kept), config.older)
        ]
        first = dataclasses.replace(first, background=first.background.seen_by(others))
        return KeyframeSet((first, *shown.keyframes[1:]), shown.gains, kept)

    def _together(self, keyframes: tuple[Keyframe, ...]) -> KeyframeSet:
        """Bring keyframes to one exposure and leave out moved objects."""
        if len(keyframes) > 1:
            gone = moved([keyframe.prior for keyframe in keyframes])
            keyframes = tuple(one.without(mask) for one, mask in zip(keyframes, gone, strict=True))
        return KeyframeSet(keyframes, exposure_gains([keyframe.prior for keyframe in keyframes]))

    def show(self, prepared: KeyframeSet, dissolve: bool = False) -> None:
        """Show these keyframes from now on.

        ``dissolve``: what was shown before passes into them over the next ``picture.refresh_pictures`` images.
        """
        self._before, self._pictures = self._shown if dissolve else None, 0
        self._shown = prepared
        if self.config.source == "warp":
            self._ready, self._ready_iterations = True, 1  # a warp is ready at once
        self._end_dissolve()

    def _end_dissolve(self) -> None:
        if self._pictures >= self.config.picture.refresh_pictures - 1:
            self._before = None

    def learn(self, shown: KeyframeSet) -> None:
        """Train on these keyframes from now on, starting from the present parameters.

        Where the scale has changed by more than a factor of 2 it starts again. A failing device leaves the old space.
        """
        priors, old = shown.priors, self._scene
        lattice = Lattice.for_prior(priors[0], self.config.field)
        if old is not None and old.lattice.suits(lattice):
            lattice = old.lattice
        occupancy = build_occupancy(priors, self.config.geometry)
        self._learn(TrainingScene(priors, lattice, occupancy, shown.gains))
        self._trials = () if self.config.picture.field_alone else trials(shown)
        self._choose()

    def _learn(self, scene: TrainingScene) -> None:
        old = self._scene
        refresh = old is not None and scene.lattice is old.lattice
        if refresh or old is None:
            self._on_device(lambda device: device.set_scene(scene))
        else:
            self._start_anew(scene, old)
        self._scene, self._trials = scene, ()
        self._ready = self._ready and (refresh or not self.config.picture.field_alone)
        self._reset_run(refresh)
        self._choice.gain_db = math.nan  # on other images

    def _start_anew(self, scene: TrainingScene, old: TrainingScene) -> None:
        learnt = self._device.parameters()

        def start(device: Device) -> None:
            device.load(FieldParameters.random(self.config.field, self.config.train.seed))
            device.set_scene(scene)

        try:
            self._on_device(start)
        except Exception:
            self._device.load(learnt)
            self._device.set_scene(old)
            raise

    def train(self, budget_ms: float = math.inf, iterations: int | None = None) -> TrainStats:
        """Train for a time, a number of iterations or to the end of the schedule; at least one iteration.

        Raises:
            NotReadyError: no keyframe yet.
        """
        if self._shown is None:
            raise NotReadyError("no keyframe yet: call set_keyframe first")
        if self._scene is None:
            self.learn(self._shown)
        start = time.perf_counter()
        done = 0
        limit = self.config.train.iterations if iterations is None else iterations
        shape = (self.config.train.ray_columns * self.config.train.ray_rows, 3)
        while not self._done and done < limit:
            uniform = self._rng.random(shape, np.float32)
            colour, _ = self._on_device(functools.partial(_step, uniform, self._schedule.rates()))
            self._schedule.iteration += 1
            done += 1
            if self._schedule.finished or self._schedule.iteration % self.config.readiness.plateau_iterations == 0:
                self._choose()
            self._note(colour)
            if (time.perf_counter() - start) * 1e3 >= budget_ms:
                break
        elapsed = time.perf_counter() - start
        self._train_seconds += elapsed
        return TrainStats(done, self._psnr_db, elapsed * 1e3, self._done)

    def _choose(self) -> None:
        """Show the field or the warp, whichever renders the older keyframes better."""
        renderings = [self._on_device(functools.partial(_field_alone, trial.rays)) for trial in self._trials]
        left = (self.config.train.iterations - self._schedule.iteration) / self.config.readiness.plateau_iterations
        self._choice.take(gain_db(self._trials, renderings), left)

    def _note(self, colour_error: float) -> None:
        first = math.isnan(self._colour_error)
        self._colour_error = colour_error if first else 0.9 * self._colour_error + 0.1 * colour_error
        self._history.append(self._psnr_db)
        rule = self.config.readiness
        full = len(self._history) == rule.plateau_iterations + 1
        plateau = full and self._history[-1] - self._history[0] < rule.plateau_db
        good = self._psnr_db >= rule.psnr_db and self._schedule.iteration >= 5
        if not self._ready_iterations and (good or plateau or self._done):
            self._ready_iterations, self._ready = self._schedule.iteration, True

    @property
    def status(self) -> SpaceStatus:
        """The present state."""
        iterations = self._schedule.iteration
        if self._shown is None:
            state = SpaceState.EMPTY
        else:
            state = SpaceState.READY if self._ready else SpaceState.TRAINING
        return SpaceStatus(
            state=state,
            refreshing=self._ready and not self._ready_iterations,
            psnr_db=self._psnr_db,
            iterations=iterations,
            train_seconds=self._train_seconds,
            ready_iterations=self._ready_iterations if self.config.source == "field" else 0,
            ms_per_iteration=self._train_seconds * 1e3 / iterations if iterations else 0.0,
            ready_radius_m=self._ready_radius_m() if state == SpaceState.READY else 0.0,
            converged=self._shown is not None and self._done,
            source=self.config.source,
            device=self._device.name,
            warning=self._warning,
            shows_field=self._panorama_share == 0,
            gain_db=self._choice.gain_db,
        )

    def _ready_radius_m(self) -> float:
        """A surface at depth D, wrong by σ·D, seen from b aside is displaced by about b·σ/D radians."""
        prior = self.keyframe
        assert prior is not None
        sigma = max(prior.relative_sigma, 1e-3)
        return min(self.config.readiness.max_radius_m, _PARALLAX_RAD * prior.median_depth_m / sigma)

    def expected_psnr_db(self, map_from_camera: NDArray[np.floating], fov_rad: float = math.pi / 2) -> float:
        """Expected PSNR of a view, estimated without ground truth (``readiness``); −inf without a keyframe.

        From the depth's error, the distance to the keyframes, what they have not seen, and the error in training.
        """
        shown = self._shown
        if shown is None:
            return -math.inf
        rays = perspective_rays(checked_pose(map_from_camera), *_PROBE, fov_rad)
        self._learn_what_is_drawn(around=False)

        view = self._on_device(lambda device: self._composed(device, rays, shown, around=False))
        return self._judge(rays, view.depth, view.confidence)

    def _judge(self, rays: Rays, depth: Floats, confidence: Floats) -> float:
        """Expected PSNR of a view as it was rendered, (P,) each, from a few thousand of its pixels."""
        step = max(1, rays.shape[1] // _PROBE[0])
        height, width = rays.shape
        chosen = np.arange(step // 2, height, step)[:, None] * width + np.arange(step // 2, width, step)
        chosen = chosen.reshape(-1)
        some = rays.some(chosen)
        prior = self.keyframe
        assert prior is not None
        if self._texture is None or self._texture[0] is not prior:
            self._texture = prior, Texture.of(prior.rgb)
        terms = error_terms(prior, self._texture[1], some, depth[chosen], confidence[chosen])
        return expected_psnr_db(terms, self._psnr_db, self._panorama_share)

    def _view(self, rays: Rays, projection: str) -> View:
        if self._shown is None:
            raise NotReadyError("no keyframe yet: call set_keyframe first")
        self._learn_what_is_drawn(projection == "equirect")
        view, image = self._on_device(lambda device: self._dissolved(device, rays, projection == "equirect"))
        if self._before is not None:
            self._pictures += 1
            self._end_dissolve()
        expected = self._judge(rays, view.depth, view.confidence)
        depth, confidence = view.depth.reshape(rays.shape), view.confidence.reshape(rays.shape)
        return View(to_8bit(image), depth, confidence, projection, expected)

    def _learn_what_is_drawn(self, around: bool) -> None:
        """Train on the shown keyframes if the field is rendered too and has no scene yet."""
        if self._scene is None and (self._panorama_share < 1 or around):
            assert self._shown is not None
            self.learn(self._shown)

    def _dissolved(self, device: Device, rays: Rays, around: bool) -> tuple[ComposedView, Floats]:
        """Render the newest keyframe, and its image (H, W, 3) blended with that of the keyframe shown before.

        Args:
            device: backend of the field.
            rays: rays of the view.
            around: the view is a panorama, which is rendered by the field and not warped.
        """
        assert self._shown is not None
        view = self._composed(device, rays, self._shown, around)
        image = filled_image(view, rays.shape, around)
        if self._before is not None:
            before = filled_image(self._composed(device, rays, self._before, around), rays.shape, around)
            image = dissolve(before, image, (self._pictures + 1) / self.config.picture.refresh_pictures)
        return view, image

    def _composed(self, device: Device, rays: Rays, shown: KeyframeSet, around: bool) -> ComposedView:
        """Render a keyframe: its panorama warped, or the field."""
        share, field = self._panorama_share, None
        if share == 0 or around:
            field = device.draw(rays, share, max(share, _LEAST_DEPTH_SHARE))
        return compose(rays, None if around else shown.newest, field)

    @property
    def _panorama_share(self) -> float:
        """1 while the panorama is shown, 0 while the field is."""
        if self.config.source == "warp":
            return 1.0
        return 0.0 if self.config.picture.field_alone or self._choice.field else 1.0

    def _on_device(self, call: Callable[[Device], T]) -> T:
        """Call with the backend; with ``device: auto``, a GPU that runs out of memory is replaced by the CPU."""
        try:
            return call(self._device)
        except RuntimeError as error:
            if not is_out_of_memory(error) or self.config.device != "auto":
                raise
            self._warning = f"{self._device.name} is out of memory; on the CPU from now on ({error})"
        parameters = self._device.parameters()
        self._device, _ = make_device(dataclasses.replace(self.config, device="cpu"))
        self._device.load(parameters)
        if self._scene is not None:
            self._device.set_scene(self._scene)
        return call(self._device)

    def parameters(self) -> FieldParameters:
        """A copy of the field's present parameters."""
        return self._device.parameters()

    @property
    def _progress(self) -> TrainingProgress:
        schedule = self._schedule
        return TrainingProgress(
            *(self._psnr_db, schedule.iteration, schedule.refresh),
            *(self._ready_iterations, self._train_seconds, self._ready),
            shows_field=self._choice.field,
        )

    def save(self, path: str | Path) -> Path:
        """Saves the space that images show as one ``.npz`` file; ``path`` is that or a folder. Returns the file.

        The optimiser's moments are not in it: training that goes on from a file starts them again.

        Raises:
            NotReadyError: no keyframe yet.
            OSError: the file cannot be written; an older one stays as it was.
        """
        if self._shown is None:
            raise NotReadyError("no keyframe yet: there is nothing to save")
        if self._scene is None:
            self.learn(self._shown)
        assert self._scene is not None
        return write(
            path,
            SavedSpace(
                self.config, self._shown.priors, self._shown.gains, self._scene.lattice, self.parameters(),
                self._progress,
            ),
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path, device: str | None = None) -> VirtualSpace:
        """Load the space of a file or folder; on the CPU its views are bit-identical to those before saving.

        Args:
            path: what ``save`` was given.
            device: as in ``VirtualSpaceConfig``; the file's own where None.

        Raises:
            SpaceFileError: missing, damaged, foreign, or of a newer version.
        """
        saved = read(path)
        space = cls(saved.config if device is None else dataclasses.replace(saved.config, device=device))
        shown = KeyframeSet(tuple(Keyframe.build(prior) for prior in saved.priors), saved.gains)
        occupancy = build_occupancy(saved.priors, saved.config.geometry)
        space._device.load(saved.parameters)
        space._learn(TrainingScene(shown.priors, saved.lattice, occupancy, saved.gains))
        space.show(shown)
        progress = saved.progress
        space._schedule = Schedule(saved.config.train, progress.refresh, progress.iteration)
        space._colour_error = 10 ** (-progress.psnr_db / 10)
        space._train_seconds, space._ready_iterations = progress.train_seconds, progress.ready_iterations
        space._ready = progress.ready
        space._choice.field = progress.shows_field
        # Rays that were not sampled before, the same at each loading.
        space._rng = np.random.default_rng((saved.config.train.seed, progress.iteration))
        return space


def _field_alone(rays: Rays, device: Device) -> Rendering:
    return device.draw(rays, 0.0, _LEAST_DEPTH_SHARE)


def _step(uniform: Floats, rates: tuple[float, float], device: Device) -> tuple[float, float]:
    return device.step(uniform, *rates)
