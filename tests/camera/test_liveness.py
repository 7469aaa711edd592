"""Images that do not show the present: copies of earlier ones, and images of one colour."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_theta import jpeg

from instant_ic.bus import ERROR, OK
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.camera.config import ThetaCameraConfig
from instant_ic.camera.liveness import LiveImages
from instant_ic.camera.source import Camera, Frame
from instant_ic.sim.theta import JPEG_QUALITY, NOISE
from nodes.theta_camera import ThetaCameraNode

START = 1_700_000_000_000_000_000


def frame(data: bytes, width: int = 64, height: int = 32) -> Frame:
    return Frame(data, 0, width, height)


def encoded(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


@pytest.mark.parametrize("count", [8, 120])
def test_fault_a_camera_that_repeats_its_last_image_or_a_ring_of_images_is_live(count: int) -> None:
    """A ring of more than eight images was taken for a live camera."""
    images = LiveImages()
    ring = [frame(jpeg(value)) for value in range(count)]
    assert all(images.is_live(one) for one in ring)
    assert not any(images.is_live(ring[-1]) for _ in range(20))
    assert not any(images.is_live(one) for one in ring * 2)
    assert "repeats the same image" in images.fault and images.withheld == 20 + 2 * count
    assert images.is_live(frame(jpeg(count))) and not images.fault


@pytest.mark.parametrize("colour", [(0, 0, 0), (0, 135, 0)])
def test_black_green_and_uniform_images_are_not_live_even_with_noise(colour: tuple[int, int, int]) -> None:
    images, rng = LiveImages(), np.random.default_rng(0)
    for _ in range(2):
        noise = rng.normal(0.0, NOISE, (512, 1024, 3))
        image = np.clip(np.array(colour) + noise, 0, 255).astype(np.uint8)
        assert not images.is_live(frame(encoded(image), 1024, 512))
        assert "of one colour" in images.fault


def test_a_dim_place_is_live() -> None:
    rng, images = np.random.default_rng(1), LiveImages()
    ramp = np.broadcast_to(np.linspace(5, 25, 1024)[None, :, None], (512, 1024, 3))
    for _ in range(2):
        image = (ramp + rng.normal(0.0, NOISE, (512, 1024, 3))).astype(np.uint8)
        assert images.is_live(frame(encoded(image), 1024, 512))


class _Device(Camera):
    """A device whose images the test hands over."""

    def connect(self) -> str:
        return "device"

    def read(self) -> Frame:
        raise AssertionError("the test hands the images over")

    def close(self) -> None:
        pass


def test_the_node_withholds_them_and_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(1))
    bus = LockstepBus(start_ns=START)
    node = bus.add(ThetaCameraNode, ThetaCameraConfig(source="files", url=str(tmp_path)))
    node.camera = _Device(0.0)
    shown = len(bus.messages("/camera/image/compressed"))
    for _ in range(10):
        node.on_frame(frame(jpeg(2)))
    assert len(bus.messages("/camera/image/compressed")) == shown + 1
    node.check()
    level, text, values = node.diagnoses()["images"]
    assert level == ERROR and text.startswith("the camera repeats the same image: restart") and values["withheld"] == 9
    node.on_frame(frame(jpeg(3)))
    node.check()
    assert node.diagnoses()["images"][0] == OK
    assert len(bus.messages("/camera/image/compressed")) == shown + 2
