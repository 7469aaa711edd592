"""The virtual space: one keyframe's panorama and depth, trained and drawn by turns (paper, IV.A-B)."""

from __future__ import annotations

import dataclasses
import enum
import functools
import importlib.util
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import CUBE_FACES, perspective_directions, sample_equirect

from .compose import Layer, compose, exposure_gain
from .config import VirtualSpaceConfig
from .field import Device, FieldParameters, Floats, Lattice, Rays, Scene, Schedule
from .occupancy import build_occupancy
from .prior import KeyframeError, PanoramaPrior, prepare
from .readiness import Texture, error_terms, expected_psnr_db
from .saved import Progress, SavedKeyframe, SavedSpace, read, write
from .view import MAX_VIEW, View, check_size, checked_pose, continue_unseen, equirect_rays, perspective_rays
from .warp import PanoramaWarp, dissolve

T = TypeVar("T")
_PROBE = (64, 36)  # pixels of the picture that readiness is judged by


class State(enum.IntEnum):
    """Numbers as in VspaceStatus.msg."""

    EMPTY = 0
    TRAINING = 1
    READY = 2
    FAILED = 3


@dataclass(frozen=True)
class TrainStats:
    """What one ``train`` call did: iterations of this call and its CPU-independent wall time; PSNR is a running mean
    over training rays since the newest keyframe, dB, NaN before the first iteration.
    """

    iterations: int
    psnr_db: float
    distance_error: float
    """Root mean square of the signed distance's error, share of the band."""
    elapsed_ms: float
    converged: bool


@dataclass(frozen=True)
class Status:
    """What the space can show now; fields as in VspaceStatus.msg.

    Training figures are of the newest keyframe. While ``refreshing``, pictures show the keyframe before it, and
    ``ready_radius_m`` counts from that one.
    """

    state: State
    refreshing: bool
    psnr_db: float
    iterations: int
    train_seconds: float
    """Spent in training since the newest keyframe."""
    ready_iterations: int
    """Iterations from the keyframe until READY, 0 while not ready."""
    ms_per_iteration: float
    ready_radius_m: float
    """How far from the keyframe a view is fit to show."""
    converged: bool
    device: str
    warning: str = ""
    """What is not as it should be with the device; empty when all is well."""


class NotReadyError(RuntimeError):
    """Asked for training or a picture before the first keyframe."""


class DeviceError(RuntimeError):
    """The device that was asked for is not there."""


@dataclass(frozen=True)
class _Learnt:
    """The space of one keyframe: its scene, a frozen copy of its field (None: the one that is being trained)."""

    scene: Scene
    frozen: Any
    progress: Progress


