"""Choice of the backend: the Triton kernels on an NVIDIA GPU, else numba on the CPU."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from instant_ic.vspace.config import FieldConfig, GeometryConfig, TrainConfig, VirtualSpaceConfig
from instant_ic.vspace.nerf.field import Device, Lattice, Rays, TrainingScene
from instant_ic.vspace.nerf.occupancy import build_occupancy
from instant_ic.vspace.prior import prepare
from instant_ic.vspace.view import perspective_rays

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
    return cpu_device(config.field, config.train), warning


def _may_have_cuda() -> bool:
    """Return whether the machine has an NVIDIA device. Importing torch to find out would take seconds."""
    return any(Path(place).exists() for place in ("/dev/nvidiactl", "/dev/nvmap", "/dev/dxg"))


def cpu_device(field: FieldConfig, train: TrainConfig) -> Device:
    """Return the numba backend."""
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
    ours, theirs = make(small, train), cpu_device(small, train)
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
