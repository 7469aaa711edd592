"""Choice of the backend: Triton on an NVIDIA GPU, otherwise numba on the CPU."""

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
"""Allowed relative difference between Triton's and numba's training errors, because Triton's tables are float16."""


class DeviceError(RuntimeError):
    """The requested device is absent or does not work."""


def is_out_of_memory(error: Exception) -> bool:
    """Return whether torch reports that the GPU has too little memory, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(error, torch.OutOfMemoryError)


def is_device_fault(error: Exception) -> bool:
    """Return whether the device, and not this software, caused an error."""
    return isinstance(error, DeviceError) or is_out_of_memory(error)


def make_device(config: VirtualSpaceConfig) -> tuple[Device, str]:
    """Return the backend for ``config.device``, and a warning (empty if there is none).

    The Triton kernels are compiled here and compared with numba's results. Compilation takes seconds at the first start
    of an installation; the code is then kept on disk.

    Raises:
        DeviceError: ``config.device`` is ``cuda``, but the GPU is absent or does not work.
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
    """Return whether the machine has an NVIDIA device, without importing torch, which would take seconds."""
    return any(Path(place).exists() for place in ("/dev/nvidiactl", "/dev/nvmap", "/dev/dxg"))


def cpu_device(field: FieldConfig, train: TrainConfig) -> Device:
    """Return the numba backend."""
    from instant_ic.vspace.nerf.numba_device import NumbaDevice  # imported late, because it takes half a second

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
    except Exception as error:  # compiler and driver may raise anything, but the CPU still works
        if is_out_of_memory(error):
            raise
        raise DeviceError(f"the Triton kernels do not work here ({type(error).__name__}: {error})") from error


def check_device(make: Callable[[FieldConfig, TrainConfig], Device], field: FieldConfig) -> None:
    """Run all kernels in two training steps and a view of a test scene, and compare the results with numba's.

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
    for number in range(2):  # the second step uses the CUDA graph
        found, expected = (device.step(uniform[number], 0.01, 0.01) for device in (ours, theirs))
        if not np.allclose(found, expected, rtol=AGREEMENT, atol=1e-4):
            raise DeviceError(f"training step {number + 1} has the errors {found}; numba's are {expected}")
    colours, depths, _ = zip(*(device.render_rays(rays, 0.5, 0.9) for device in (ours, theirs)), strict=True)
    alike = np.isclose(depths[0], depths[1], rtol=0.02) & np.all(np.abs(colours[0] - colours[1]) < 0.05, axis=1)
    if alike.mean() < 0.9:
        raise DeviceError(f"only {alike.mean():.0%} of a view's pixels agree with numba's")


def _scratch(field: FieldConfig) -> tuple[TrainingScene, Rays]:
    """Return a scene, a striped sphere of 2 m seen from its centre, and the rays of a view from beside the centre."""
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[:, ::8] = (250, 120, 30)
    geometry = GeometryConfig(cell_m=0.2)
    prior = prepare(rgb, np.full((32, 64), 2.0, np.float32), np.eye(4), 0.05, geometry, 64)
    pose = np.eye(4)
    pose[0, 3] = 0.3
    return TrainingScene(
        (prior,), Lattice.for_prior(prior, field), build_occupancy([prior], geometry)
    ), perspective_rays(pose, 16, 9, 1.0)
