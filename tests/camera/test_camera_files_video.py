"""Pictures from files and from a video."""

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_theta import jpeg

from instant_ic.camera.config import VideoConfig
from instant_ic.camera.files import FileCamera
from instant_ic.camera.loop import CameraLoop
from instant_ic.camera.source import CameraError
from instant_ic.camera.video import VideoCamera


def test_folder_in_the_order_of_names_with_jpegs_byte_for_byte(tmp_path: Path) -> None:
    (tmp_path / "b.jpg").write_bytes(jpeg(80))
    (tmp_path / "a.JPG").write_bytes(jpeg(40))
    cv2.imwrite(str(tmp_path / "c.png"), np.full((16, 32, 3), 200, np.uint8))
    (tmp_path / "notes.txt").write_text("no picture")
    with FileCamera(tmp_path, now_ns=lambda: 7) as camera:
        frames = [camera.read() for _ in range(4)]
    assert [frame.jpeg for frame in frames[:2]] == [jpeg(40), jpeg(80)]
    assert (frames[2].width, frames[2].height) == (32, 16)
    assert abs(int(cv2.imdecode(np.frombuffer(frames[2].jpeg, np.uint8), 1).mean()) - 200) <= 2
    assert frames[3].jpeg == jpeg(40)  # from the start again
    assert {frame.stamp_ns for frame in frames} == {7}


def test_missing_empty_and_broken_files_are_told(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="no image"):
        FileCamera(tmp_path).connect()
    with pytest.raises(CameraError, match="nowhere"):
        FileCamera(tmp_path / "nowhere.jpg").connect()
    (tmp_path / "cut.jpg").write_bytes(jpeg(40)[:-50])
    with pytest.raises(CameraError, match=r"cut.jpg: .*EOI"):
        FileCamera(tmp_path / "cut.jpg").connect()
    (tmp_path / "text.png").write_text("hello")
    with pytest.raises(CameraError, match="cannot be decoded as an image"):
        FileCamera(tmp_path / "text.png").connect()


def test_video_frames_come_encoded_and_stamped(tmp_path: Path) -> None:
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 32))
    for value in (50, 100, 150):
        writer.write(np.full((32, 64, 3), value, np.uint8))
    writer.release()
    with VideoCamera(str(path), VideoConfig(latency_s=0.25), now_ns=lambda: 10**9) as camera:
        frames = [camera.read() for _ in range(3)]
        with pytest.raises(CameraError, match="no more frames"):
            camera.read()
    assert [(frame.width, frame.height, frame.stamp_ns) for frame in frames] == [(64, 32, 750_000_000)] * 3
    assert camera.recorded and not VideoCamera("/dev/null").recorded and not VideoCamera("rtsp://host/live").recorded
    means = [cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), 1).mean() for frame in frames]
    np.testing.assert_allclose(means, [50, 100, 150], atol=4)


class FakeCapture:
    """A device that opens, sends some images, and then blocks as a driver does: until the test lets it go."""

    def __init__(self, images: int, released: threading.Event) -> None:
        self.images = images
        self.let_go = released
        self.closed = threading.Event()

    def isOpened(self) -> bool:
        return True

    def set(self, *_: float) -> bool:
        return True

    def get(self, _: int) -> float:
        return 32.0

    def getBackendName(self) -> str:
        return "V4L2"

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.images -= 1
        if self.images >= 0:
            return True, np.full((16, 32, 3), 10 * self.images, np.uint8)
        self.let_go.wait()
        return False, None

    def release(self) -> None:
        self.closed.set()


@dataclass
class Device:
    """Opens fake captures, each of which sends some images and then blocks."""

    images: int
    let_go: threading.Event = field(default_factory=threading.Event)
    opened: list[FakeCapture] = field(default_factory=list)

    def __call__(self, *_: object) -> FakeCapture:
        self.opened.append(FakeCapture(self.images, self.let_go))
        return self.opened[-1]


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[Device]:
    made = Device(1)
    monkeypatch.setattr(cv2, "VideoCapture", made)
    yield made
    made.let_go.set()


def readers() -> int:
    return sum(thread.name == "video" for thread in threading.enumerate())


def test_a_device_that_opens_and_sends_nothing_is_given_up_after_the_read_timeout(device: Device) -> None:
    """OpenCV's read of a device blocked for 10 s; here it never returns by itself."""
    camera = VideoCamera("0", VideoConfig(read_timeout_s=0.1))
    assert camera.connect() == "video 0, 32x32 by V4L2"
    assert camera.read().width == 32
    with pytest.raises(CameraError, match=r"0: is open, but sends no image for 0.1 s. Check .* live streaming mode"):
        camera.read()
    assert camera.connect()  # the driver still blocks the first read
    assert camera.read().width == 32
    camera.close()
    assert device.opened[1].closed.wait(30.0)
    assert not device.opened[0].closed.is_set()
    device.let_go.set()
    assert device.opened[0].closed.wait(30.0)


def test_reads_that_hang_are_bounded_and_the_camera_returns_when_the_driver_does(device: Device) -> None:
    device.images = 0
    before = readers()
    camera = VideoCamera("0", VideoConfig(read_timeout_s=0.1))
    for _ in range(2):
        camera.connect()
        with pytest.raises(CameraError, match="sends no image"):
            camera.read()
    for _ in range(5):
        with pytest.raises(CameraError, match=r"2 reads have not returned: the device's driver hangs. Unplug"):
            camera.connect()
    assert (len(device.opened), readers() - before) == (2, 2)
    device.let_go.set()
    assert all(capture.closed.wait(30.0) for capture in device.opened)
    for thread in threading.enumerate():
        if thread.name == "video":
            thread.join(30.0)
    device.images = 1
    camera.connect()
    assert camera.read().width == 32
    camera.close()


@pytest.mark.parametrize("opens", [True, False])
def test_a_camera_ends_while_its_device_blocks(device: Device, opens: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the time-outs: neither opening nor reading can be interrupted."""
    asked = threading.Event()

    def capture(*arguments: object) -> FakeCapture:
        asked.set()
        if not opens:
            device.let_go.wait()
        return device(*arguments)

    monkeypatch.setattr(cv2, "VideoCapture", capture)
    events: list[tuple[bool, str]] = []
    camera = VideoCamera("0", VideoConfig(read_timeout_s=60.0))
    frames = threading.Event()
    loop = CameraLoop(camera, lambda frame: frames.set(), lambda connected, text: events.append((connected, text)))
    loop.start()
    assert asked.wait(30.0) and (not opens or frames.wait(30.0))
    assert loop.end(30.0)
    assert not device.let_go.is_set()
    assert [connected for connected, _ in events] == [True] * opens


def test_video_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"/dev/video99 does not exist"):
        VideoCamera("/dev/video99").connect()
    with pytest.raises(CameraError, match="cannot be opened as video"):
        VideoCamera(str(tmp_path / "nowhere.avi")).connect()
