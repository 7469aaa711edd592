"""Camera and motor controller over their real protocols: read by independent clients, and by the stack's drivers."""

import json
import logging
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
import requests
import serial

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.roboclaw import Roboclaw
from instant_ic.sim.real_time import SimulatedDevices, SimulatorConfig
from instant_ic.sim.roboclaw import RoboClawServer
from instant_ic.sim.roboclaw_emulator import RoboclawEmulator
from instant_ic.sim.simulation import BaseConfig, Simulation
from instant_ic.sim.theta import SimThetaConfig, ThetaServer, panorama_file
from instant_ic.sim.vlp16 import Vlp16Config
from instant_ic.sim.world import World

TIMEOUT_S = 20.0


def grey_ramp(width: int, height: int) -> np.ndarray:
    """Panorama whose red grows to the right and whose green grows downwards."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, np.full_like(x, 100)], axis=-1).astype(np.uint8)


@pytest.fixture
def camera() -> Iterator[ThetaServer]:
    server = ThetaServer(SimThetaConfig(port=0, width=640, height=320, rate=30.0, latency_s=0.0), grey_ramp)
    yield server
    server.close()


def url(server: ThetaServer) -> str:
    return f"http://127.0.0.1:{server.port}"


def execute(server: ThetaServer, name: str, **parameters: object) -> requests.Response:
    return requests.post(
        url(server) + "/osc/commands/execute", json={"name": name, "parameters": parameters}, timeout=TIMEOUT_S
    )


def raw_preview(server: ThetaServer, parts: int) -> tuple[bytes, list[tuple[bytes, bytes]]]:
    """HTTP header, and (part header, JPEG) of the first parts, read with a plain socket: chunks taken off by hand."""
    body = json.dumps({"name": "camera.getLivePreview"}).encode()
    with socket.create_connection(("127.0.0.1", server.port), TIMEOUT_S) as connection:
        connection.sendall(
            b"POST /osc/commands/execute HTTP/1.1\r\nHost: theta\r\nContent-Type: application/json;charset=utf-8\r\n"
            b"Content-Length: %d\r\n\r\n" % len(body) + body
        )
        file = connection.makefile("rb")
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += file.readline()
        stream, found = b"", []
        while len(found) < parts:
            stream += file.read(int(file.readline(), 16))
            assert file.readline() == b"\r\n"
            while match := re.search(rb"Content-Length: (\d+)\r\n\r\n", stream):
                end = match.end() + int(match[1])
                if len(stream) < end:
                    break
                found.append((stream[: match.end()], stream[match.end() : end]))
                stream = stream[end:].lstrip(b"\r\n")
        return head, found


def test_preview_has_the_cameras_own_boundary_and_lengths(camera: ThetaServer) -> None:
    head, parts = raw_preview(camera, 3)
    assert b" 200 " in head.splitlines()[0]
    assert b'multipart/x-mixed-replace; boundary="---osclivepreview---"' in head
    assert b"Transfer-Encoding: chunked" in head
    for part_head, jpeg in parts:
        # The literal boundary, not RFC 2046's with two dashes more.
        assert part_head.startswith(b"---osclivepreview---\r\nContent-type: image/jpeg\r\n")
        assert jpeg[:2] == b"\xff\xd8" and jpeg[-2:] == b"\xff\xd9"
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (320, 640, 3)
        assert np.abs(image[..., ::-1].astype(int) - grey_ramp(640, 320)).mean() < 4


def test_pictures_are_made_only_while_somebody_watches(camera: ThetaServer) -> None:
    assert camera.frames == 0 and not camera.watched
    raw_preview(camera, 1)
    deadline = time.monotonic() + TIMEOUT_S
    while camera.watched and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not camera.watched, "a viewer that closed its connection is noticed at the next picture"


def test_fault_the_image_of_a_standing_robot_comes_again_so_that_its_camera_seems_to_repeat() -> None:
    view = grey_ramp(640, 320)
    config = SimThetaConfig(port=0, width=640, height=320, rate=30.0, latency_s=0.0)
    server = ThetaServer(config, lambda width, height: view)
    try:
        images = [jpeg for _, jpeg in raw_preview(server, 20)[1]]
        assert len(set(images)) == 20
        decoded = cv2.imdecode(np.frombuffer(images[0], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert 0.3 < (decoded.astype(float) - view).std() < 2.0
    finally:
        server.close()


def test_a_standing_robot_sees_the_same_image_until_it_moves(box_room: World, tmp_path: Path) -> None:
    config = SimulatorConfig(
        camera=SimThetaConfig(port=0, width=640, height=320),
        lidar=Vlp16Config(enabled=False),
        base=BaseConfig(enabled=False),
    )
    simulation = Simulation(config, world=box_room)
    devices = SimulatedDevices(config, simulation, tmp_path, logging.getLogger("test"))
    try:
        assert devices.camera is not None
        source = devices.camera.source
        still = source(640, 320)
        simulation.step(0.1)
        assert source(640, 320) is still
        assert source(1024, 512).shape == (512, 1024, 3)
        seen = source(640, 320)
        simulation.drive(0.3, 0.0)
        simulation.step(0.2)
        moved = source(640, 320)
        assert moved is not seen and (moved != seen).any()
    finally:
        devices.close()


def test_state_and_info(camera: ThetaServer) -> None:
    info = requests.get(url(camera) + "/osc/info", timeout=TIMEOUT_S).json()
    assert info["model"] == "RICOH THETA Z1" and 2 in info["apiLevel"]
    state = requests.post(url(camera) + "/osc/state", json={}, timeout=TIMEOUT_S).json()
    assert 0 <= state["state"]["batteryLevel"] <= 1 and state["state"]["_cameraError"] == []


def test_options_change_the_preview_after_a_moment(camera: ThetaServer) -> None:
    wanted = {"width": 1024, "height": 512, "framerate": 30}
    assert (
        execute(camera, "camera.setOptions", options={"previewFormat": wanted, "sleepDelay": 65535}).json()["state"]
        == "done"
    )
    busy = execute(camera, "camera.getLivePreview")
    assert busy.status_code == 503 and busy.json()["error"]["code"] == "serviceUnavailable"
    options = execute(camera, "camera.getOptions", optionNames=["previewFormat", "sleepDelay"]).json()["results"][
        "options"
    ]
    assert options == {"previewFormat": wanted, "sleepDelay": 0}  # never: the camera reports 0 for 65535
    deadline = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline:
        head, parts = raw_preview(camera, 1) if _ready(camera) else (b"", [])
        if parts:
            break
    image = cv2.imdecode(np.frombuffer(parts[0][1], np.uint8), cv2.IMREAD_COLOR)
    assert b" 200 " in head.splitlines()[0] and image.shape == (512, 1024, 3)


def _ready(camera: ThetaServer) -> bool:
    reply = requests.post(
        url(camera) + "/osc/commands/execute", json={"name": "camera.getLivePreview"}, stream=True, timeout=TIMEOUT_S
    )
    reply.close()
    return reply.status_code == 200


@pytest.mark.parametrize(
    ("request_body", "code"),
    [
        ({"name": "camera.fly"}, "unknownCommand"),
        ({}, "missingParameter"),
        ({"name": "camera.setOptions"}, "missingParameter"),
        (
            {"name": "camera.setOptions", "parameters": {"options": {"previewFormat": {"width": 7}}}},
            "invalidParameterValue",
        ),
        ({"name": "camera.getOptions", "parameters": {"optionNames": ["colour"]}}, "invalidParameterName"),
        ({"name": "camera.setOptions", "parameters": {"options": {"sleepDelay": 59}}}, "invalidParameterValue"),
        ({"name": "camera.getOptions", "parameters": 3}, "invalidParameterValue"),
    ],
)
def test_mistakes_get_the_cameras_error_codes(camera: ThetaServer, request_body: dict[str, object], code: str) -> None:
    reply = requests.post(url(camera) + "/osc/commands/execute", json=request_body, timeout=TIMEOUT_S)
    assert reply.status_code == 400
    assert reply.json()["state"] == "error" and reply.json()["error"]["code"] == code


def test_a_taken_port_is_told(camera: ThetaServer) -> None:
    with pytest.raises(OSError, match=rf"cannot listen on 127.0.0.1:{camera.port}.*camera.port"):
        ThetaServer(SimThetaConfig(port=camera.port), grey_ramp)


def test_a_panorama_file_is_area_averaged(tmp_path: Path) -> None:
    # Columns of one pixel, black and white: averaged they are mid grey, point-sampled they would not be.
    image = np.zeros((1280, 2560, 3), np.uint8)
    image[:, ::2] = 255
    path = tmp_path / "stripes.png"
    cv2.imwrite(str(path), image)
    source = panorama_file(path)
    small = source(640, 320)
    assert small.shape == (320, 640, 3)
    assert small.min() >= 127 and small.max() <= 128
    assert source(640, 320) is small
    with pytest.raises(ValueError, match="cannot be decoded as an image"):
        panorama_file(tmp_path / "none.png")


# --- RoboClaw ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[tuple[RoboclawEmulator, RoboClawServer]]:
    emulator = RoboclawEmulator()
    server = RoboClawServer(emulator, threading.Lock(), tmp_path / "dev" / "roboclaw")
    yield emulator, server
    server.close()
    assert not (tmp_path / "dev" / "roboclaw").is_symlink()


def test_the_terminal_answers_the_vectors(controller: tuple[RoboclawEmulator, RoboClawServer]) -> None:
    emulator, server = controller
    emulator.battery_v = 24.1
    emulator.encoder[:] = (1000, -256)
    assert server.link is not None
    with serial.Serial(str(server.link), 115200, timeout=TIMEOUT_S) as port:
        # Vectors of the packet serial protocol, CRC16 XMODEM worked out independently.
        port.write(bytes.fromhex("80250000000000000000 3404"))
        assert port.read(1) == b"\xff"
        port.write(bytes.fromhex("8025000003e8fffffc18 8290"))
        assert port.read(1) == b"\xff"
        port.write(bytes.fromhex("8018"))
        assert port.read(4) == bytes.fromhex("00f1c8c4")
        port.write(bytes.fromhex("804e"))
        assert port.read(10) == bytes.fromhex("000003e8ffffff00 b864")
        # Flow control, line ends and interrupt must not be eaten by the terminal.
        emulator.encoder[:] = (0x0D0A1113, 0x03041A7F)
        port.write(bytes.fromhex("804e"))
        assert port.read(10)[:8] == bytes.fromhex("0d0a111303041a7f")
    assert emulator.target_speed_pps.tolist() == [1000, -1000]


def test_a_driver_can_come_back(controller: tuple[RoboclawEmulator, RoboClawServer]) -> None:
    emulator, server = controller
    for count in (5, 7):
        emulator.encoder[:] = count
        with closing(Roboclaw(RoboclawConfig(port=str(server.link), reply_timeout_s=0.5))) as driver:
            driver.connect()
            assert driver.encoders().tolist() == [count, count]
            assert "Roboclaw" in driver.version()
            assert driver.battery_v() == pytest.approx(24.1)


def test_a_stale_link_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "roboclaw"
    link.symlink_to("/dev/pts/none")
    server = RoboClawServer(RoboclawEmulator(), threading.Lock(), link)
    try:
        assert str(link.readlink()) == server.device
    finally:
        server.close()
