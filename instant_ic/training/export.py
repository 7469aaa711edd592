"""Export of the completion network to ONNX with manifest and training record (torch and onnx)."""

from __future__ import annotations

import hashlib
import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from instant_ic.depth.completion import PRIOR_CHANNELS
from instant_ic.depth.manifest import ModelManifest, manifest_path, save_manifest
from instant_ic.training.completion import CompletionNet
from instant_ic.util.files import replacing

OPSET = 17
HALF_PRECISION_MIN_ELEMENTS = 256
MAX_RELATIVE_DIFFERENCE = 1e-3
"""Above the rounding errors that weights amplify, far below those of a wrong operator."""
MAX_HALF_DIFFERENCE = 2e-2


class ExportError(RuntimeError):
    """The exported file's output differs from the network's."""


def export_onnx(model: CompletionNet, path: str | Path) -> dict[str, float]:
    """Export the network as ONNX of fixed shape and compare it with torch on a random image.

    Batch norms are folded into the convolutions before them. Weights are stored as float16; inference computes in
    float32.

    Args:
        model: the network; switched to evaluation mode.
        path: file to write; replaced only after all checks have passed.

    Returns:
        ``difference``: largest |onnx - torch| over the largest |torch|, with float32 weights; ``half_difference``: the
        same for the file.

    Raises:
        ExportError: a difference is too large, or the network's output is not finite.
        OSError: the file cannot be written.
    """
    path = Path(path)
    model.eval()
    inputs = _example(model)
    with torch.inference_mode():
        expected = model(*inputs.values())[0].numpy()
    if not np.isfinite(expected).all() or not np.ptp(expected):
        raise ExportError("the network outputs no depth: all pixels have the same value, or none")
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "model.onnx"
        with warnings.catch_warnings():
            # The tracing exporter is the fast one here.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                model, tuple(inputs.values()), str(plain), dynamo=False, opset_version=OPSET,
                input_names=list(inputs), output_names=["depth", "sigma"],
            )  # fmt: skip
        result = {"difference": _difference(_run(plain, inputs), expected)}
        if not result["difference"] < MAX_RELATIVE_DIFFERENCE:
            raise ExportError(f"largest difference to torch: {result['difference']:.1e} of the largest depth")
        plain.write_bytes(_halve_weights(plain.read_bytes()))
        result["half_difference"] = _difference(_run(plain, inputs), expected)
        if not result["half_difference"] < MAX_HALF_DIFFERENCE:
            raise ExportError(f"float16 weights change the depth by {result['half_difference']:.1e}")
        with replacing(path) as file:
            file.write(plain.read_bytes())
    return result


def _example(model: CompletionNet) -> dict[str, torch.Tensor]:
    """Return inputs by name: a random image, and a random prior with some measured pixels."""
    height, width = model.config.height, model.config.width
    generator = torch.Generator().manual_seed(1)
    image = torch.rand((1, 3, height, width), generator=generator)
    prior = torch.rand((1, PRIOR_CHANNELS, height, width), generator=generator)
    prior[:, 0] = 4 * prior[:, 0] * (prior[:, 1] > 0.3)
    prior[:, 2] = ((prior[:, 2] > 0.95) & (prior[:, 0] > 0)).float()
    return {"image": image, "prior": prior}


def _run(path: Path, inputs: dict[str, torch.Tensor]) -> NDArray[np.float32]:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {name: value.numpy() for name, value in inputs.items()})[0])


def _difference(got: NDArray[np.floating], expected: NDArray[np.floating]) -> float:
    return float(np.abs(got - expected).max() / np.abs(expected).max())


def _halve_weights(content: bytes) -> bytes:
    """Store large float32 initialisers as float16 behind a Cast, which the runtime folds at load time."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    model = onnx.load_from_string(content)
    casts, kept = [], []
    for tensor in model.graph.initializer:
        if tensor.data_type == TensorProto.FLOAT and np.prod(tensor.dims) >= HALF_PRECISION_MIN_ELEMENTS:
            values = numpy_helper.to_array(tensor).astype(np.float16)
            stored = f"{tensor.name}.half"
            kept.append(numpy_helper.from_array(values, stored))
            casts.append(helper.make_node("Cast", [stored], [tensor.name], to=TensorProto.FLOAT))
        else:
            kept.append(tensor)
    nodes = casts + list(model.graph.node)
    del model.graph.initializer[:], model.graph.node[:]
    model.graph.initializer.extend(kept)
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def export_model(
    model: CompletionNet,
    path: str | Path,
    name: str,
    licence: str,
    max_range_m: float,
    record: dict[str, Any] | None = None,
    brightness: float = 0.0,
) -> ModelManifest:
    """Write ``NAME.onnx``, its manifest ``NAME.yaml`` and, if given, the training record ``NAME.json``.

    Raises:
        ExportError, OSError: as :func:`export_onnx`.
        ValueError: a manifest value is invalid.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    differences = export_onnx(model, path)
    manifest = ModelManifest(
        model=path.name,
        name=name,
        licence=licence,
        input_height=model.config.height,
        input_width=model.config.width,
        brightness=brightness,
        max_range_m=max_range_m,
        prior_input="prior",
        sigma_output="sigma",
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
    )
    save_manifest(manifest, manifest_path(path))
    if record is not None:
        text = json.dumps({**record, "export": {"opset": OPSET, **differences}}, indent=1)
        path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    return manifest
