"""Choice of the backend: the Triton kernels on an NVIDIA GPU, else numba on the CPU."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from instant_ic.vspace.config import FieldConfig, GeometryConfig, TrainConfig, VirtualSpaceConfig
from instant_ic.vspace.nerf.field import Device, FieldParameters, Floats, Lattice, Rays, TrainingScene
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.prior import prepare
from instant_ic.vspace.view import perspective_rays

T = TypeVar("T")
AGREEMENT = 0.1
"""Allowed relative difference between Triton's and numba's training errors: Triton's tables are float16."""


class DeviceError(RuntimeError):
    """The requested device is absent or does not work."""


def is_out_of_memory(error: Exception) -> bool:
    """Return whether torch raised this because the GPU has too little memory; does not import torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(error, torch.OutOfMemoryError)


def is_device_fault(error: Exception) -> bool:
    """Return whether an error has its cause in the device and not in this software."""
    return isinstance(error, DeviceError) or is_out_of_memory(error)


def make_device(config: VirtualSpaceConfig) -> tuple[Device, str]:
    """Return the backend for ``config.device``, and a warning (empty when there is none).

    The Triton kernels are compiled here (seconds at the first start of an installation, then kept on disk), and their
    results compared with numba's.

    Raises:
        DeviceError: the GPU was asked for, and it is not there or does not work.
    """
    warning, wants_gpu = "", config.device == "cuda"
    if wants_gpu or (config.device == "auto" and config.field.geometry == "distance" and _may_have_cuda()):
        import torch

        if torch.cuda.is_available():
            try:
                return _gpu_device(config), ""
            except (DeviceError, torch.OutOfMemoryError) as error:
                if wants_gpu:
                    raise
                reason = f"the GPU is out of memory ({error})" if is_out_of_memory(error) else str(error)
                warning = f"{reason}: on the CPU"
        elif wants_gpu:
            raise DeviceError("device is cuda, but torch finds no CUDA device; use auto or cpu")
    return _cpu_device(config.field, config.train), warning


class FallbackDevice:
    """The backend of a space; with ``device: auto``, a GPU that runs out of memory is replaced by the CPU.

    Args:
        config: parameters of the space.

    Attributes:
        backend: the backend in use.
        warning: problem of the device; empty when there is none.

    Raises:
        DeviceError: a device was asked for that is not there, or does not work.
    """

    def __init__(self, config: VirtualSpaceConfig) -> None:
        self._config = config
        self._scene: TrainingScene | None = None
        self.backend, self.warning = make_device(config)

    @property
    def name(self) -> str:
        """Name of the hardware and the backend."""
        return self.backend.name

    @property
    def on_gpu(self) -> bool:
        """True if the backend computes on a GPU."""
        return self.backend.on_gpu

    def load(self, parameters: FieldParameters) -> None:
        """Load parameters and reset the optimiser's moments."""
        self.backend.load(parameters)

    def parameters(self) -> FieldParameters:
        """Return a copy of the present parameters."""
        return self.backend.parameters()

    def set_scene(self, scene: TrainingScene) -> None:
        """Train and render this scene from now on, with the present parameters."""
        self._call(lambda: self.backend.set_scene(scene))
        self._scene = scene

    def start_anew(self, scene: TrainingScene, parameters: FieldParameters) -> None:
        """Train this scene from other parameters; a failure leaves the old scene and parameters."""
        learnt, old = self.parameters(), self._scene

        def start() -> None:
            self.backend.load(parameters)
            self.backend.set_scene(scene)

        try:
            self._call(start)
        except Exception:
            self.backend.load(learnt)
            if old is not None:
                self.backend.set_scene(old)
            raise
        self._scene = scene

    def step(self, uniform: Floats, table_lr: float, network_lr: float) -> tuple[float, float]:
        """Train one iteration, as ``Device.step``."""
        return self._call(lambda: self.backend.step(uniform, table_lr, network_lr))

    def render_rays(self, rays: Rays, panorama_share: float, depth_share: float) -> tuple[Floats, Floats, Floats]:
        """Render rays, as ``Device.render_rays``."""
        return self._call(lambda: self.backend.render_rays(rays, panorama_share, depth_share))

    def _call(self, work: Callable[[], T]) -> T:
        try:
            return work()
        except RuntimeError as error:
            if not is_out_of_memory(error) or self._config.device != "auto":
                raise
            self.warning = f"{self.name} is out of memory; on the CPU from now on ({error})"
        parameters = self.backend.parameters()
        self.backend, _ = make_device(dataclasses.replace(self._config, device="cpu"))
        self.backend.load(parameters)
        if self._scene is not None:
            self.backend.set_scene(self._scene)
        return work()


