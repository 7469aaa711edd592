"""Choice of the backend, and failures of a GPU's kernels; the GPU is simulated by torch on the CPU."""

import dataclasses
import sys
import types

import pytest
import torch

from instant_ic.vspace import FieldConfig, TrainConfig, VirtualSpace, VirtualSpaceConfig, devices
from instant_ic.vspace.devices import DeviceError, check_device, make_device
from instant_ic.vspace.nerf.numba_device import NumbaDevice
from tests.vspace.torch_device import TorchDevice

CONFIG = VirtualSpaceConfig(
    field=FieldConfig(levels=2, log2_table=10, hidden=8), train=TrainConfig(ray_columns=16, ray_rows=16)
)


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
    return kind


def with_device(name):
    return dataclasses.replace(CONFIG, device=name)


def test_without_a_gpu_numba_is_taken(monkeypatch):
    monkeypatch.setattr(devices, "_may_have_cuda", lambda: False)
    device, warning = make_device(with_device("auto"))
    assert isinstance(device, NumbaDevice)
    assert not warning


def test_a_gpu_asked_for_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match="device is cuda, but torch finds no CUDA device; use auto or cpu"):
        make_device(with_device("cuda"))


@pytest.mark.parametrize("name", ["auto", "cuda"])
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
def test_kernels_that_fail_are_left_for_the_cpu_with_a_warning(gpu, fault, words):
    for key, value in fault.items():
        setattr(gpu, key, value)
    with pytest.raises(DeviceError, match="the Triton kernels do not work here"):
        make_device(with_device("cuda"))
    space = VirtualSpace(with_device("auto"))
    assert isinstance(space.device, NumbaDevice)
    assert words in space.status.warning and "on the CPU" in space.status.warning


def test_a_missing_triton_is_told(gpu, monkeypatch):
    monkeypatch.setitem(sys.modules, "instant_ic.vspace.nerf.triton_device", None)  # importing it is an ImportError
    device, warning = make_device(with_device("auto"))
    assert isinstance(device, NumbaDevice)
    assert "pip install 'instant-ic[triton]'" in warning


def test_a_density_field_runs_on_the_cpu(gpu):
    density = dataclasses.replace(CONFIG, field=dataclasses.replace(CONFIG.field, geometry="density"))
    assert isinstance(make_device(density)[0], NumbaDevice)
    with pytest.raises(ValueError, match="with geometry density"):
        dataclasses.replace(density, device="cuda")


def test_a_gpu_without_memory_is_no_fault_of_the_kernels(gpu):
    gpu.error = torch.OutOfMemoryError("2 GiB wanted")
    with pytest.raises(torch.OutOfMemoryError):
        make_device(with_device("cuda"))
    device, warning = make_device(with_device("auto"))
    assert isinstance(device, NumbaDevice)
    assert "out of memory" in warning
    assert "2 GiB wanted" in warning


def test_the_check_compares_views_too():
    class WrongColours(Broken):
        def render_rays(self, *arguments):
            colour, depth, confidence = super().render_rays(*arguments)
            return 1 - colour, depth, confidence

    check_device(Broken, CONFIG.field)
    with pytest.raises(DeviceError, match="of a view's pixels"):
        check_device(WrongColours, CONFIG.field)
