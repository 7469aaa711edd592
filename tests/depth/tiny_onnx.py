"""Tiny ONNX files with the inputs and outputs of real depth models."""

from collections.abc import Sequence
from pathlib import Path

from onnx import NodeProto, TensorProto, checker, helper, save_model

FLOAT, HALF, BYTES = TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.UINT8


def write(
    path: Path,
    inputs: dict[str, Sequence[int | str]],
    outputs: dict[str, Sequence[int | str]],
    nodes: Sequence[NodeProto],
    constants: dict[str, Sequence[int]] | None = None,
    kind: int = FLOAT,
    output_kind: int = FLOAT,
) -> None:
    """Writes a graph whose integer constants are given by name."""
    graph = helper.make_graph(
        list(nodes),
        "tiny",
        [helper.make_tensor_value_info(name, kind, list(shape)) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, output_kind, list(shape)) for name, shape in outputs.items()],
        [helper.make_tensor(n, TensorProto.INT64, [len(v)], list(v)) for n, v in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    checker.check_model(model)
    save_model(model, str(path))


def channel(source: str, index: int, result: str, axis: int = 1) -> list[NodeProto]:
    """Takes one channel; the constants ``c0``..``c3`` and ``axis`` must be there."""
    return [helper.make_node("Slice", [source, f"c{index}", f"c{index + 1}", f"axis{axis}"], [result])]


CHANNELS = {f"c{i}": [i] for i in range(4)} | {f"axis{i}": [i] for i in range(4)}
