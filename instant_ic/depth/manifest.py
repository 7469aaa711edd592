"""Interface of a depth model file: the YAML manifest beside the ONNX file."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import yaml

from instant_ic.config.params import ParameterError, Value, build
from instant_ic.config.ranges import Positive, Range, check_ranges, require
from instant_ic.config.yaml_place import YamlProblem, load
from instant_ic.depth.scaler import OUTPUT_KINDS
from instant_ic.util import paths

REQUIRED = ("model", "name", "licence", "input_height", "input_width")


class ManifestError(ValueError):
    """The manifest of a depth model is missing, malformed or does not match its model."""


class InferenceError(RuntimeError):
    """The inference did not finish; the message says why."""


@dataclass(frozen=True)
class ModelManifest:
    """Interface of a depth model: RGB of a panorama in, radial depth out.

    The network takes (1, 3, height, width) float32: bytes / 255, minus ``mean``, divided by ``std``.

    Attributes:
        model: file name of the ONNX model, beside the manifest.
        name: name shown to people.
        licence: licence of the weights.
        input_height: rows of the network's input.
        input_width: columns of the network's input, twice the rows.
        brightness: mean byte of the training images. Images are scaled to it by a factor of at most 2.5, because a real
            camera's exposure differs from that of the training. 0 leaves images unchanged.
        mean: value per channel that is subtracted from the input.
        std: value per channel by which the difference is divided.
        output_kind: unit of the depth, one of ``scaler.OUTPUT_KINDS``.
        min_range_m: smallest metric depth; smaller known depth is set to it.
        max_range_m: largest metric depth; larger depth is set to it.
        prior_input: name of the input for incomplete depth, (1, 6, height, width) float32
            (``depth.completion.prior_channels``); empty for a model that uses only the image.
        sigma_output: name of the output with the relative standard deviation; required with ``prior_input``.
        sha256: checksum of the model file; empty to leave it unchecked.

    Raises:
        ValueError: a value is wrong; the message starts with its key.
    """

    model: str = ""
    name: str = ""
    licence: str = ""
    input_height: Annotated[int, Range(16, 8192)] = 256
    input_width: Annotated[int, Range(32, 16384)] = 512
    brightness: Annotated[float, Range(0, 254)] = 0.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    output_kind: str = "metric"
    min_range_m: Positive = 0.1
    max_range_m: Positive = 16.0
    prior_input: str = ""
    sigma_output: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        check_ranges(self)
        for key in ("model", "name", "licence"):
            require(self, key, bool(getattr(self, key)), "not empty")
        require(self, "input_width", self.input_width == 2 * self.input_height, "twice input_height: 360° by 180°")
        require(self, "output_kind", self.output_kind in OUTPUT_KINDS, "one of " + ", ".join(OUTPUT_KINDS))
        require(self, "max_range_m", self.max_range_m > self.min_range_m, "above min_range_m")
        both = bool(self.prior_input) == bool(self.sigma_output)
        require(self, "prior_input", both, "given together with sigma_output")
        require(self, "prior_input", not self.prior_input or self.output_kind == "metric", "empty unless metric")
        require(self, "sha256", bool(re.fullmatch(r"([0-9a-f]{64})?", self.sha256)), "64 digits of 0-9a-f")


def manifest_path(model: str | Path) -> Path:
    """Return the manifest of a model file: same name, suffix ``.yaml``."""
    return Path(model).with_suffix(".yaml")


def load_manifest(path: str | Path) -> ModelManifest:
    """Read and check a manifest.

    Raises:
        ManifestError: the manifest is wrong; the message names file, line, key and the expected value.
    """
    path = Path(path)
    if not paths.is_file(path):
        raise ManifestError(f"{path}: no manifest. A depth model needs a manifest beside it (docs/depth.md)")
    try:
        fields = load(path).fields()
        values = {key: Value(field.spelled(), f"{path}:{field.line}") for key, field in fields.items()}
    except YamlProblem as problem:
        raise ManifestError(f"{path}:{problem.line}: {problem.text}") from problem
    if missing := [key for key in REQUIRED if key not in values]:
        raise ManifestError(f"{path}: missing key {', '.join(missing)}")
    try:
        return build(ModelManifest, values)
    except (ParameterError, ValueError) as error:
        text = str(error)
        raise ManifestError(text if str(path) in text else f"{path}: {text}") from None


def save_manifest(manifest: ModelManifest, path: str | Path) -> None:
    """Write a manifest for :func:`load_manifest`."""
    values = asdict(manifest)
    values["mean"], values["std"] = list(manifest.mean), list(manifest.std)
    text = "# Interface of the depth model beside this file; the keys are explained in docs/depth.md.\n"
    text += yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None)
    Path(path).write_text(text, encoding="utf-8")
