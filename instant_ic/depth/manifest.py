"""Interface of a depth model file: the YAML manifest beside the ONNX file."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

import yaml

from instant_ic.config.scalars import READERS
from instant_ic.config.yaml_text import compose_yaml, resolved, spelled
from instant_ic.depth.scaler import OUTPUT_KINDS

MOST_PIXELS = 16384
"""Largest side of a network's input."""

CHOICES: dict[str, tuple[str, ...]] = {
    "channels": ("rgb", "bgr"),
    "input_layout": ("nchw", "nhwc"),
    "output_kind": OUTPUT_KINDS,
    "output_form": ("depth", "inverse", "points"),
    "geometry": ("radial", "planar"),
    "mask_means": ("valid", "invalid"),
}
REQUIRED = ("model", "name", "licence", "input_height", "input_width")


class ManifestError(ValueError):
    """The manifest of a depth model is missing, malformed or does not fit its model."""


class InferenceError(RuntimeError):
    """The inference did not finish; the text says why."""


@dataclass(frozen=True)
class ModelManifest:
    """Interface of a depth model.

    Attributes:
        model: file name of the ONNX model, beside the manifest.
        name: shown to people.
        licence: of the weights.
        input_height: rows the network takes.
        input_width: columns the network takes; the whole 360° lie on them.
        input_layout: ``nchw`` (1, 3, height, width) or ``nhwc`` (1, height, width, 3).
        channels: ``rgb`` or ``bgr``: order of the channels that the network takes.
        brightness: mean byte of the images that the model was trained on; an image is brought to it by one
            factor, within 1/2.5 .. 2.5 (a real camera's exposure is not that of the training). 0 leaves it as it is.
        input_scale: the bytes are multiplied by it first.
        mean: then this is subtracted, a value a channel in the network's order.
        std: then divided by this.
        depth_output: name of the output that is depth; empty for the first one that is not the mask.
        output_form: ``depth``, ``inverse`` (1 / depth) or ``points`` (three coordinates a pixel, whose length is the
            depth): what the output's numbers are. Inverse and points are turned into depth.
        output_kind: one of ``scaler.OUTPUT_KINDS``: what is known of the depth's unit.
        output_scale: the depth is multiplied by it (100 for a network that gives 0..1 for 0..100 m).
        min_range_m: metric depth between 0 and this is raised to it.
        max_range_m: metric depth above it is cut to it.
        geometry: ``radial`` (distance from the camera) or ``planar`` (along the axis of the cube face that the
            pixel lies on); planar output is turned into radial.
        prior_input: name of the input that takes incomplete depth, (1, 6, height, width) float32
            (``depth.completion.prior_channels``); empty for a model that takes the image alone.
        sigma_output: name of the output with the relative standard deviation; required with ``prior_input``.
        mask_output: name of an output that marks where depth is valid; empty for none.
        mask_means: ``valid``, or ``invalid`` (sky) of the pixels where the mask is above the threshold.
        mask_threshold: of the mask's numbers; 0.5 for probabilities, 0 for logits.
        sha256: of the model file; empty to leave it unchecked.

    Raises:
        ValueError: a value is wrong; the text starts with its key.
    """

    model: str
    name: str
    licence: str
    input_height: int
    input_width: int
    input_layout: str = "nchw"
    channels: str = "rgb"
    brightness: float = 0.0
    input_scale: float = 1.0 / 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    depth_output: str = ""
    output_form: str = "depth"
    output_kind: str = "metric"
    output_scale: float = 1.0
    min_range_m: float = 0.1
    max_range_m: float = 16.0
    geometry: str = "radial"
    prior_input: str = ""
    sigma_output: str = ""
    mask_output: str = ""
    mask_means: str = "valid"
    mask_threshold: float = 0.5
    sha256: str = ""

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.type == "str" and not isinstance(getattr(self, field.name), str):
                raise ValueError(f"{field.name} must be text (got {getattr(self, field.name)!r})")
        for key in ("model", "name", "licence"):
            if not getattr(self, key):
                raise ValueError(f"{key} must not be empty")
        for key in ("input_height", "input_width"):
            value = getattr(self, key)
            if not isinstance(value, int) or isinstance(value, bool) or not 16 <= value <= MOST_PIXELS:
                raise ValueError(f"{key} must be a whole number from 16 to {MOST_PIXELS} (got {value!r})")
        if not 1.5 <= self.input_width / self.input_height <= 2.5:
            raise ValueError(f"input_width must be about twice input_height: 360° by 180° (got {self.input_width} x "
                             f"{self.input_height})")  # fmt: skip
        for key, allowed in CHOICES.items():
            if getattr(self, key) not in allowed:
                raise ValueError(f"{key} must be one of {', '.join(allowed)} (got {getattr(self, key)!r})")
        for key in ("mean", "std"):
            values = getattr(self, key)
            if not isinstance(values, (list, tuple)) or len(values) != 3 or not all(map(_is_number, values)):
                raise ValueError(f"{key} must be three numbers (got {values!r})")
            object.__setattr__(self, key, tuple(float(value) for value in values))
        if min(self.std) <= 0:
            raise ValueError(f"std must be above 0 (got {self.std})")
        for key in ("input_scale", "output_scale", "min_range_m", "max_range_m"):
            value = getattr(self, key)
            if not _is_number(value) or value <= 0:
                raise ValueError(f"{key} must be a number above 0 (got {value!r})")
        if not _is_number(self.mask_threshold):
            raise ValueError(f"mask_threshold must be a number (got {self.mask_threshold!r})")
        if not _is_number(self.brightness) or not 0 <= self.brightness < 255:
            raise ValueError(f"brightness must be a number from 0 to under 255 (got {self.brightness!r})")
        if self.max_range_m <= self.min_range_m:
            raise ValueError(f"max_range_m must be above min_range_m (got {self.max_range_m}, {self.min_range_m})")
        if self.output_form != "depth" and self.output_kind not in ("metric", "scale_invariant"):
            raise ValueError(f"output_form {self.output_form} needs output_kind metric or scale_invariant "
                             f"(got {self.output_kind}): a shift must not be unknown")  # fmt: skip
        if self.output_form == "points" and self.geometry == "planar":
            raise ValueError("geometry must be radial with output_form points: their length is the distance")
        if bool(self.prior_input) != bool(self.sigma_output):
            raise ValueError("prior_input and sigma_output belong together: give both names, or neither")
        if self.prior_input and (self.mask_output or self.output_kind != "metric" or self.output_form != "depth"):
            raise ValueError("prior_input needs output_kind metric, output_form depth and no mask_output")
        if self.mask_output and self.mask_output == self.depth_output:
            raise ValueError(f"mask_output and depth_output are the same ({self.mask_output!r})")
        if self.sha256 and not re.fullmatch(r"[0-9a-f]{64}", self.sha256):
            raise ValueError(f"sha256 must be 64 digits of 0-9a-f (got {self.sha256!r})")


