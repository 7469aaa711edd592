"""Depth of a panorama by an ONNX model and its manifest (onnxruntime)."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions

from .manifest import ManifestError, ModelManifest, load_manifest, manifest_path

DEFAULT_MODEL = "slicenet_small.onnx"
MAX_GAIN = 2.5
"""A picture's brightness is changed by this factor at most, up or down."""


class DepthModel:
    """A depth network ready to run.

    Example:
        >>> model = DepthModel.load("models/slicenet_small.onnx")      # doctest: +SKIP
        >>> depth = model.estimate(panorama)   # (H, W, 3) uint8 RGB -> (256, 512) float32, metres  # doctest: +SKIP
    """

    def __init__(self, session: Any, manifest: ModelManifest) -> None:
        self.manifest = manifest
        self._session = session
        self._input = session.get_inputs()[0].name
        outputs = [output.name for output in session.get_outputs()]
        if manifest.mask_output and manifest.mask_output not in outputs:
            raise ManifestError(
                f"{manifest.model}: no output {manifest.mask_output!r} for the mask (has: {', '.join(outputs)})"
            )
        depth_outputs = [name for name in outputs if name != manifest.mask_output]
        if not depth_outputs:
            raise ManifestError(f"{manifest.model}: no output besides the mask")
        self._outputs = depth_outputs[:1] + ([manifest.mask_output] if manifest.mask_output else [])
        shape = session.get_inputs()[0].shape
        expected = [1, 3, manifest.input_height, manifest.input_width]
        if len(shape) != 4 or any(isinstance(a, int) and a != b for a, b in zip(shape, expected, strict=True)):
            raise ManifestError(f"{manifest.model}: takes an input of shape {shape}, the manifest says {expected}")
        self._radial_factor: NDArray[np.float32] | None = None
        if manifest.geometry == "planar":
            directions = np.abs(equirect_directions(manifest.input_width, manifest.input_height))
            self._radial_factor = 1.0 / directions.max(axis=-1)

    @classmethod
    def load(cls, path: str | Path, threads: int = 2, providers: list[str] | None = None) -> DepthModel:
        """Opens a model by its ``.onnx`` or its manifest.

        Args:
            path: the model or the manifest beside it.
            threads: CPU threads of one inference. The result does not depend on the time of day or on load.
            providers: onnxruntime execution providers; by default CUDA where it is available, then the CPU.

        Raises:
            ManifestError: manifest or model is missing or they do not fit each other.
        """
        import onnxruntime

        manifest_file = manifest_path(path)
        manifest = load_manifest(manifest_file)
        model_file = manifest_file.parent / manifest.model
        if not model_file.is_file():
            raise ManifestError(f"{manifest_file}: model {model_file} does not exist")
        if threads < 1:
            raise ValueError(f"threads must be 1 or more (got {threads})")
        content = model_file.read_bytes()
        if manifest.sha256 and hashlib.sha256(content).hexdigest() != manifest.sha256:
            raise ManifestError(f"{model_file}: SHA-256 differs from the manifest's; the file is damaged or another")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        # Idle workers sleep: the rest of the stack runs on the same cores.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        available = onnxruntime.get_available_providers()
        chosen = providers or [p for p in ("CUDAExecutionProvider", "CPUExecutionProvider") if p in available]
        try:
            session = onnxruntime.InferenceSession(content, options, providers=chosen)
        except Exception as error:  # onnxruntime's exceptions share no public base
            raise ManifestError(f"{model_file}: onnxruntime cannot load it: {error}") from error
        return cls(session, manifest)

    @property
    def provider(self) -> str:
        """The execution provider that runs it: ``CPUExecutionProvider`` or ``CUDAExecutionProvider``."""
        return str(self._session.get_providers()[0])

    def estimate(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Depth in the model's own unit (metres for metric models), radial, 0 = unknown.

        Args:
            rgb: equirect panorama of any size, (H, W, 3) uint8.

        Returns:
            (input_height, input_width) float32. Metric and scale-invariant depth is cut to the manifest's range.

        Raises:
            ValueError: not such an array.
        """
        manifest = self.manifest
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise ValueError(f"rgb must be (H, W, 3) uint8 (got {rgb.shape} {rgb.dtype})")
        feeds = {self._input: self.prepare(rgb)}
        outputs = self._session.run(self._outputs, feeds)
        size = (manifest.input_height, manifest.input_width)
        depth = np.asarray(outputs[0], np.float32).reshape(size) * np.float32(manifest.output_scale)
        if self._radial_factor is not None:
            depth *= self._radial_factor
        unknown = ~np.isfinite(depth)
        if manifest.output_kind in ("metric", "scale_invariant"):
            depth = np.clip(depth, manifest.min_range_m, manifest.max_range_m)
        if manifest.mask_output:
            unknown |= np.asarray(outputs[1]).reshape(size) <= 0.5
        depth[unknown] = 0.0
        return depth

    def prepare(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The network's input, (1, 3, h, w) float32: resized by area averaging, then normalised."""
        manifest = self.manifest
        size = (manifest.input_width, manifest.input_height)
        if (rgb.shape[1], rgb.shape[0]) != size:
            shrinks = rgb.shape[1] >= size[0] and rgb.shape[0] >= size[1]
            rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))
        if manifest.brightness:
            gain = np.clip(manifest.brightness / max(float(rgb.mean()), 1.0), 1 / MAX_GAIN, MAX_GAIN)
            rgb = cv2.convertScaleAbs(
                np.ascontiguousarray(rgb), alpha=float(gain)
            )  # saturates at 255, as a camera does
        picture = rgb[..., ::-1] if manifest.channels == "bgr" else rgb
        mean, std = np.array(manifest.mean, np.float32), np.array(manifest.std, np.float32)
        values = (picture.astype(np.float32) * np.float32(manifest.input_scale) - mean) / std
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None])
