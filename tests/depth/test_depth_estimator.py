"""The depth_estimator node: what it says of its model, and what it does when an inference fails or hangs."""

import logging
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_onnx

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.depth.manifest import InferenceError, ModelManifest, save_manifest
from instant_ic.msg import compressed_image_message, image_array
from instant_ic.util.limits import decode_rgb
from nodes.depth_estimator import DepthEstimatorConfig, DepthEstimatorNode

S = 1_000_000_000
START = 1_700_000_000 * S
TOPIC = "/camera/image/compressed"


@pytest.fixture
def config(tmp_path: Path) -> DepthEstimatorConfig:
    """A model whose depth is ten times the red channel."""
    path = tmp_path / "tiny.onnx"
    nodes = tiny_onnx.channel("image", 0, "depth")
    tiny_onnx.write(path, {"image": (1, 3, 64, 128)}, {"depth": (1, 1, 64, 128)}, nodes, tiny_onnx.CHANNELS)
    manifest = ModelManifest("tiny.onnx", "tiny", "MIT", 64, 128, output_kind="scale_invariant")
    save_manifest(manifest, path.with_suffix(".yaml"))
    return DepthEstimatorConfig(model=str(path), timeout_s=5.0)


def picture(suffix: str = ".jpg", height: int = 64) -> bytes:
    bgr = np.zeros((height, 2 * height, 3), np.uint8)
    bgr[..., 2] = 128
    return cv2.imencode(suffix, bgr)[1].tobytes()


class Failing:
    """Stands for a model on a GPU that fails at every picture."""

    provider = "cuda"
    cancelled = 0

    def __init__(self, manifest: ModelManifest) -> None:
        self.manifest = manifest

    def estimate(self, rgb: np.ndarray) -> np.ndarray:
        raise InferenceError("tiny on cuda: out of memory")

    def cancel(self) -> None:
        self.cancelled += 1


def test_tells_what_its_numbers_are(config: DepthEstimatorConfig) -> None:
    with LockstepBus(START) as bus:
        bus.add(DepthEstimatorNode, config)
        (info,) = bus.messages("/depth/model")
        bus.publish(TOPIC, compressed_image_message(picture(), "camera", START), stamp_ns=START)
        (depth,) = bus.messages("/depth/raw")
    assert (info.name, info.licence, info.output_kind, info.provider) == ("tiny", "MIT", "scale_invariant", "cpu")
    np.testing.assert_allclose(image_array(depth), 128 / 255, rtol=0.02)


def test_failing_gpu_is_left_for_the_cpu(config: DepthEstimatorConfig) -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthEstimatorNode, config)
        node.inference.model, node.published_provider = Failing(node.inference.model.manifest), "cuda"
        bus.publish(TOPIC, compressed_image_message(picture(), "camera", START), stamp_ns=START)
        level, message, values = node.diagnoses()["depth"]
        assert (level, values["failures"]) == (2, 1)
        assert message == "tiny on cuda: out of memory; the CPU is used from now on"
        bus.publish(TOPIC, compressed_image_message(picture(), "camera", START + S), stamp_ns=START + S)
        assert len(bus.messages("/depth/raw")) == 1
        assert [info.provider for info in bus.messages("/depth/model")] == ["cpu", "cpu"]
        assert node.diagnoses()["depth"][0] == 0


def test_failing_cpu_is_told_and_the_next_picture_tried(config: DepthEstimatorConfig) -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthEstimatorNode, config)
        working, failing = node.inference.model, Failing(node.inference.model.manifest)
        failing.provider = "cpu"
        node.inference.model = failing
        bus.publish(TOPIC, compressed_image_message(picture(), "camera", START), stamp_ns=START)
        assert node.diagnoses()["depth"][:2] == (2, "tiny on cuda: out of memory")
        node.inference.model = working
        bus.publish(TOPIC, compressed_image_message(picture(), "camera", START + S), stamp_ns=START + S)
        assert node.diagnoses()["depth"][0] == 0 and len(bus.messages("/depth/raw")) == 1


class Hanging(Failing):
    """An inference that ends by its cancellation, or by nothing until ``go_on``."""

    provider = "cpu"

    def __init__(self, manifest: ModelManifest, obeys: bool) -> None:
        super().__init__(manifest)
        self.go_on, self.obeys = threading.Event(), obeys

    def estimate(self, rgb: np.ndarray) -> np.ndarray:
        assert self.go_on.wait(60)
        raise InferenceError("tiny on cpu: terminated")

    def cancel(self) -> None:
        super().cancel()
        if self.obeys:
            self.go_on.set()


def test_a_slow_inference_is_cancelled_and_reported(config: DepthEstimatorConfig) -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthEstimatorNode, replace(config, timeout_s=0.05))
        node.inference.model = hanging = Hanging(node.inference.model.manifest, obeys=True)
        bus.publish(TOPIC, compressed_image_message(picture(), "camera", START), stamp_ns=START)
        assert node.diagnoses()["depth"][:2] == (2, "the inference took longer than 0.05 s on cpu and was cancelled")
        assert hanging.cancelled == 1 and not node.stopping


def test_a_hanging_inference_ends_the_process(
    config: DepthEstimatorConfig, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("instant_ic.depth.inference._GIVE_UP_S", 0.05)
    with LockstepBus(START) as bus:
        node = bus.add(DepthEstimatorNode, replace(config, timeout_s=0.05))
        node.inference.model = hanging = Hanging(node.inference.model.manifest, obeys=False)
        with caplog.at_level(logging.ERROR):
            bus.publish(TOPIC, compressed_image_message(picture(), "camera", START), stamp_ns=START)
        assert node.stopping and hanging.cancelled > 1 and "hangs; the node ends so that it is restarted" in caplog.text
        hanging.go_on.set()


@pytest.mark.parametrize(("need", "rows"), [(512, 512), (200, 256), (16, 64)])
def test_decoding_to_what_is_needed(need: int, rows: int) -> None:
    rgb = decode_rgb(picture(height=512), 2 * need, need)
    assert rgb.shape == (rows, 2 * rows, 3)
    np.testing.assert_allclose(rgb[0, 0], (128, 0, 0), atol=3)
