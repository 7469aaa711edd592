"""A camera's password comes from a private file and appears nowhere: no parameter, text, argument or bag holds it."""

import cv2
import pytest
from fake_theta import Behaviour, FakeTheta

from instant_ic.camera.config import ThetaCameraConfig
from instant_ic.camera.device import open_camera
from instant_ic.camera.source import CameraError
from instant_ic.config import params

SECRET = "pass/w:rd@1"


@pytest.fixture
def password_file(tmp_path):
    path = tmp_path / "camera.password"
    path.write_text(f"operator:{SECRET}\n")
    path.chmod(0o600)
    return path


def open_with(path, **given):
    given = {"source": "video", "url": "rtsp://10.0.0.7:554/live", **given}
    config = ThetaCameraConfig(**given, password_file=str(path))
    return config, open_camera(config, lambda: 0)


@pytest.mark.parametrize(
    "url", ["rtsp://me:secret@10.0.0.7/live", "http://10.0.0.7/video?password=secret", "http://10.0.0.7/{password}"]
)
def test_fault_a_password_in_the_address_is_shown_by_ps_log_bag_and_parameters(url):
    values = params.gather("theta_camera", [], [f"url:={url}", "source:=video"])
    with pytest.raises(params.ParameterError, match="set password_file") as refused:
        params.configure(ThetaCameraConfig, values)
    assert "secret" not in str(refused.value)


class Closed:
    """A capture that could not be opened."""

    def isOpened(self):
        return False

    def release(self):
        pass


@pytest.mark.parametrize(
    ("url", "source"),
    [
        ("rtsp://10.0.0.7:554/live", "rtsp://operator:pass%2Fw%3Ard%401@10.0.0.7:554/live"),
        ("http://10.0.0.7/live?usr={user}&pwd={password}", "http://10.0.0.7/live?usr=operator&pwd=pass%2Fw%3Ard%401"),
        ("3", 3),
    ],
)
def test_only_the_stream_itself_gets_the_password(password_file, monkeypatch, url, source):
    asked = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda *given: (asked.append(given[0]), Closed())[1])
    config, camera = open_with(password_file, url=url)
    with pytest.raises(CameraError, match="cannot be opened as video") as refused:
        camera.connect()
    assert asked == [source]
    for shown in (str(refused.value), camera.url, str(params.to_dict(config)), repr(config)):
        assert "rd@1" not in shown and "rd%40" not in shown and "operator" not in shown


def test_fault_opencv_logs_the_password_of_an_address_that_it_cannot_open(password_file, capfd):
    _, camera = open_with(password_file, url="http://127.0.0.1:9/live.mjpg")  # nothing listens there
    with pytest.raises(CameraError, match="cannot be opened as video"):
        camera.connect()
    camera.close()
    shown = "".join(capfd.readouterr())
    assert "rd@1" not in shown and "rd%40" not in shown


def test_the_theta_gets_the_password_of_the_file(password_file):
    password_file.write_text("THETAYL00105307:00105307")
    with FakeTheta(Behaviour(password="00105307")) as theta:
        _, camera = open_with(password_file, source="theta", url=theta.url)
        assert camera.client.info()["model"]


def test_password_files_that_others_read_or_that_hold_none_are_refused(password_file):
    password_file.chmod(0o640)
    with pytest.raises(CameraError, match="is readable by others: run `chmod 600"):
        open_with(password_file)
    password_file.chmod(0o600)
    password_file.write_text("no colon")
    with pytest.raises(CameraError, match="must hold USER:PASSWORD"):
        open_with(password_file)
    with pytest.raises(CameraError, match=r"missing: No such file"):
        open_with(password_file.with_name("missing"))
