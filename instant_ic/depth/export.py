"""SliceNet to ONNX with manifest and training record (torch and onnx)."""

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

from .manifest import ModelManifest, manifest_path, save_manifest
from .slicenet import SliceNet

OPSET = 17
HALF_PRECISION_MIN_ELEMENTS = 256
MAX_RELATIVE_DIFFERENCE = 1e-5
MAX_HALF_DIFFERENCE = 2e-2


class ExportError(RuntimeError):
    """The exported file does not compute what the network does."""


def export_onnx(model: SliceNet, path: str | Path, half_weights: bool = False) -> dict[str, float]:
    """Writes the network as ONNX of fixed shape and holds it against torch on a random picture.

    Args:
        model: the network; put into evaluation mode.
        path: file to write.
        half_weights: store the weights as float16 (half the size); they are computed with in float32.

    Returns:
        ``difference``: largest |onnx - torch| over the largest |torch|, with float32 weights; and
        ``half_difference``: the same of the file with float16 weights, where those are written.

    Raises:
        ExportError: a difference is above what rounding explains.
    """
    model.eval()
    shape = (1, 3, model.config.height, model.config.width)
    picture = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        expected = model(picture).numpy()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "model.onnx"
        with warnings.catch_warnings():
            # The tracing exporter is the fast one here; its successor keeps the LSTM no better.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                model, (picture,), str(plain), dynamo=False, opset_version=OPSET,
                input_names=["image"], output_names=["depth"],
            )  # fmt: skip
        result = {"difference": _difference(plain, picture.numpy(), expected)}
        if result["difference"] > MAX_RELATIVE_DIFFERENCE:
            raise ExportError(f"ONNX differs from torch by {result['difference']:.1e} of the largest depth")
        content = plain.read_bytes()
        if half_weights:
            content = _halve_weights(content)
            plain.write_bytes(content)
            result["half_difference"] = _difference(plain, picture.numpy(), expected)
            if result["half_difference"] > MAX_HALF_DIFFERENCE:
                raise ExportError(f"float16 weights change the depth by {result['half_difference']:.1e}")
    Path(path).write_bytes(content)
    return result


def _difference(path: Path, picture: NDArray[np.float32], expected: NDArray[np.float32]) -> float:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (got,) = session.run(None, {"image": picture})
    return float(np.abs(got - expected).max() / np.abs(expected).max())


def _halve_weights(content: bytes) -> bytes:
    """Stores large float32 initialisers as float16 behind a Cast, which the runtime folds when it loads."""
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
    model: SliceNet,
    path: str | Path,
    name: str,
    licence: str,
    max_range_m: float,
    record: dict[str, Any] | None = None,
    half_weights: bool = False,
    brightness: float = 0.0,
) -> ModelManifest:
    """Writes ``NAME.onnx``, its manifest ``NAME.yaml`` and, where given, the training record ``NAME.json``."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    differences = export_onnx(model, path, half_weights)
    manifest = ModelManifest(
        model=path.name,
        name=name,
        licence=licence,
        input_height=model.config.height,
        input_width=model.config.width,
        brightness=brightness,
        max_range_m=max_range_m,
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
    )
    save_manifest(manifest, manifest_path(path))
    if record is not None:
        text = json.dumps({**record, "export": {"opset": OPSET, **differences}}, indent=1)
        path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    return manifest
