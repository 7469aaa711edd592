"""Client and preview against a Theta that misbehaves, over real HTTP."""

import threading

import pytest
from fake_theta import Behaviour, FakeTheta, jpeg, part

from instant_ic.camera.config import ThetaConfig
from instant_ic.camera.loop import CameraLoop
from instant_ic.camera.source import Camera, CameraError, Frame
from instant_ic.camera.theta import NEVER, ThetaCamera, ThetaClient, ThetaError
from instant_ic.util.diagnosis import Level
from instant_ic.util.reconnect import Backoff

FRAMES = [jpeg(value) for value in (40, 80, 120, 160)]
CONFIG = ThetaConfig(settle_s=0.0, busy_wait_s=0.01, connect_timeout_s=20.0, read_timeout_s=20.0)
SERIAL = "THETAYL00105307"


def one_by_one(behaviour: Behaviour) -> Behaviour:
    """Make sure that the reader can take each frame before the next comes: newest-only would skip some."""
    behaviour.previews = [[part(frame)] for frame in FRAMES]
    return behaviour


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("boundary", ["---osclivepreview---", "-----osclivepreview---"])
def test_frames_pass_byte_for_byte_and_the_newest_counts(chunked: bool, boundary: str) -> None:
    pieces = [b"".join(part(frame, boundary) for frame in FRAMES)]
    with FakeTheta(Behaviour(previews=[pieces], chunked=chunked)) as theta:
        with ThetaCamera(ThetaClient(theta.url, CONFIG), lambda: 5_000_000_000) as camera:
            frame = camera.read()
            assert frame == Frame(FRAMES[-1], 4_800_000_000, 64, 32)  # 0.2 s of latency
            with pytest.raises(CameraError, match="the camera ended it"):
                camera.read()


def test_a_camera_with_the_right_options_starts_its_preview_at_once() -> None:
    waits: list[float] = []
    with FakeTheta(Behaviour(previews=[[part(FRAMES[0])], [part(FRAMES[1])]])) as theta:
        camera = ThetaCamera(ThetaClient(theta.url, ThetaConfig(), sleep=waits.append))
        assert camera.connect().startswith("RICOH THETA Z1 (firmware 3.10.2)")
        assert theta.behaviour.commands == ["camera.getOptions", "camera.setOptions", "camera.getLivePreview"]
        assert theta.behaviour.options.values == {"captureMode": "image", "sleepDelay": NEVER, "offDelay": NEVER}
        assert theta.behaviour.options.preview == (1024, 512, 30)
        camera.connect()
        camera.close()
        assert theta.behaviour.commands[3:] == ["camera.getOptions", "camera.getLivePreview"]
    assert waits == [1.0]  # of the first connection


def connections(behaviour: Behaviour, times: int) -> tuple[list[list[str]], ThetaCamera, str]:
    """The commands of each of several connections, the camera, and its last description."""
    behaviour.previews = [[part(FRAMES[0])] for _ in range(times)]
    commands = []
    with FakeTheta(behaviour) as theta:
        camera = ThetaCamera(ThetaClient(theta.url, CONFIG))
        for _ in range(times):
            behaviour.commands.clear()
            text = camera.connect()
            commands.append([name.removeprefix("camera.") for name in behaviour.commands])
        camera.close()
    return commands, camera, text


GET, SET, PREVIEW = "getOptions", "setOptions", "getLivePreview"


@pytest.mark.parametrize("kept", [{}, {"sleepDelay": NEVER}, {"sleepDelay": NEVER, "offDelay": NEVER}])
def test_a_camera_that_never_sleeps_reports_0_or_65535_and_is_set_once(kept: dict[str, int]) -> None:
    """It reads back 0 for 65535: each reconnection set the options again, and waited."""
    commands, camera, _ = connections(Behaviour(reported=kept), 3)
    assert commands == [[GET, SET, PREVIEW], [GET, PREVIEW], [GET, PREVIEW]]
    assert camera.advice == ""


@pytest.mark.parametrize("reported", [{"width": 0, "height": 0, "framerate": 0}, None])
def test_a_preview_format_of_zeros_or_none_is_no_answer(reported: dict[str, int] | None) -> None:
    commands, _, text = connections(Behaviour(reported={"previewFormat": reported}), 2)
    assert commands == [[GET, SET, PREVIEW]] * 2
    assert text.endswith("preview 1024x512 at 30 Hz")


def test_old_firmware_gets_a_format_that_it_knows_and_the_operator_the_version_to_install() -> None:
    """It refuses 30 frames a second with invalidParameterValue: there was never an image."""
    behaviour = Behaviour(firmware="1.60.1")
    commands, camera, text = connections(behaviour, 3)
    assert commands == [[GET, SET, SET, PREVIEW], [GET, PREVIEW], [GET, PREVIEW]]
    assert behaviour.options.preview == (1024, 512, 8)
    assert text.endswith("preview 1024x512 at 8 Hz")
    assert "1024x512 at 30 Hz" in camera.advice and "2.21.1 or later; it has 1.60.1" in camera.advice


def test_another_refusal_is_not_taken_for_old_firmware() -> None:
    with FakeTheta(Behaviour(previews=[[part(FRAMES[0])]])) as theta:
        theta.behaviour.options.formats = ()
        with pytest.raises(ThetaError, match=r"previewFormat .* is not supported"):
            ThetaCamera(ThetaClient(theta.url, CONFIG)).connect()
        theta.behaviour.options.values.pop("offDelay")
        with pytest.raises(ThetaError, match="invalidParameterName"):
            ThetaCamera(ThetaClient(theta.url, CONFIG)).connect()
        assert theta.behaviour.commands.count("camera.setOptions") == 3 + 1


