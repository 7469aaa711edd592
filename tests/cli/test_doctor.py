import http.server
import json
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from instant_ic.cli import doctor
from instant_ic.cli.doctor import FAIL, OK, WARN, Finding
from instant_ic.cli.main import main
from instant_ic.util import paths


class Theta(http.server.BaseHTTPRequestHandler):
    status = 200

    def do_GET(self) -> None:
        body = json.dumps({"model": "RICOH THETA Z1", "firmwareVersion": "2.21.1"}).encode()
        self.send_response(self.status if self.path == "/osc/info" else 404)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def theta() -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Theta)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    server.server_close()


def one(findings: Iterator[Finding]) -> Finding:
    found = list(findings)
    assert len(found) == 1
    return found[0]


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_camera_that_answers(theta: str) -> None:
    found = one(doctor.check_camera(theta, WARN))
    assert (found.level, found.text) == (OK, "RICOH THETA Z1, firmware 2.21.1")


@pytest.mark.parametrize(("status", "advice"), [(404, "something else answers"), (401, "user and password")])
def test_camera_that_refuses(status: int, advice: str, theta: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Theta, "status", status)
    found = one(doctor.check_camera(theta, WARN))
    assert found.text == f"HTTP status {status}" and advice in found.advice


@pytest.mark.parametrize("level", [WARN, FAIL])
def test_devices_that_are_missing(level: str, tmp_path: Path) -> None:
    camera = one(doctor.check_camera(f"http://127.0.0.1:{free_port(socket.SOCK_STREAM)}", level))
    lidar = one(doctor.check_lidar(free_port(socket.SOCK_DGRAM), 0.05, level))
    assert camera.level == lidar.level == level and camera.advice and lidar.advice
    assert "is unreachable" in camera.text
    serial = one(doctor.check_serial(tmp_path / "ttyACM7", level, list))
    assert serial.level == level and "does not exist (available: none)" in serial.text


@pytest.mark.parametrize(("size", "level"), [(1206, OK), (100, WARN)])
def test_lidar_packets(size: int, level: str) -> None:
    port = free_port(socket.SOCK_DGRAM)
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not stop.wait(0.01):
                sender.sendto(bytes(size), ("127.0.0.1", port))

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    found = one(doctor.check_lidar(port, 20.0, WARN))
    stop.set()
    thread.join()
    assert found.level == level and "127.0.0.1" in found.text


def test_serial_port_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyACM0"
    port.touch()
    assert one(doctor.check_serial(port, WARN, list)).level == OK
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    found = one(doctor.check_serial(port, FAIL, list))
    assert found.level == FAIL and "usermod -aG" in found.advice


def test_port_in_use() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        found = one(doctor.check_ports({port: "operator's page"}, {}))
    assert found.level == WARN and found.text == "operator's page: Address already in use"
    assert one(doctor.check_ports({port: "page"}, {})).level == OK


def test_strict_reverse_path_filter(tmp_path: Path) -> None:
    for name, value in (("lo", "1"), ("eth0", "2"), ("eth1", "1"), ("default", "1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "rp_filter").write_text(value + "\n")
    found = one(doctor.check_network_filter(tmp_path))
    assert found.level == WARN and "strict on eth1:" in found.text
    (tmp_path / "eth1" / "rp_filter").write_text("0\n")
    assert one(doctor.check_network_filter(tmp_path)).level == OK


def test_run_directory_of_somebody_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    uid = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    found = [f for f in doctor.check_machine(tmp_path / "run") if f.subject == "run directory"]
    assert [f.level for f in found] == [FAIL] and "belongs to" in found[0].text


def test_models_and_launch_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("launch", "models"):
        (tmp_path / name).mkdir()
    (tmp_path / "nodes").symlink_to(paths.share_dir("nodes"))
    monkeypatch.setattr("instant_ic.util.paths.share_dir", lambda name: tmp_path / name)
    assert one(doctor.check_models()).level == FAIL
    (tmp_path / "models" / "torn.onnx").write_bytes(b"not a model")
    assert one(doctor.check_models()).level == FAIL
    node = "launch:\n- arg: {name: b}\n- node: {exec: bag_player, param: [{name: KEY, value: $(var b)}]}\n"
    (tmp_path / "launch" / "bad.yaml").write_text(node.replace("KEY", "bagg"))
    (tmp_path / "launch" / "good.yaml").write_text(node.replace("KEY", "bag"))
    bad, good = doctor.check_configuration()
    assert bad.level == FAIL and "bad.yaml:3" in bad.text and "did you mean 'bag'" in bad.text
    assert (good.level, good.subject) == (OK, "launch/good.yaml")


def test_exit_status_follows_the_worst(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    findings = [Finding(OK, "a", "good"), Finding(WARN, "b", "not so good", "do this")]
    monkeypatch.setattr(doctor, "run_checks", lambda *args: iter(findings))
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert out == "ok    a: good\nwarn  b: not so good\n      → do this\n1 ok, 1 warnings, 0 failures\n"
    findings.append(Finding(FAIL, "c", "bad", "do that"))
    assert main(["doctor"]) == 1


def test_addresses_come_from_the_shipped_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[Any, ...]] = []
    monkeypatch.setattr(doctor, "run_checks", lambda *args: given.append(args) or iter([]))
    assert main(["doctor", "--robot", "--lidar-port", "9"]) == 0
    assert main(["doctor"]) == 0
    _, serial_port, camera_url, lidar_port, _, missing = given[0]
    assert camera_url.startswith("http://") and str(serial_port).startswith("/dev/")
    assert (lidar_port, missing) == (9, FAIL)
    assert given[1][3:] == (2368, 1.0, WARN)  # a missing device is a failure only where the real ones are asked for
