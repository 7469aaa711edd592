"""Depth of a panorama from an ONNX model and its manifest (onnxruntime)."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.completion import PRIOR_CHANNELS
from instant_ic.depth.manifest import InferenceError, ManifestError, ModelManifest, load_manifest, manifest_path
from instant_ic.depth.providers import open_session, provider_of
from instant_ic.util.paths import shipped_file

DEFAULT_MODEL = "slicenet_small.onnx"
DEFAULT_COMPLETION = "completion.onnx"
MAX_GAIN = 2.5
"""Largest factor by which an image's brightness is raised or lowered."""


class DepthModel:
    """A depth network ready to run.

    Attributes:
        manifest: interface of the model.
        provider: execution provider in use, ``tensorrt``, ``cuda`` or ``cpu``.

    Example:
        >>> model = DepthModel.load("models/slicenet_small.onnx")      # doctest: +SKIP
        >>> depth = model.estimate(panorama)   # (H, W, 3) uint8 RGB -> (256, 512) float32, metres  # doctest: +SKIP
    """

    def __init__(self, session: Any, manifest: ModelManifest, where: str | Path = "") -> None:
        self.manifest = manifest
        self.provider = provider_of(session)
        self._where = where or manifest.model
        self._session = session
        self._input = self._check_input()
        self._outputs = self._check_outputs()
        self._run_options: Any = None

    @classmethod
    def load(cls, path: str | Path, threads: int = 2, provider: str = "auto") -> DepthModel:
        """Open a model from its ``.onnx`` file or its manifest.

        Args:
            path: the model file or the manifest beside it.
            threads: CPU threads of one inference. The result does not depend on the machine's load.
            provider: ``auto`` (the fastest that works), ``tensorrt``, ``cuda`` or ``cpu``. If it does not work, the
                next one is used; see :attr:`provider`.

        Raises:
            ManifestError: manifest or model is missing, or they do not match.
            ValueError: the provider is unknown, or ``threads`` < 1.
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
                raise ManifestError(f"{model_file}: SHA-256 differs from the manifest's; the file is damaged or "
                                    f"another model (got {found})")  # fmt: skip
        try:
            session = open_session(model_file, threads, provider)
        except ValueError:
            raise
        except Exception as error:  # onnxruntime's exceptions share no public base
            raise ManifestError(f"{model_file}: onnxruntime cannot load it: {error}") from error
        return cls(session, manifest, model_file)

    @classmethod
    def find(cls, name: str, threads: int = 2, provider: str = "auto") -> DepthModel:
        """Open a model; a bare name is searched for in ``models/``.

        Args:
            name: path or bare name of the model.
            threads: as for :meth:`load`.
            provider: as for :meth:`load`.

        Raises:
            FileNotFoundError: no model has this name.
        """
        bare = Path(name).name == name
        return cls.load(shipped_file("models", name) if bare else name, threads, provider)

    @property
    def inputs(self) -> list[tuple[str, str, list[Any]]]:
        """Names, types and shapes of the network's inputs."""
        return [(a.name, a.type, list(a.shape)) for a in self._session.get_inputs()]

    @property
    def outputs(self) -> list[tuple[str, str, list[Any]]]:
        """Names, types and shapes of the network's outputs."""
        return [(a.name, a.type, list(a.shape)) for a in self._session.get_outputs()]

    def estimate(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Estimate radial depth in the model's unit (metres for metric models); 0 is unknown.

        Args:
            rgb: equirect panorama of any size, (H, W, 3) uint8, twice as wide as high.

        Returns:
            Depth in the size of the network's output, (h, 2h) float32. Metric depth is clipped to the manifest's range.

        Raises:
            ValueError: ``rgb`` has another shape or type, or the model is a completion model.
            ManifestError: the outputs differ from the manifest.
            InferenceError: the network failed, or :meth:`cancel` ended it.
        """
        if self.manifest.prior_input:
            raise ValueError(f"{self.manifest.name} corrects fused depth; use it as completion of depth_scaler")
        (depth,) = self._run({self._input: self.prepare(rgb)})
        return self._finish(depth)

    def complete(
        self, rgb: NDArray[np.uint8], prior: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Estimate dense depth from an image and incomplete depth.

        Args:
            rgb: as for :meth:`estimate`.
            prior: channels of ``depth.completion.prior_channels``, (6, h, 2h).

        Returns:
            Depth in metres and its relative standard deviation, (h, 2h) float32 each.

        Raises:
            ValueError: the model takes no prior, or the prior has another shape.
            ManifestError, InferenceError: as for :meth:`estimate`.
        """
        manifest = self.manifest
        size = (PRIOR_CHANNELS, manifest.input_height, manifest.input_width)
        if not manifest.prior_input:
            raise ValueError(f"{manifest.name} uses only the image; a model of ic depth train is needed")
        if prior.shape != size:
            raise ValueError(f"the prior must be {size} (got {prior.shape})")
        feeds = {self._input: self.prepare(rgb), manifest.prior_input: prior[None].astype(np.float32)}
        depth, sigma = self._run(feeds)
        doubt = self._plane(sigma, manifest.sigma_output)
        doubt[~(doubt > 0)] = np.inf  # includes NaN
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
        """Cancel an inference that runs in another thread. It ends at its next layer."""
        if (options := self._run_options) is not None:
            options.terminate = True

    def prepare(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the network's input, (1, 3, h, 2h): resized by area averaging, then normalised.

        Raises:
            ValueError: ``rgb`` is not (H, W, 3) uint8, or not a panorama.
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
            levels = np.minimum(np.round(levels * gain), 255).astype(np.float32)  # saturates like a camera
        # A byte has 256 values, so the normalisation is a table, (256, 1, 3).
        mean, std = np.array(manifest.mean, np.float32), np.array(manifest.std, np.float32)
        table = ((levels[:, None, None] * np.float32(1 / 255) - mean) / std).astype(np.float32)
        values = cv2.LUT(np.ascontiguousarray(rgb), table)
        return np.ascontiguousarray(np.stack(cv2.split(values))[None])

    def _finish(self, output: Any) -> NDArray[np.float32]:
        """Convert the network's depth output to depth as :meth:`estimate` returns it."""
        manifest = self.manifest
        depth = self._plane(output, self._outputs[0])
        known = np.isfinite(depth) & (depth > 0)
        if manifest.output_kind == "metric":
            depth = np.clip(depth, manifest.min_range_m, manifest.max_range_m)
        depth[~known] = 0.0
        return depth

    def _plane(self, values: Any, name: str) -> NDArray[np.float32]:
        """Return an output without its axes of length 1, (h, 2h)."""
        array = np.asarray(values)
        found = array.shape
        array = array.reshape([length for length in found if length != 1]).astype(np.float32)
        if array.ndim != 2 or array.shape[0] < 8 or array.shape[1] != 2 * array.shape[0]:
            raise ManifestError(f"{self._where}: output {name!r} is {list(found)}; a panorama of (h, 2 h) is needed")
        return array

    def _check_input(self) -> str:
        """Check the network's inputs, and return the name of the image input."""
        manifest, inputs = self.manifest, self.inputs
        size = [manifest.input_height, manifest.input_width]
        names = ", ".join(name for name, _, _ in inputs)
        if manifest.prior_input:
            found = [shape for name, _, shape in inputs if name == manifest.prior_input]
            if not found or not _fits(found[0], [1, PRIOR_CHANNELS, *size]):
                raise ManifestError(f"{self._where}: no input {manifest.prior_input!r} of {PRIOR_CHANNELS} channels in "
                                    f"the image's size (has: {names})")  # fmt: skip
            inputs = [one for one in inputs if one[0] != manifest.prior_input]
        if len(inputs) != 1:
            raise ManifestError(f"{self._where}: takes {len(self.inputs)} inputs ({names}); allowed are the image and, "
                                "with prior_input, incomplete depth")  # fmt: skip
        name, kind, shape = inputs[0]
        if kind != "tensor(float)" or not _fits(shape, [1, 3, *size]):
            raise ManifestError(f"{self._where}: input {name!r} is {kind} {shape}; the manifest says tensor(float) "
                                f"{[1, 3, *size]}")  # fmt: skip
        return name

    def _check_outputs(self) -> list[str]:
        """Check the network's outputs, and return the names of the depth and standard deviation outputs."""
        sigma, names = self.manifest.sigma_output, [name for name, _, _ in self.outputs]
        if sigma and sigma not in names:
            raise ManifestError(f"{self._where}: no output {sigma!r} for the sigma (has: {', '.join(names)})")
        depth = next((name for name in names if name != sigma), "")
        if not depth:
            raise ManifestError(f"{self._where}: no output besides the sigma")
        chosen = [depth, sigma] if sigma else [depth]
        for name, _, shape in self.outputs:
            if name in chosen and all(isinstance(length, int) and length > 0 for length in shape):
                self._plane(np.broadcast_to(np.float32(0), shape), name)
        return chosen


def _fits(shape: list[Any], expected: list[int]) -> bool:
    """Return whether a network's input shape, with text or None for free sizes, accepts ``expected``."""
    return len(shape) == 4 and all(not isinstance(a, int) or a == b for a, b in zip(shape, expected, strict=True))