def test_digest_authentication_for_commands_and_preview() -> None:
    with FakeTheta(Behaviour(previews=[[part(FRAMES[0])]], password="00105307")) as theta:
        with ThetaCamera(ThetaClient(theta.url, CONFIG, SERIAL, "00105307")) as camera:
            assert camera.read().jpeg == FRAMES[0]
        # One challenge for each of the two connections; after it the nonce is kept.
        assert theta.behaviour.unauthorised == 2
        with pytest.raises(ThetaError, match="INSTANT_IC_THETA_USER") as caught:
            ThetaClient(theta.url, CONFIG, SERIAL, "wrong").info()
        assert caught.value.code == "http 401"


def test_busy_camera_is_asked_again_with_growing_waits() -> None:
    waits: list[float] = []
    with FakeTheta(Behaviour(busy=3)) as theta:
        client = ThetaClient(theta.url, ThetaConfig(busy_wait_s=0.25), sleep=waits.append)
        assert client.info()["model"] == "RICOH THETA Z1"
        assert waits == [0.25, 0.5, 1.0]
        theta.behaviour.busy = 99
        with pytest.raises(ThetaError, match="serviceUnavailable") as caught:
            client.info()
        assert caught.value.code == "serviceUnavailable"


def test_refused_command_gives_the_cameras_words() -> None:
    with FakeTheta() as theta:
        client = ThetaClient(theta.url, CONFIG)
        with pytest.raises(ThetaError, match=r"camera.fly refused: unknownCommand Unknown command camera.fly"):
            client.execute("camera.fly")
        with pytest.raises(ThetaError, match="disabledCommand"):
            client.open_preview()


def test_state_with_errors() -> None:
    with FakeTheta() as theta:
        client = ThetaClient(theta.url, CONFIG)
        found = client.health()
        assert (found.level, found.text) == (Level.OK, "no faults")
        assert found.values == {"battery": 0.83, "battery_temperature_c": 30.0, "board_temperature_c": 41.0}
        theta.behaviour.state = {"_cameraError": ["HIGH_TEMPERATURE"]}
        found = client.health()
        assert (found.level, found.text) == (Level.ERROR, "HIGH_TEMPERATURE")
        assert found.values["battery"] is None


def test_frame_that_stalls_in_the_middle_is_never_given_out() -> None:
    config = ThetaConfig(settle_s=0.0, read_timeout_s=0.2)
    half = part(FRAMES[1])[:300]
    with FakeTheta(Behaviour(previews=[[part(FRAMES[0]) + half]], stall=True)) as theta:
        with ThetaCamera(ThetaClient(theta.url, config)) as camera:
            assert camera.read().jpeg == FRAMES[0]
            with pytest.raises(CameraError, match=r"preview ended: .*[Tt]ime"):
                camera.read()


def test_nobody_there_is_told_in_words() -> None:
    with FakeTheta() as theta:
        url = theta.url
    with pytest.raises(CameraError, match=r"no answer .*the camera is on"):
        ThetaClient(url, CONFIG).info()


def test_loop_connects_again_after_each_end_and_backs_off() -> None:
    """Four previews of one frame each, then refusals: all frames arrive, and the waits double up to the limit."""
    received: list[bytes] = []
    events: list[tuple[bool, str]] = []
    enough = threading.Event()

    def on_event(connected: bool, text: str) -> None:
        events.append((connected, text))
        if sum("disabledCommand" in text for _, text in events) >= 4:
            enough.set()

    with FakeTheta(one_by_one(Behaviour())) as theta:
        loop = CameraLoop(
            ThetaCamera(ThetaClient(theta.url, CONFIG)),
            lambda frame: received.append(frame.jpeg),
            on_event,
            Backoff(0.02, 0.08),
        )
        loop.start()
        assert enough.wait(60.0)
        assert loop.end(30.0)
    assert received == FRAMES
    waits = [text.rsplit(" in ", 1)[1] for connected, text in events if not connected]
    # A picture makes the next wait short again; refusals make it longer.
    assert waits[:7] == ["0.02 s"] * 4 + ["0.04 s", "0.08 s", "0.08 s"]
    assert [connected for connected, _ in events[:8]] == [True, False] * 4


class FlakyCamera(Camera):
    """Fails in a way that no camera should, and then works."""

    failures = 2

    def connect(self) -> str:
        self.failures -= 1
        if self.failures >= 0:
            raise RuntimeError("a bug")
        return "works"

    def read(self) -> Frame:
        return Frame(FRAMES[0], 0, 64, 32)

    def close(self) -> None:
        pass


def test_loop_outlives_and_tells_unexpected_exceptions() -> None:
    events: list[str] = []
    arrived = threading.Event()
    loop = CameraLoop(
        FlakyCamera(0.0),
        lambda frame: arrived.set(),
        lambda connected, text: events.append(text),
        Backoff(0.01, 0.01),
    )
    loop.start()
    assert arrived.wait(30.0)
    assert loop.end(30.0)
    assert events[0].startswith("unexpected RuntimeError('a bug')")
    assert events[2] == "works"
