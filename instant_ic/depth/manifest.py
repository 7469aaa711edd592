"""What a depth model file expects and gives: the YAML manifest that stands beside the ONNX file."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

OUTPUT_KINDS = ("metric", "scale_invariant", "relative", "disparity")
"""``metric``: metres. ``scale_invariant``: metres up to one factor. ``relative``: metres up to factor and shift.
``disparity``: inverse metres up to factor and shift."""


class ManifestError(ValueError):
    """The manifest of a depth model is missing, malformed or does not fit its model."""


@dataclass(frozen=True)
class ModelManifest:
    """Interface of a depth model.

    Attributes:
        model: file name of the ONNX model, beside the manifest.
        name: shown to people.
        licence: of the weights.
        input_height: rows the network takes.
        input_width: columns the network takes.
        channels: ``rgb`` or ``bgr``: order of the channels that the network takes.
        brightness: mean byte of the pictures that the model was trained on; a picture is brought to it by one
            factor, within 1/2.5 .. 2.5 (a real camera's exposure is not that of the training). 0 leaves it as it is.
        input_scale: the bytes are multiplied by it first.
        mean: then this is subtracted, a value a channel in the network's order.
        std: then divided by this.
        output_kind: one of :data:`OUTPUT_KINDS`.
        output_scale: the output is multiplied by it (100 for a network that gives 0..1 for 0..100 m).
        min_range_m: metric and scale-invariant depth below it is raised to it.
        max_range_m: metric and scale-invariant depth above it is cut to it.
        geometry: ``radial`` (distance from the camera) or ``planar`` (along the axis of the cube face that the
            pixel lies on); planar output is turned into radial.
        mask_output: name of an output that is > 0.5 where depth is valid; empty for none.
        sha256: of the model file; empty to leave it unchecked.
    """

    model: str
    name: str
    licence: str
    input_height: int
    input_width: int
    channels: str = "rgb"
    brightness: float = 0.0
    input_scale: float = 1.0 / 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    output_kind: str = "metric"
    output_scale: float = 1.0
    min_range_m: float = 0.1
    max_range_m: float = 16.0
    geometry: str = "radial"
    mask_output: str = ""
    sha256: str = ""

    def __post_init__(self) -> None:
        for key in ("model", "name", "licence", "channels", "output_kind", "geometry", "mask_output", "sha256"):
            if not isinstance(getattr(self, key), str):
                raise ValueError(f"{key} must be text (got {getattr(self, key)!r})")
        for key in ("input_height", "input_width"):
            value = getattr(self, key)
            if not isinstance(value, int) or isinstance(value, bool) or value < 16:
                raise ValueError(f"{key} must be a whole number of 16 or more (got {value!r})")
        if self.input_width != 2 * self.input_height:
            raise ValueError(
                f"input_width must be twice input_height, an equirect picture "
                f"(got {self.input_width} x {self.input_height})"
            )
        if self.channels not in ("rgb", "bgr"):
            raise ValueError(f"channels must be rgb or bgr (got {self.channels!r})")
        if self.output_kind not in OUTPUT_KINDS:
            raise ValueError(f"output_kind must be one of {', '.join(OUTPUT_KINDS)} (got {self.output_kind!r})")
        if self.geometry not in ("radial", "planar"):
            raise ValueError(f"geometry must be radial or planar (got {self.geometry!r})")
        if self.geometry == "planar" and self.output_kind == "disparity":
            raise ValueError("geometry must be radial where output_kind is disparity")
        for key in ("mean", "std"):
            values = getattr(self, key)
            if not isinstance(values, (tuple, list)) or len(values) != 3 or not all(map(_is_number, values)):
                raise ValueError(f"{key} must be three numbers (got {values!r})")
            object.__setattr__(self, key, tuple(float(value) for value in values))
        if min(self.std) <= 0:
            raise ValueError(f"std must be above 0 (got {self.std})")
        for key in ("input_scale", "output_scale", "min_range_m", "max_range_m"):
            value = getattr(self, key)
            if not _is_number(value) or value <= 0:
                raise ValueError(f"{key} must be a number above 0 (got {value!r})")
        if not _is_number(self.brightness) or not 0 <= self.brightness < 255:
            raise ValueError(f"brightness must be a number from 0 to under 255 (got {self.brightness!r})")
        if self.max_range_m <= self.min_range_m:
            raise ValueError(f"max_range_m must be above min_range_m (got {self.max_range_m}, {self.min_range_m})")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def manifest_path(model: str | Path) -> Path:
    """The manifest of a model file: same name, suffix ``.yaml``."""
    return Path(model).with_suffix(".yaml")


def load_manifest(path: str | Path) -> ModelManifest:
    """Reads and checks a manifest.

    Raises:
        ManifestError: with the file, the key and what it should be.
    """
    path = Path(path)
    if not path.is_file():
        raise ManifestError(f"{path}: no manifest; a depth model needs one beside it (docs/depth.md)")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ManifestError(f"{path}: not YAML: {error}") from error
    if not isinstance(values, dict):
        raise ManifestError(f"{path}: must be keys and values (got {type(values).__name__})")
    known = {field.name: field for field in fields(ModelManifest)}
    if unknown := sorted(str(key) for key in values if key not in known):
        raise ManifestError(f"{path}: unknown key {', '.join(unknown)} (known: {', '.join(known)})")
    required = ("model", "name", "licence", "input_height", "input_width")
    if missing := [key for key in required if key not in values]:
        raise ManifestError(f"{path}: missing key {', '.join(missing)}")
    try:
        return ModelManifest(**values)
    except ValueError as error:
        raise ManifestError(f"{path}: {error}") from None


def save_manifest(manifest: ModelManifest, path: str | Path) -> None:
    """Writes a manifest that :func:`load_manifest` reads back equal."""
    values = asdict(manifest)
    values["mean"], values["std"] = list(manifest.mean), list(manifest.std)
    text = "# Interface of the depth model beside this file; the keys are explained in docs/depth.md.\n"
    Path(path).write_text(text + yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
