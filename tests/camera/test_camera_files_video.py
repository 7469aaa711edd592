"""Pictures from files and from a video."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_theta import jpeg

from instant_ic.camera.config import FilesConfig, VideoConfig
from instant_ic.camera.files import FileCamera
from instant_ic.camera.source import CameraError
from instant_ic.camera.video import VideoCamera


def test_folder_in_the_order_of_names_with_jpegs_byte_for_byte(tmp_path: Path) -> None:
    (tmp_path / "b.jpg").write_bytes(jpeg(80))
    (tmp_path / "a.JPG").write_bytes(jpeg(40))
    cv2.imwrite(str(tmp_path / "c.png"), np.full((16, 32, 3), 200, np.uint8))
    (tmp_path / "notes.txt").write_text("no picture")
    with FileCamera(tmp_path, now_ns=lambda: 7) as camera:
        frames = [camera.next_frame() for _ in range(4)]
    assert [frame.jpeg for frame in frames[:2]] == [jpeg(40), jpeg(80)]
    assert (frames[2].width, frames[2].height) == (32, 16)
    assert abs(int(cv2.imdecode(np.frombuffer(frames[2].jpeg, np.uint8), 1).mean()) - 200) <= 2
    assert frames[3].jpeg == jpeg(40)  # from the start again
    assert {frame.stamp_ns for frame in frames} == {7}


def test_without_loop_the_last_picture_stays(tmp_path: Path) -> None:
    for name, value in (("a.jpg", 40), ("b.jpg", 80)):
        (tmp_path / name).write_bytes(jpeg(value))
    with FileCamera(tmp_path, FilesConfig(loop=False)) as camera:
        assert [camera.next_frame().jpeg for _ in range(3)] == [jpeg(40), jpeg(80), jpeg(80)]


def test_rate_is_kept_and_late_readers_are_not_flooded(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(40))
    now = [1_000_000_000]
    waits: list[float] = []

    def sleep(seconds: float) -> None:
        waits.append(round(seconds, 6))
        now[0] += round(seconds * 1e9)

    camera = FileCamera(tmp_path / "a.jpg", FilesConfig(rate_hz=10.0), lambda: now[0], sleep)
    with camera:
        camera.read()
        camera.read()
        assert waits == [0.1]
        now[0] += 550_000_000  # the reader was away
        for _ in range(3):
            camera.read()
        # One picture at once, one to catch up with the rate, then at the rate again.
        assert len(waits) == 2 and waits[1] == pytest.approx(0.1)


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
    means = [cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), 1).mean() for frame in frames]
    np.testing.assert_allclose(means, [50, 100, 150], atol=4)


def test_video_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"/dev/video99 does not exist"):
        VideoCamera("/dev/video99").connect()
    with pytest.raises(CameraError, match="cannot be opened as video"):
        VideoCamera(str(tmp_path / "nowhere.avi")).connect()
