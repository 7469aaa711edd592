"""Start weights of a training: from a checkpoint, or from an ONNX file of this project (torch, onnx)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from instant_ic.training.folding import unfold_kernel
from instant_ic.training.slicenet import CheckpointError, ConvStage, SliceNet, SliceNetConfig, load_checkpoint

_TOLERANCE = 5e-3
"""Largest difference between the file's depth and that of the network filled from it, over the largest depth. The
export rounded sums of kernel taps to float16, and the import splits these sums again (:mod:`folding`).
"""
_GATES = (0, 2, 3, 1)
"""ONNX orders an LSTM's gates as input, output, forget, cell; torch as input, forget, cell, output."""


@dataclass(frozen=True)
class Start:
    """Starting point of a training.

    Attributes:
        model: with the file's weights.
        folded: its batch norms were folded into the convolutions: call ``unfold_norms`` before training.
        origin: entry for the training record: file, SHA-256, and the record of its own training if there is one.
    """

    model: SliceNet
    folded: bool
    origin: dict[str, Any]


def load_start(path: str | Path, network: SliceNetConfig) -> Start:
    """Read the weights of ``network`` from a checkpoint (``.pt``, ``.pth``) or an ONNX file exported by this project.

    Raises:
        CheckpointError: the file is missing, damaged, or of another network.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from error
    origin: dict[str, Any] = {"file": path.name, "sha256": hashlib.sha256(content).hexdigest()}
    if path.suffix.lower() == ".onnx":
        record = path.with_suffix(".json")
        if record.is_file():
            origin["record"] = json.loads(record.read_text(encoding="utf-8"))
        return Start(_from_onnx(path, content, network), True, origin)
    model = load_checkpoint(path)
    if model.config != network:
        raise CheckpointError(f"{path}: contains {model.config}, but the training uses {network}")
    record = torch.load(path, map_location="cpu", weights_only=True).get("record")
    return Start(model, False, {**origin, "record": record} if record else origin)


def _from_onnx(path: Path, content: bytes, network: SliceNetConfig) -> SliceNet:
    """Fill the network from ONNX weights in execution order, as the exporter drops names; verify against the file."""
    import onnx
    import onnxruntime
    from onnx import numpy_helper

    try:
        graph = onnx.load_from_string(content).graph
    except Exception as error:  # protobuf's decode errors share no public base
        raise CheckpointError(f"{path}: not an ONNX file ({error})") from error
    arrays = {t.name: numpy_helper.to_array(t).astype(np.float32) for t in graph.initializer}
    for node in graph.node:
        if node.op_type == "Cast" and node.input[0] in arrays:
            arrays[node.output[0]] = arrays[node.input[0]]
    stored = {
        kind: [
            [arrays[name] for name in node.input[1:] if name in arrays] for node in graph.node if node.op_type == kind
        ]
        for kind in ("Conv", "PRelu", "LSTM")
    }
    model = SliceNet(network).eval()
    order = _run_order(model)
    stages = [stage for stage in model.decoder if isinstance(stage, ConvStage)]
    upscale = {stage.layers.get_submodule("0.1"): stage.upscale for stage in stages}
    for kind, found in stored.items():
        if len(found) != len(order[kind]):
            raise CheckpointError(f"{path}: has {len(found)} {kind} nodes, {network} has {len(order[kind])}")
    with torch.no_grad():
        for (conv, norm), values in zip(order["Conv"], stored["Conv"], strict=True):
            if len(values) != 2:
                raise CheckpointError(f"{path}: a convolution without bias: its norms are not folded; export it again")
            count = _phases(conv, values[0], upscale.get(conv, (1, 1)))
            kernel = unfold_kernel(torch.from_numpy(values[0]), upscale[conv]).numpy() if count > 1 else values[0]
            _copy(path, conv.weight, kernel)
            if conv.bias is not None:
                conv.bias.zero_()
            norm.running_mean.zero_()
            norm.running_var.fill_(1.0 - norm.eps)
            norm.weight.fill_(1.0)
            _copy(path, norm.bias, values[1][::count])
        for (prelu,), values in zip(order["PRelu"], stored["PRelu"], strict=True):
            _copy(path, prelu.weight, values[0].ravel()[:: max(1, values[0].size // prelu.num_parameters)])
        lstm = order["LSTM"][0][0]
        for layer, values in enumerate(stored["LSTM"]):
            _copy_lstm(path, lstm, layer, *values[:3])
    picture = torch.rand((1, 3, network.height, network.width), generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        got = model(picture).numpy()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    (expected,) = session.run(None, {session.get_inputs()[0].name: picture.numpy()})
    difference = float(np.abs(got - np.asarray(expected).reshape(got.shape)).max() / np.abs(expected).max())
    if not difference < _TOLERANCE:
        raise CheckpointError(f"{path}: its weights do not give its depth (difference {difference:.1e}); "
                              "was it exported by ic depth convert?")  # fmt: skip
    return model


def _phases(conv: nn.Conv2d, kernel: NDArray[np.float32], upscale: tuple[int, int]) -> int:
    """Number of kernels in the file for one convolution of the network; several if the export folded a doubling."""
    count = upscale[0] * upscale[1]
    return count if kernel.shape[0] == count * conv.out_channels else 1


@torch.inference_mode()
def _run_order(model: SliceNet) -> dict[str, list[Any]]:
    """Modules in execution order: convolutions with their norm, PReLUs, LSTM layers."""
    ran: list[nn.Module] = []
    kinds = (nn.Conv2d, nn.BatchNorm2d, nn.PReLU, nn.LSTM)
    hooks = [
        module.register_forward_hook(lambda module, _inputs, _output: ran.append(module))
        for module in model.modules()
        if isinstance(module, kinds)
    ]
    model(torch.zeros(1, 3, model.config.height, model.config.width))
    for hook in hooks:
        hook.remove()
    convs = [m for m in ran if isinstance(m, nn.Conv2d)]
    norms = [m for m in ran if isinstance(m, nn.BatchNorm2d)]
    (lstm,) = [m for m in ran if isinstance(m, nn.LSTM)]
    return {
        "Conv": list(zip(convs, norms, strict=True)),
        "PRelu": [(m,) for m in ran if isinstance(m, nn.PReLU)],
        "LSTM": [(lstm,)] * lstm.num_layers,
    }


def _copy(path: Path, into: Tensor, values: NDArray[np.float32]) -> None:
    if tuple(into.shape) != values.shape:
        raise CheckpointError(f"{path}: a tensor of shape {values.shape} where the network has {tuple(into.shape)}")
    into.copy_(torch.from_numpy(values.copy()))


def _copy_lstm(
    path: Path,
    lstm: nn.LSTM,
    layer: int,
    inputs: NDArray[np.float32],
    recurrent: NDArray[np.float32],
    bias: NDArray[np.float32],
) -> None:
    def turned(values: NDArray[np.float32]) -> NDArray[np.float32]:
        parts = np.split(values, 4)
        return np.concatenate([parts[gate] for gate in _GATES])

    for direction, suffix in enumerate(("", "_reverse")):
        at = f"l{layer}{suffix}"
        half = bias.shape[1] // 2
        _copy(path, getattr(lstm, f"weight_ih_{at}"), turned(inputs[direction]))
        _copy(path, getattr(lstm, f"weight_hh_{at}"), turned(recurrent[direction]))
        _copy(path, getattr(lstm, f"bias_ih_{at}"), turned(bias[direction, :half]))
        _copy(path, getattr(lstm, f"bias_hh_{at}"), turned(bias[direction, half:]))


@torch.inference_mode()
def fold_norms(model: SliceNet) -> None:
    """Fold each batch norm into the preceding convolution, without changing the network's output.

    Args:
        model: in evaluation mode.
    """
    for conv, norm in _run_order(model)["Conv"]:
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        bias = torch.zeros_like(norm.bias) if conv.bias is None else conv.bias
        norm.bias.add_((bias - norm.running_mean) * scale)
        conv.weight.mul_(scale[:, None, None, None])
        if conv.bias is not None:
            conv.bias.zero_()
        norm.running_mean.zero_()
        norm.running_var.fill_(1.0 - norm.eps)
        norm.weight.fill_(1.0)


@torch.inference_mode()
def unfold_norms(model: SliceNet, pictures: Tensor) -> None:
    """Restore mean and scale of folded batch norms from sample images, without changing the network's output.

    In training a norm divides by the batch's own standard deviation. After folding its scale is 1, whatever the
    standard deviation is; the first training step would then break the network.

    Args:
        model: in evaluation mode.
        pictures: (B, 3, H, W) in 0..1, as varied as possible.
    """
    sums: dict[nn.BatchNorm2d, list[Tensor]] = {}

    def look(module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        assert isinstance(module, nn.BatchNorm2d)
        x = inputs[0].double()
        new = [x.sum((0, 2, 3)), (x**2).sum((0, 2, 3)), torch.tensor(x.numel() / x.shape[1])]
        sums[module] = [a + b for a, b in zip(sums[module], new, strict=True)] if module in sums else new

    hooks = [m.register_forward_pre_hook(look) for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    for picture in pictures:
        model(picture[None])
    for hook in hooks:
        hook.remove()
    for norm, (total, square, count) in sums.items():
        mean = total / count
        variance = (square / count - mean**2).clamp_min(1e-6)
        assert norm.running_mean is not None and norm.running_var is not None
        old = norm.weight.double() / torch.sqrt(norm.running_var.double() + norm.eps)
        scale = old * torch.sqrt(variance + norm.eps)
        norm.bias.copy_((norm.bias.double() + old * (mean - norm.running_mean.double())).float())
        norm.weight.copy_(scale.float())
        norm.running_mean.copy_(mean.float())
        norm.running_var.copy_(variance.float())
