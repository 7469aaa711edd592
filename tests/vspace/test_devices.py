"""Which device is taken, and what happens where a GPU's kernels fail; the GPU is played by torch on the CPU."""

import dataclasses
import sys
import types

import numpy as np
import pytest
import torch

from instant_ic.vspace import FieldConfig, SpaceState, TrainConfig, VirtualSpace, VirtualSpaceConfig, devices
from instant_ic.vspace.devices import DeviceError, check_device, make_device
from instant_ic.vspace.nerf.numba_device import NumbaDevice
from instant_ic.vspace.nerf.torch_device import TorchDevice
from tests import box_room

CONFIG = VirtualSpaceConfig(
    field=FieldConfig(levels=2, log2_table=10, hidden=8), train=TrainConfig(ray_columns=16, ray_rows=16)
)


def plain(field, train, device="cpu"):
    return TorchDevice(field, train, "cpu")


class Broken(TorchDevice):
    """A device as the kernels' compiler may leave it."""

    error: Exception | None = None
    factor = 1.0

    def __init__(self, field, train, device="cuda"):
        super().__init__(field, train, "cpu")

    def step(self, uniform, table_lr, network_lr):
        if self.error is not None:
            raise self.error
        colour, distance = super().step(uniform, table_lr, network_lr)
        return self.factor * colour, distance


@pytest.fixture
def gpu(monkeypatch):
    """A machine with a GPU whose Triton device is ``Broken``; gives that class."""
    kind = type("Fake", (Broken,), {})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(devices, "_may_have_cuda", lambda: True)
    monkeypatch.setitem(sys.modules, "instant_ic.vspace.nerf.triton_device", types.SimpleNamespace(TritonDevice=kind))
    monkeypatch.setattr("instant_ic.vspace.nerf.torch_device.TorchDevice", plain)
    return kind


def with_device(name):
    return dataclasses.replace(CONFIG, device=name)


def test_without_a_gpu_numba_is_taken(monkeypatch):
    monkeypatch.setattr(devices, "_may_have_cuda", lambda: False)
    device, warning = make_device(with_device("auto"))
    assert isinstance(device, NumbaDevice)
    assert not warning


@pytest.mark.parametrize("name", ["cuda", "triton", "torch-cuda"])
def test_a_gpu_asked_for_that_is_not_there_is_told(monkeypatch, name):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match=f"device is {name}, but torch finds no CUDA device; use auto or cpu"):
        make_device(with_device(name))


@pytest.mark.parametrize("name", ["auto", "cuda", "triton"])
def test_kernels_that_are_right_are_taken(gpu, name):
    device, warning = make_device(with_device(name))
    assert isinstance(device, gpu)
    assert not warning


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"error": RuntimeError("ptxas: no such option")}, "RuntimeError: ptxas: no such option"),
        ({"factor": 3.0}, "step 1 has the errors"),
        ({"factor": float("nan")}, "step 1 has the errors"),
    ],
)
def test_kernels_that_fail_are_left_for_plain_torch_with_a_warning(gpu, fault, words):
    for key, value in fault.items():
        setattr(gpu, key, value)
    space = VirtualSpace(with_device("cuda"))
    assert words in space.status.warning
    assert "by plain torch" in space.status.warning
    picture = box_room.panorama(np.eye(4), 32)
    space.set_keyframe(picture.rgb, picture.depth_m, np.eye(4), 0.05)
    space.train(iterations=2)
    assert space.status.iterations == 2  # and it works
    assert space.status.state != SpaceState.FAILED
    with pytest.raises(DeviceError, match="device is triton, but the Triton kernels do not work"):
        make_device(with_device("triton"))
    device, warning = make_device(with_device("auto"))
    assert isinstance(device, NumbaDevice)  # plain torch renders a view in 1.8 s on an H100
    assert words in warning and "on the CPU" in warning


def test_a_missing_triton_is_told(gpu, monkeypatch):
    monkeypatch.setitem(sys.modules, "instant_ic.vspace.nerf.triton_device", None)  # importing it is an ImportError
    for name, kind in (("auto", NumbaDevice), ("cuda", TorchDevice)):
        device, warning = make_device(with_device(name))
        assert isinstance(device, kind)
        assert "pip install 'instant-ic[triton]'" in warning


def test_a_gpu_without_memory_is_no_fault_of_the_kernels(gpu):
    gpu.error = torch.OutOfMemoryError("2 GiB wanted")
    with pytest.raises(torch.OutOfMemoryError):
        make_device(with_device("cuda"))
    device, warning = make_device(with_device("auto"))
    assert isinstance(device, NumbaDevice)
    assert "out of memory" in warning
    assert "2 GiB wanted" in warning


def test_the_check_compares_pictures_too():
    class WrongColours(Broken):
        def draw(self, *arguments):
            colour, depth, confidence = super().draw(*arguments)
            return 1 - colour, depth, confidence

    check_device(Broken, plain, CONFIG.field)
    with pytest.raises(DeviceError, match="of an image's pixels"):
        check_device(WrongColours, plain, CONFIG.field)