class VirtualSpace:
    """A hash-grid radiance field that is trained from the newest keyframe and drawn between training steps.

    A space that is fit to show stays so: a new keyframe is learnt behind it, and takes over once it is fit itself.
    One thread at a time. The same calls with the same seed give the same bits on the CPU, as long as training is asked
    for by iterations and not by time.

    Example:
        >>> space = VirtualSpace(VirtualSpaceConfig())                        # doctest: +SKIP
        >>> space.set_keyframe(rgb, depth_m, map_from_camera, relative_sigma=0.05)
        >>> space.train(iterations=200).psnr_db
        >>> space.render(map_from_camera, 320, 180, fov_rad=1.57).rgb
    """

    def __init__(self, config: VirtualSpaceConfig | None = None) -> None:
        self.config = config or VirtualSpaceConfig()
        if self.config.source == "mesh":
            raise ValueError("source is mesh: nothing is learnt there; use make_space, which draws the mesh")
        self._device = make_device(self.config)
        self._warning = ""
        self._scene: Scene | None = None
        self._kept: list[_Learnt] = []  # keyframes before the newest that were fit, newest first
        self._warps: list[PanoramaWarp] = []
        self._texture: tuple[PanoramaPrior, Texture] | None = None
        self._can_warp = importlib.util.find_spec("numba") is not None
        self._gains: list[Floats] = [np.ones(3, np.float32)]  # of the keyframes that pictures show
        self._rng = np.random.default_rng(self.config.train.seed)
        self._reset_run(refresh=False)

    def _reset_run(self, refresh: bool) -> None:
        self._schedule = Schedule(self.config.train, refresh)
        self._psnr_db = math.nan
        self._colour_error = math.nan
        self._history: deque[float] = deque(maxlen=self.config.readiness.plateau_iterations + 1)
        self._ready_iterations = 0
        self._train_seconds = 0.0

    @property
    def keyframe(self) -> PanoramaPrior | None:
        """The keyframe that pictures show."""
        shown = self._shown
        return shown[0].scene.prior if shown else None

    @property
    def _done(self) -> bool:
        """Nothing is left to train."""
        return self._schedule.finished or self.config.source == "warp"

    @property
    def _refreshing(self) -> bool:
        """The newest keyframe is not fit yet, and pictures show those before it."""
        return bool(self._kept) and not self._ready_iterations

    @property
    def _shown(self) -> list[_Learnt]:
        """What pictures show, newest first."""
        if self._scene is None:
            return []
        return self._kept if self._refreshing else [_Learnt(self._scene, None, self._progress), *self._kept]

    def _keep(self, count: int) -> None:
        """Lets go of all but so many of the keyframes before the newest; the others get the newest's exposure."""
        del self._kept[count:]
        newest, *older = (learnt.scene.prior for learnt in self._shown)
        self._gains = [np.ones(3, np.float32), *(exposure_gain(newest, prior) for prior in older)]

    def set_keyframe(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
        relative_sigma: float | NDArray[np.floating],
    ) -> None:
        """Learns a new keyframe; the field goes on from its present weights where it can.

        Of the keyframes before it ``config.keyframes`` − 1 are kept (0, the paper's way), if they were fit: pictures
        show them together, in the newest's exposure. A keyframe that was not fit is replaced.

        Args: as ``prior.prepare``.

        Raises:
            KeyframeError: the keyframe is no good; the old space stays as it was.
        """
        config = self.config
        prior = prepare(rgb, depth_m, map_from_camera, relative_sigma, config.geometry, config.panorama_width)
        occupancy = build_occupancy(prior, config.geometry)
        lattice = Lattice.for_prior(prior, config.field)
        if self._scene is not None and self._ready_iterations:
            frozen = self._on_device(lambda device: device.freeze())
            self._kept.insert(0, _Learnt(self._scene, frozen, self._progress))
        refresh = self._scene is not None and self._scene.lattice.suits(lattice)
        if refresh:
            assert self._scene is not None
            lattice = self._scene.lattice
        elif self._scene is not None:
            self._device.load(FieldParameters.random(config.field, config.train.seed))
        scene = Scene((prior,), lattice, occupancy)
        try:
            self._on_device(lambda device: device.set_scene(scene))
        except Exception:
            if not refresh:  # the old parameters are gone
                self._scene, self._kept = None, []
                self._reset_run(refresh=False)
            raise
        self._scene = scene
        self._reset_run(refresh)
        if config.source == "warp":
            self._ready_iterations = 1  # a warp is ready at once
        self._keep(config.keyframes - 1 if self._ready_iterations else config.keyframes)

    def train(self, budget_ms: float = math.inf, iterations: int | None = None) -> TrainStats:
        """Trains until the time is spent, the iterations are done or the schedule has ended, at least one iteration.

        Raises:
            NotReadyError: no keyframe yet.
        """
        if self._scene is None:
            raise NotReadyError("no keyframe yet: call set_keyframe first")
        start = time.perf_counter()
        done, distance_error = 0, math.nan
        limit = self.config.train.iterations if iterations is None else iterations
        shape = (self.config.train.ray_columns * self.config.train.ray_rows, 3)
        while not self._done and done < limit:
            uniform = self._rng.random(shape, np.float32)
            colour, distance = self._on_device(functools.partial(_step, uniform, self._schedule.rates()))
            self._schedule.iteration += 1
            done += 1
            distance_error = math.sqrt(distance)
            self._note(colour)
            if (time.perf_counter() - start) * 1e3 >= budget_ms:
                break
        elapsed = time.perf_counter() - start
        self._train_seconds += elapsed
        return TrainStats(done, self._psnr_db, distance_error, elapsed * 1e3, self._done)

    def _note(self, colour_error: float) -> None:
        first = math.isnan(self._colour_error)
        self._colour_error = colour_error if first else 0.9 * self._colour_error + 0.1 * colour_error
        self._psnr_db = -10 * math.log10(max(self._colour_error, 1e-10))
        self._history.append(self._psnr_db)
        rule = self.config.readiness
        full = len(self._history) == rule.plateau_iterations + 1
        plateau = full and self._history[-1] - self._history[0] < rule.plateau_db
        good = self._psnr_db >= rule.psnr_db and self._schedule.iteration >= 5
        if not self._ready_iterations and (good or plateau or self._schedule.finished):
            self._ready_iterations = self._schedule.iteration
            self._keep(self.config.keyframes - 1)

    @property
    def status(self) -> Status:
        """What the space can show now."""
        iterations = self._schedule.iteration
        if self._scene is None:
            state = State.EMPTY
        else:
            state = State.READY if self._ready_iterations or self._kept else State.TRAINING
        return Status(
            state=state,
            refreshing=self._refreshing,
            psnr_db=self._psnr_db,
            iterations=iterations,
            train_seconds=self._train_seconds,
            ready_iterations=self._ready_iterations if self.config.source == "field" else 0,
            ms_per_iteration=self._train_seconds * 1e3 / iterations if iterations else 0.0,
            ready_radius_m=self._ready_radius_m() if state == State.READY else 0.0,
            converged=self._scene is not None and self._done,
            device=self._device.name,
            warning=self._warning,
        )

    def _ready_radius_m(self) -> float:
        """A surface at depth D, wrong by σ·D, seen from b aside is displaced by about b·σ/D radians."""
        rule, prior = self.config.readiness, self.keyframe
        assert prior is not None
        sigma = max(prior.relative_sigma, 1e-3)
        return min(rule.max_radius_m, rule.parallax_rad * prior.median_depth_m / sigma)

    def render(self, map_from_camera: NDArray[np.floating], width: int, height: int, fov_rad: float) -> View:
        """A perspective picture along the camera's x axis with the horizontal field of view ``fov_rad``.

        Raises:
            NotReadyError: no keyframe yet.
            ValueError: a size or field of view that cannot be drawn, a pose that is not finite.
        """
        check_size(width, height)
        return self._view(perspective_rays(checked_pose(map_from_camera), width, height, fov_rad), "perspective")

    def render_equirect(self, map_from_camera: NDArray[np.floating], width: int) -> View:
        """A panorama, ``width`` × ``width / 2``. Raises as ``render``."""
        check_size(width, width // 2)
        if width % 2:
            raise ValueError(f"a panorama's width must be even (got {width})")
        return self._view(equirect_rays(checked_pose(map_from_camera), width), "equirect")

    def render_cube(self, map_from_camera: NDArray[np.floating], size: int) -> View:
        """Six faces of 90°, (6, size, size), in the order of ``geometry.projections.CUBE_FACES``. Raises as ``render``.

        What is not known is continued across the faces' edges.
        """
        check_size(size, size)
        pose, faces = checked_pose(map_from_camera), []
        round_about: View | None = None
        for rotation in CUBE_FACES.values():
            turned = pose.copy()
            turned[:3, :3] = pose[:3, :3] @ rotation
            face = self._view(perspective_rays(turned, size, size, math.pi / 2), "cube")
            unseen = face.confidence == 0
            if unseen.any():
                round_about = round_about or self.render_equirect(pose, min(4 * size, MAX_VIEW))
                directions = perspective_directions(size, size, math.pi / 2)[unseen] @ rotation.T.astype(np.float32)
                face.rgb[unseen] = np.rint(sample_equirect(round_about.rgb, directions))
            faces.append(face)
        rgb, depth, confidence = (
            np.stack([getattr(f, key) for f in faces]) for key in ("rgb", "depth_m", "confidence")
        )
        return View(rgb, depth, confidence, "cube")

    def expected_psnr_db(self, map_from_camera: NDArray[np.floating], fov_rad: float = math.pi / 2) -> float:
        """PSNR that a view from a pose will have, judged without its truth (``readiness``); −inf without a keyframe.

        From the depth's error, the distance to the keyframes, what they have not seen, and the error in training.
        """
        if self._scene is None:
            return -math.inf
        rays = perspective_rays(checked_pose(map_from_camera), *_PROBE, fov_rad)
        _, depth, confidence = self._draw_shown(rays, warps=True)
        return self._judge(rays, depth, confidence)

    def _judge(self, rays: Rays, depth: Floats, confidence: Floats) -> float:
        """Expected PSNR of a view as it was drawn, (P,) each; a few thousand pixels tell it."""
        step = max(1, rays.shape[1] // _PROBE[0])
        height, width = rays.shape
        chosen = np.arange(height * width).reshape(height, width)[step // 2 :: step, step // 2 :: step].reshape(-1)
        some = Rays(rays.origin, rays.directions[chosen], rays.axial[chosen], (len(chosen), 1))
        shown = self._shown
        priors = [one.scene.prior for one in shown]
        if self._texture is None or self._texture[0] is not priors[0]:
            self._texture = priors[0], Texture.of(priors[0].rgb)
        terms = error_terms(priors, self._texture[1], some, depth[chosen], confidence[chosen])
        return expected_psnr_db(terms, shown[0].progress.psnr_db, self._panorama_share(shown[0]))

    def _view(self, rays: Rays, projection: str) -> View:
        if self._scene is None:
            raise NotReadyError("no keyframe yet: call set_keyframe first")
        height, width = rays.shape
        colour, depth, confidence = self._draw_shown(rays, warps=projection != "equirect")
        expected = self._judge(rays, depth, confidence)
        depth, confidence = depth.reshape(height, width), confidence.reshape(height, width)
        image = continue_unseen(colour.reshape(height, width, 3), depth, confidence, wraps=projection == "equirect")
        rgb = np.rint(np.clip(image, 0, 1) * np.float32(255)).astype(np.uint8)
        return View(rgb, depth, confidence, projection, expected)

    def _draw_shown(self, rays: Rays, warps: bool) -> tuple[Floats, Floats, Floats]:
        """Colour, depth and confidence of a view's rays by all that pictures show."""

        def draw(device: Device) -> tuple[Floats, Floats, Floats]:
            drawn = [self._draw(device, rays, shown, warps) for shown in self._shown]
            if len(drawn) == 1:
                return drawn[0]
            parts = zip(self._shown, self._gains, drawn, strict=True)
            return compose([Layer(shown.scene.prior, gain, *part) for shown, gain, part in parts], rays)

        return self._on_device(draw)

    def _draw(self, device: Device, rays: Rays, shown: _Learnt, warps: bool) -> tuple[Floats, Floats, Floats]:
        """A keyframe's part of a view: its panorama warped, then the field as it becomes better."""
        share, depth_share = self._panorama_share(shown), self.config.picture.depth_share(shown.progress.psnr_db)
        if share == 0 or not (warps and self._can_warp):
            return device.draw(rays, share, depth_share, shown.frozen)
        warped = self._warp(shown.scene.prior).draw(rays)
        if share == 1:
            return warped
        colour, depth, confidence = device.draw(rays, 0.0, depth_share, shown.frozen)
        return dissolve(warped, (colour, depth, confidence), share)

    def _panorama_share(self, shown: _Learnt) -> float:
        return 1.0 if self.config.source == "warp" else self.config.picture.panorama_share(shown.progress.psnr_db)

    def _warp(self, prior: PanoramaPrior) -> PanoramaWarp:
        """The keyframe as a warp; made at its first picture, kept as long as pictures show it."""
        shown = [learnt.scene.prior for learnt in self._shown]
        self._warps = [warp for warp in self._warps if any(warp.prior is one for one in shown)]
        for warp in self._warps:
            if warp.prior is prior:
                return warp
        self._warps.append(PanoramaWarp.of_prior(prior))
        return self._warps[-1]

    def _on_device(self, call: Callable[[Device], T]) -> T:
        """Calls; a GPU without memory is left for the CPU where ``device`` is ``auto``, with what is learnt."""
        try:
            return call(self._device)
        except RuntimeError as error:
            if type(error).__name__ != "OutOfMemoryError" or self.config.device != "auto":
                raise
            self._warning = f"{self._device.name} is out of memory; on the CPU from now on ({error})"
        parameters = self._device.parameters()
        self._device = make_device(dataclasses.replace(self.config, device="cpu"))
        self._device.load(parameters)
        self._kept = []  # their copies lie on the device that is left
        self._gains = self._gains[:1]
        if self._scene is not None:
            self._device.set_scene(self._scene)
        return call(self._device)

    def parameters(self) -> FieldParameters:
        """A copy of the field's present parameters."""
        return self._device.parameters()

    @property
    def _progress(self) -> Progress:
        schedule = self._schedule
        return Progress(
            self._psnr_db, schedule.iteration, schedule.refresh, self._ready_iterations, self._train_seconds
        )

    def save(self, path: str | Path) -> Path:
        """Saves the space that pictures show as one ``.npz`` file; ``path`` is that or a folder. Returns the file.

        The optimiser's moments are not in it: training that goes on from a file starts them anew.

        Raises:
            NotReadyError: no keyframe yet.
            OSError: the file cannot be written; an older one stays as it was.
        """
        if self._scene is None:
            raise NotReadyError("no keyframe yet: there is nothing to save")
        learnt = [
            SavedKeyframe(shown.scene.prior, shown.scene.lattice, self._device.parameters(shown.frozen), shown.progress)
            for shown in self._shown
        ]
        return write(path, SavedSpace(self.config, tuple(learnt)))

    @classmethod
    def load(cls, path: str | Path, device: str | None = None) -> VirtualSpace:
        """The space of a file (or of the folder it lies in). Its pictures have the same bits as before, on the CPU.

        Args:
            path: what ``save`` was given.
            device: as in ``VirtualSpaceConfig``; the file's own where None.

        Raises:
            SpaceFileError: missing, damaged, foreign, or of a newer version.
        """
        saved = read(path)
        space = cls(saved.config if device is None else dataclasses.replace(saved.config, device=device))
        scenes = [
            Scene((one.prior,), one.lattice, build_occupancy(one.prior, saved.config.geometry))
            for one in saved.keyframes
        ]
        newest = saved.keyframes[0]
        kept: list[_Learnt] = []
        for one, scene in reversed(list(zip(saved.keyframes, scenes, strict=True))):
            space._device.load(one.parameters)
            space._device.set_scene(scene)
            if one is not newest:
                kept.insert(0, _Learnt(scene, space._device.freeze(), one.progress))
        progress = newest.progress
        space._schedule = Schedule(saved.config.train, progress.refresh, progress.iteration)
        space._psnr_db, space._train_seconds = progress.psnr_db, progress.train_seconds
        space._colour_error = 10 ** (-progress.psnr_db / 10)
        space._ready_iterations = progress.ready_iterations
        space._scene, space._kept = scenes[0], kept
        space._keep(len(kept))
        # Rays that were not drawn before, the same at each loading.
        space._rng = np.random.default_rng((saved.config.train.seed, progress.iteration))
        return space


def _step(uniform: Floats, rates: tuple[float, float], device: Device) -> tuple[float, float]:
    return device.step(uniform, *rates)


def make_device(config: VirtualSpaceConfig) -> Device:
    """The device that ``config.device`` asks for.

    Raises:
        DeviceError: CUDA was asked for and torch finds none.
    """
    if config.device == "cuda" or (config.device == "auto" and _may_have_cuda()):
        import torch

        if torch.cuda.is_available():
            from .torch_device import TorchDevice

            return TorchDevice(config.field, config.train, "cuda")
        if config.device == "cuda":
            raise DeviceError("device is cuda, but torch finds no CUDA device; use auto or cpu")
    if config.device != "torch-cpu":
        try:
            from .numba_device import NumbaDevice
        except ImportError:
            if config.device == "cpu":
                raise
        else:
            return NumbaDevice(config.field, config.train)
    from .torch_device import TorchDevice

    return TorchDevice(config.field, config.train, "cpu")


def _may_have_cuda() -> bool:
    """Whether the machine has an NVIDIA device at all: importing torch only to learn that it has not costs seconds."""
    return any(Path(place).exists() for place in ("/dev/nvidiactl", "/dev/nvmap", "/dev/dxg"))


__all__ = ["KeyframeError", "NotReadyError", "State", "Status", "TrainStats", "View", "VirtualSpace", "make_device"]
