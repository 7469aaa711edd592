"""The node: files in lockstep, and a Theta over real HTTP and real bus sockets."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_theta import Behaviour, FakeTheta, jpeg, part

from instant_ic.bus import ERROR, OK, RELIABLE, WARN, Node
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.camera.config import FilesConfig, ThetaConfig
from instant_ic.camera.device import PASSWORD_VARIABLE, USER_VARIABLE
from instant_ic.msg import CompressedImage, stamp_ns, transform_matrix
from nodes.theta_camera import ThetaCameraConfig, ThetaCameraNode

START = 1_700_000_000_000_000_000


def test_files_in_lockstep(tmp_path: Path) -> None:
    for name, value in (("a.jpg", 40), ("b.jpg", 80)):
        (tmp_path / name).write_bytes(jpeg(value))
    bus = LockstepBus(start_ns=START)
    bus.add(ThetaCameraNode, ThetaCameraConfig(source="files", url=str(tmp_path), files=FilesConfig(rate_hz=10.0)))
    bus.advance(0.35)
    pictures = bus.messages("/camera/image/compressed")
    assert [bytes(picture.data) for picture in pictures] == [jpeg(40), jpeg(80), jpeg(40)]
    assert [stamp_ns(picture) - START for picture in pictures] == [100_000_000, 200_000_000, 300_000_000]
    assert (pictures[0].format, pictures[0].header.frame_id) == ("jpeg", "camera")
    mount = bus.last("/tf_static").transforms[0]
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "camera")
    assert transform_matrix(mount)[:3, 3].tolist() == [0.0, 0.0, 1.2]


def test_advice_of_a_connected_camera_is_a_warning(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(jpeg(40))
    node = LockstepBus().add(ThetaCameraNode, ThetaCameraConfig(source="files", url=str(tmp_path)))
    node.camera.advice = "Update it."
    node.on_event(True, "a camera")
    assert node.diagnoses()["camera"][:2] == (WARN, "a camera. Update it.")
    node.on_event(False, "no answer")
    assert node.diagnoses()["camera"][:2] == (ERROR, "no answer")


@pytest.fixture
def run_dir() -> Iterator[Path]:
    """A run directory with a short name: pytest's own is too long for the path of a socket."""
    with tempfile.TemporaryDirectory(prefix="ic-") as path:
        yield Path(path)


class Probe(Node[ThetaCameraConfig]):
    """Listens to the camera over real sockets."""

    name = "probe"

    def setup(self) -> None:
        self.pictures: list[bytes] = []
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_picture, qos=RELIABLE)

    def on_picture(self, message: Any) -> None:
        self.pictures.append(bytes(message.data))


def test_theta_over_real_sockets(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Digest from the environment, a preview that ends, one that goes on, and then silence."""
    monkeypatch.setenv(USER_VARIABLE, "THETAYL00105307")
    monkeypatch.setenv(PASSWORD_VARIABLE, "00105307")
    clock = SystemClock()
    behaviour = Behaviour(password="00105307", state={"batteryLevel": 0.1, "_cameraError": ["HIGH_TEMPERATURE"]})
    with FakeTheta(behaviour) as theta:
        config = ThetaCameraConfig(
            url=theta.url,
            health_period_s=0.05,
            theta=ThetaConfig(settle_s=0.0, busy_wait_s=0.01),
        )
        nodes: list[Node[Any]] = []
        for kind in (Probe, ThetaCameraNode):
            nodes.append(kind(config, LocalTransport(run_dir, kind.name, clock.now_ns), clock))
            nodes[-1].start()
        probe, camera = nodes
        assert isinstance(probe, Probe) and isinstance(camera, ThetaCameraNode)
        try:
            sent: dict[int, bytes] = {}

            def spin_until(done: Any) -> None:
                deadline = time.monotonic() + 60.0
                while not done() and time.monotonic() < deadline:
                    if not behaviour.previews:
                        behaviour.previews = [[part(sent.setdefault(len(sent), jpeg(len(sent))))]]
                    probe.spin_once()
                    camera.spin_once()
                    time.sleep(0.002)
                assert done()

            spin_until(lambda: len(probe.pictures) >= 3)
            assert len(set(probe.pictures)) == len(probe.pictures) and set(probe.pictures) <= set(sent.values())
            spin_until(lambda: "health" in camera.diagnoses())
            level, text, values = camera.diagnoses()["health"]
            assert (level, text) == (ERROR, "battery is low: charge it, HIGH_TEMPERATURE")
            assert values["battery"] == 0.1
            camera.last_ns = camera.clock.steady_ns()
            camera.check()
            assert camera.diagnoses()["images"][0] == OK
            for seconds, expected in ((2.5, WARN), (8.5, ERROR)):
                camera.last_ns = camera.clock.steady_ns() - round(seconds * 1e9)
                camera.check()
                level, text, _ = camera.diagnoses()["images"]
                assert level == expected and text.startswith("no image for")
        finally:
            for node in reversed(nodes):
                node.close()
        assert camera.loop is not None and not camera.loop.is_alive()
