"""Depth of a panorama by an ONNX model and its manifest (onnxruntime)."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.completion import PRIOR_CHANNELS
from instant_ic.depth.manifest import InferenceError, ManifestError, ModelManifest, load_manifest, manifest_path
from instant_ic.depth.providers import OpenSession, open_session
from instant_ic.geometry.projections import equirect_directions
from instant_ic.util.paths import shipped_file

DEFAULT_MODEL = "slicenet_small.onnx"
DEFAULT_COMPLETION = "completion.onnx"
MAX_GAIN = 2.5
"""An image's brightness is changed by this factor at most, up or down."""
INPUT_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class DepthModel:
    """A depth network ready to run.

    Attributes:
        manifest: its interface.
        provider: ``tensorrt``, ``cuda`` or ``cpu``: what runs it.
        notes: why a faster provider was not taken, a line each.

    Example:
        >>> model = DepthModel.load("models/slicenet_small.onnx")      # doctest: +SKIP
        >>> depth = model.estimate(panorama)   # (H, W, 3) uint8 RGB -> (256, 512) float32, metres  # doctest: +SKIP
    """

    def __init__(self, opened: OpenSession, manifest: ModelManifest, where: str | Path = "") -> None:
        self.manifest = manifest
        self.provider = opened.provider
        self.notes = opened.notes
        self._where = where or manifest.model
        self._session = opened.session
        self._input, self._dtype = self._check_input()
        self._outputs = self._check_outputs()
        self._run_options: Any = None
        self._radial: NDArray[np.float32] | None = None

    @classmethod
    def load(cls, path: str | Path, threads: int = 2, provider: str = "auto") -> DepthModel:
        """Opens a model by its ``.onnx`` or its manifest.

        Args:
            path: the model or the manifest beside it.
            threads: CPU threads of one inference. The result does not depend on the time of day or on load.
            provider: ``auto`` (the fastest that works), ``tensorrt``, ``cuda`` or ``cpu``. One that does not
                work falls back to the next; see :attr:`provider` and :attr:`notes`.

        Raises:
            ManifestError: manifest or model is missing or they do not fit each other.
            ValueError: no such provider, ``threads`` < 1.
        """
        manifest_file = manifest_path(path)
        manifest = load_manifest(manifest_file)
        model_file = manifest_file.parent / manifest.model
        if not model_file.is_file():
            raise ManifestError(f"{manifest_file}: model {model_file} does not exist")
        if manifest.sha256:
            with model_file.open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
            if found != manifest.sha256:
                raise ManifestError(f"{model_file}: SHA-256 differs from the manifest's: the file is damaged or "
                                    f"another (got {found})")  # fmt: skip
        try:
            opened = open_session(model_file, threads, provider)
        except ValueError:
            raise
        except Exception as error:  # onnxruntime's exceptions share no public base
            raise ManifestError(f"{model_file}: onnxruntime cannot load it: {error}") from error
        return cls(opened, manifest, model_file)

    @classmethod
    def find(cls, name: str, threads: int = 2, provider: str = "auto") -> DepthModel:
        """:meth:`load` of a file; a bare name is searched for in ``models/``.

        Raises:
            FileNotFoundError: there is no model of this name.
        """
        bare = Path(name).name == name
        return cls.load(shipped_file("models", name) if bare else name, threads, provider)

    @property
    def inputs(self) -> list[tuple[str, str, list[Any]]]:
        """Name, type and shape of the network's inputs."""
        return [(a.name, a.type, list(a.shape)) for a in self._session.get_inputs()]

    @property
    def outputs(self) -> list[tuple[str, str, list[Any]]]:
        """Name, type and shape of the network's outputs."""
        return [(a.name, a.type, list(a.shape)) for a in self._session.get_outputs()]

    def estimate(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth in the model's own unit (metres for metric models), radial, 0 = unknown.

        Args:
            rgb: equirect panorama of any size, (H, W, 3) uint8, twice as wide as high.

        Returns:
            (h, 2h) float32 with the rows of the network's output. Metric depth is cut to the manifest's range.
            Relative depth and disparity are shifted where they are not positive, since their shift is free.

        Raises:
            ValueError: not such an array.
            ManifestError: the outputs are not what the manifest says.
            InferenceError: the network failed, or :meth:`cancel` ended it.
        """
        if self.manifest.prior_input:
            raise ValueError(f"{self.manifest.name} corrects fused depth: use it as completion of depth_scaler")
        return self._finish(*self._run({self._input: self.prepare(rgb)}))

    def complete(
        self, rgb: NDArray[np.uint8], prior: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Dense depth and its relative standard deviation, (h, 2h) float32 each, from an image and incomplete depth.

        Args:
            rgb: as for :meth:`estimate`.
            prior: (6, h, 2h), see ``depth.completion.prior_channels``.

        Raises:
            ValueError: the model takes no prior, or another shape than this one's.
            ManifestError, InferenceError: as for :meth:`estimate`.
        """
        manifest = self.manifest
        size = (PRIOR_CHANNELS, manifest.input_height, manifest.input_width)
        if not manifest.prior_input:
            raise ValueError(f"{manifest.name} takes the image alone; a model of ic depth train is needed")
        if prior.shape != size:
            raise ValueError(f"the prior must be {size} (got {prior.shape})")
        feeds = {self._input: self.prepare(rgb), manifest.prior_input: prior[None].astype(np.float32)}
        depth, sigma = self._run(feeds)
        doubt = self._plane(sigma, manifest.sigma_output)
        doubt[~(doubt > 0)] = np.inf  # also where it is not a number
        return self._finish(depth), doubt

    def _run(self, feeds: dict[str, NDArray[Any]]) -> list[Any]:
        import onnxruntime

        self._run_options = options = onnxruntime.RunOptions()
        try:
            outputs: list[Any] = self._session.run(self._outputs, feeds, options)
        except Exception as error:  # onnxruntime's exceptions share no public base
            raise InferenceError(f"{self.manifest.name} on {self.provider}: {error}") from error
        finally:
            self._run_options = None
        return outputs

    def cancel(self) -> None:
        """Cancel an inference that runs in another thread, at its next layer."""
        if (options := self._run_options) is not None:
            options.terminate = True

    def prepare(self, rgb: NDArray[np.uint8]) -> NDArray[Any]:
        """The network's input, (1, 3, h, w) or (1, h, w, 3): resized by area averaging, then normalised.

        Raises:
            ValueError: ``rgb`` is not (H, W, 3) uint8, or no panorama.
        """
        manifest = self.manifest
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
            raise ValueError(f"rgb must be (H, W, 3) uint8 (got {rgb.shape} {rgb.dtype})")
        if not 1.9 <= rgb.shape[1] / rgb.shape[0] <= 2.1:
            raise ValueError(f"a panorama is twice as wide as high (got {rgb.shape[1]} x {rgb.shape[0]})")
        size = (manifest.input_width, manifest.input_height)
        if (rgb.shape[1], rgb.shape[0]) != size:
            shrinks = rgb.shape[1] >= size[0] and rgb.shape[0] >= size[1]
            rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))
        levels = np.arange(256, dtype=np.float32)
        if manifest.brightness:
            gain = np.clip(manifest.brightness / max(float(rgb.mean()), 1.0), 1 / MAX_GAIN, MAX_GAIN)
            levels = np.minimum(np.round(levels * gain), 255).astype(np.float32)  # saturates, as a camera does
        # A byte has 256 values, so all arithmetic goes into a table: (256, 1, 3), the channels in the network's order.
        mean, std = np.array(manifest.mean, np.float32), np.array(manifest.std, np.float32)
        table = (levels[:, None, None] * np.float32(manifest.input_scale) - mean) / std
        picture = rgb[..., ::-1] if manifest.channels == "bgr" else rgb
        values = cv2.LUT(
            np.ascontiguousarray(picture), table.astype(np.uint8 if self._dtype is np.uint8 else np.float32)
        )
        if manifest.input_layout == "nchw":
            values = np.stack(cv2.split(values))
        return np.ascontiguousarray(values[None], dtype=self._dtype)

    def _finish(self, output: Any, mask: Any = None) -> NDArray[np.float32]:
        """Network's outputs → depth as :meth:`estimate` gives it."""
        manifest = self.manifest
        depth = self._plane(output, self._outputs[0], points=manifest.output_form == "points")
        with np.errstate(divide="ignore", invalid="ignore"):
            if manifest.output_form == "inverse":
                depth = np.where(depth > 0, 1 / depth, 0)
            depth = (depth * np.float32(manifest.output_scale)).astype(np.float32)
        if mask is not None:
            above = (self._plane(mask, self._outputs[1]) > manifest.mask_threshold).astype(np.uint8)
            if above.shape != depth.shape:
                above = np.asarray(cv2.resize(above, depth.shape[::-1], interpolation=cv2.INTER_NEAREST))
            depth[(above == 1) == (manifest.mask_means == "invalid")] = np.nan
        rows, columns = depth.shape
        if columns != 2 * rows:  # the pixels of a panorama are square; no averages over depth edges
            depth = np.asarray(cv2.resize(depth, (2 * rows, rows), interpolation=cv2.INTER_NEAREST))
        if manifest.geometry == "planar":
            if self._radial is None or self._radial.shape != depth.shape:
                self._radial = 1.0 / np.abs(equirect_directions(2 * rows, rows)).max(axis=-1)
            depth *= self._radial
        known = np.isfinite(depth)
        if manifest.output_kind in ("relative", "disparity"):
            low, high = (depth[known].min(), depth[known].max()) if known.any() else (1.0, 1.0)
            if low <= 0:
                depth += max(float(high - low), 1e-6) * np.float32(1e-3) - low
        else:
            known &= depth > 0
            if manifest.output_kind == "metric":
                depth = np.clip(depth, manifest.min_range_m, manifest.max_range_m)
        depth[~known] = 0.0
        return depth

    def _plane(self, values: Any, name: str, points: bool = False) -> NDArray[np.float32]:
        """An output without its axes of one element, (h, w); the length of the vectors where it holds points."""
        array = np.asarray(values)
        found = array.shape
        array = array.reshape([length for length in found if length != 1]).astype(np.float32)
        if points and array.ndim == 3 and 3 in (array.shape[0], array.shape[-1]):
            array = np.linalg.norm(array, axis=0 if array.shape[0] == 3 else -1)
        if array.ndim != 2 or min(array.shape) < 8 or not 1.5 <= array.shape[1] / array.shape[0] <= 2.5:
            wanted = "3 coordinates a pixel" if points else "one number a pixel"
            names = ", ".join(a[0] for a in self.outputs)
            raise ManifestError(f"{self._where}: output {name!r} is {list(found)}; {wanted} of a panorama is needed "
                                f"(depth_output names one of {names}; see output_form)")  # fmt: skip
        return array

    def _check_input(self) -> tuple[str, type]:
        manifest, inputs = self.manifest, self.inputs
        names = ", ".join(a[0] for a in inputs)
        if manifest.prior_input:
            found = [shape for name, _, shape in inputs if name == manifest.prior_input]
            if not found or not _fits(found[0], [1, PRIOR_CHANNELS, manifest.input_height, manifest.input_width]):
                raise ManifestError(f"{self._where}: no input {manifest.prior_input!r} of {PRIOR_CHANNELS} channels in "
                                    f"the image's size (has: {names})")  # fmt: skip
            inputs = [one for one in inputs if one[0] != manifest.prior_input]
        if len(inputs) != 1:
            raise ManifestError(f"{self._where}: takes {len(self.inputs)} inputs ({names}); only the image, and with "
                                "prior_input incomplete depth, can be given")  # fmt: skip
        name, kind, shape = inputs[0]
        if kind not in INPUT_TYPES:
            raise ManifestError(f"{self._where}: input {name!r} is {kind}; one of {', '.join(INPUT_TYPES)} is needed")
        dtype = INPUT_TYPES[kind]
        if dtype is np.uint8 and (manifest.input_scale, manifest.mean, manifest.std) != (1.0, (0.0,) * 3, (1.0,) * 3):
            raise ManifestError(f"{self._where}: input {name!r} takes bytes: the manifest must say input_scale 1, mean "
                                "0, std 1")  # fmt: skip
        size = [manifest.input_height, manifest.input_width]
        layouts = {"nchw": [1, 3, *size], "nhwc": [1, *size, 3]}
        if not _fits(shape, expected := layouts[manifest.input_layout]):
            hint = next((f"; its input_layout is {other}" for other, s in layouts.items() if _fits(shape, s)), "")
            raise ManifestError(f"{self._where}: takes an input of shape {shape}, the manifest says {expected}{hint}")
        return name, dtype

    def _check_outputs(self) -> list[str]:
        manifest = self.manifest
        names = [name for name, _, _ in self.outputs]
        for key in ("depth_output", "mask_output", "sigma_output"):
            name, purpose = getattr(manifest, key), key.split("_")[0]
            if name and name not in names:
                raise ManifestError(f"{self._where}: no output {name!r} for the {purpose} (has: {', '.join(names)})")
        depth = manifest.depth_output or next(
            (name for name in names if name not in (manifest.mask_output, manifest.sigma_output)), ""
        )
        if not depth:
            raise ManifestError(f"{self._where}: no output besides the mask")
        chosen = [depth, *(name for name in (manifest.mask_output, manifest.sigma_output) if name)]
        for name, _, shape in self.outputs:
            if name in chosen and all(isinstance(length, int) and length > 0 for length in shape):
                self._plane(
                    np.broadcast_to(np.float32(0), shape), name, name == depth and manifest.output_form == "points"
                )
        return chosen


def _fits(shape: list[Any], expected: list[int]) -> bool:
    """Whether a network's input shape, with text or None for what is open, takes ``expected``."""
    return len(shape) == 4 and all(not isinstance(a, int) or a == b for a, b in zip(shape, expected, strict=True))