def _is_number(value: Any) -> bool:
    # A whole number of YAML may be more than a float can hold.
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


_TYPES = {key: hint if hint in READERS else float for key, hint in get_type_hints(ModelManifest).items()}
"""Type of each value, or of the entries of a list."""


def _typed(kind: type, value: Any) -> Any:
    """A spelled value by its type; what does not fit stays as YAML reads it, and the manifest refuses it."""
    if isinstance(value, list):
        return [_typed(kind, part) for part in value]
    with suppress(ValueError):
        return READERS[kind](value)
    return resolved(value)


def manifest_path(model: str | Path) -> Path:
    """The manifest of a model file: same name, suffix ``.yaml``."""
    return Path(model).with_suffix(".yaml")


def load_manifest(path: str | Path) -> ModelManifest:
    """Reads and checks a manifest.

    Raises:
        ManifestError: with the file, the line, the key and what it should be.
    """
    path = Path(path)
    if not path.is_file():
        raise ManifestError(f"{path}: no manifest; a depth model needs one beside it (docs/depth.md)")
    try:
        text = path.read_text(encoding="utf-8")
        root = compose_yaml(text)
        values = None if root is None else spelled(root)
    except (yaml.YAMLError, ValueError) as error:
        raise ManifestError(f"{path}: not YAML: {error}") from error
    except OSError as error:
        raise ManifestError(f"{path}: cannot be read: {error.strerror}") from error
    if not isinstance(root, yaml.MappingNode) or not isinstance(values, dict):
        raise ManifestError(f"{path}: must be keys and values (got {type(values).__name__})")
    lines: dict[str, int] = {}
    for key, _ in root.value:
        line = key.start_mark.line + 1
        if key.tag != "tag:yaml.org,2002:str":
            raise ManifestError(f"{path}:{line}: unknown key {key.value} (a key is a name)")
        if str(key.value) in lines:
            raise ManifestError(f"{path}:{line}: {key.value} stands here again (first in line {lines[key.value]})")
        lines[str(key.value)] = line
    known = [field.name for field in fields(ModelManifest)]
    for unknown in (key for key in lines if key not in known):
        raise ManifestError(f"{path}:{lines[unknown]}: unknown key {unknown} (known: {', '.join(known)})")
    if missing := [key for key in REQUIRED if key not in values]:
        raise ManifestError(f"{path}: missing key {', '.join(missing)}")
    try:
        return ModelManifest(**{key: _typed(_TYPES[key], value) for key, value in values.items()})
    except (ValueError, yaml.YAMLError) as error:
        line = lines.get(str(error).split()[0], 0)
        raise ManifestError(f"{path}:{line}: {error}" if line else f"{path}: {error}") from None


def save_manifest(manifest: ModelManifest, path: str | Path) -> None:
    """Writes a manifest that :func:`load_manifest` reads back equal."""
    values = asdict(manifest)
    values["mean"], values["std"] = list(manifest.mean), list(manifest.std)
    text = "# Interface of the depth model beside this file; the keys are explained in docs/depth.md.\n"
    text += yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None)
    Path(path).write_text(text, encoding="utf-8")