def _may_have_cuda() -> bool:
    """Return whether the machine has an NVIDIA device. Importing torch to find out would take seconds."""
    return any(Path(place).exists() for place in ("/dev/nvidiactl", "/dev/nvmap", "/dev/dxg"))


def _cpu_device(field: FieldConfig, train: TrainConfig) -> Device:
    from instant_ic.vspace.nerf.numba_device import NumbaDevice  # compiled code: half a second

    return NumbaDevice(field, train)


def _gpu_device(config: VirtualSpaceConfig) -> Device:
    """Return the Triton backend after a check of its results.

    Raises:
        DeviceError: Triton is absent, or its kernels do not work on this GPU.
    """
    try:
        from instant_ic.vspace.nerf.triton_device import TritonDevice

        check_device(TritonDevice, config.field)
        return TritonDevice(config.field, config.train)
    except ImportError as error:
        raise DeviceError(f"Triton is not installed ({error}); pip install 'instant-ic[triton]'") from error
    except Exception as error:  # a compiler, a driver: whatever they raise, the CPU still works
        if is_out_of_memory(error):
            raise
        raise DeviceError(f"the Triton kernels do not work here ({type(error).__name__}: {error})") from error


def check_device(make: Callable[[FieldConfig, TrainConfig], Device], field: FieldConfig) -> None:
    """Compare two training steps and a view of a scratch scene with numba's, so that all kernels are run.

    Raises:
        DeviceError: the results differ.
    """
    small = dataclasses.replace(field, log2_table=10)
    train = TrainConfig(ray_columns=16, ray_rows=8)
    ours, theirs = make(small, train), _cpu_device(small, train)
    scene, rays = _scratch(small)
    uniform = np.random.default_rng(0).random((2, train.ray_columns * train.ray_rows, 3), np.float32)
    for device in (ours, theirs):
        device.set_scene(scene)
    for number in range(2):  # the second is the graph's
        found, expected = (device.step(uniform[number], 0.01, 0.01) for device in (ours, theirs))
        if not np.allclose(found, expected, rtol=AGREEMENT, atol=1e-4):
            raise DeviceError(f"step {number + 1} has the errors {found}, numba {expected}")
    colours, depths, _ = zip(*(device.render_rays(rays, 0.5, 0.9) for device in (ours, theirs)), strict=True)
    alike = np.isclose(depths[0], depths[1], rtol=0.02) & np.all(np.abs(colours[0] - colours[1]) < 0.05, axis=1)
    if alike.mean() < 0.9:
        raise DeviceError(f"only {alike.mean():.0%} of an image's pixels are as numba renders them")


def _scratch(field: FieldConfig) -> tuple[TrainingScene, Rays]:
    """Return a striped sphere of 2 m seen from its middle, and the rays of a view from aside."""
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[:, ::8] = (250, 120, 30)
    geometry = GeometryConfig(cell_m=0.2)
    prior = prepare(rgb, np.full((32, 64), 2.0, np.float32), np.eye(4), 0.05, geometry, 64)
    pose = np.eye(4)
    pose[0, 3] = 0.3
    return TrainingScene(
        (prior,), Lattice.for_prior(prior, field), build_occupancy([prior], geometry)
    ), perspective_rays(pose, 16, 9, 1.0)
