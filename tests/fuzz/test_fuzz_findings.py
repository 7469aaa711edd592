"""What `make fuzz` found, each by name: these inputs once ended in another error than the parser's own."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import pytest

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bag.message import Schema
from instant_ic.bag.metadata import preset_of_text, schema_or_unknown, with_hash
from instant_ic.bag.recover import recover
from instant_ic.bus.qos import RELIABLE, SENSOR
from instant_ic.camera.http import DeviceSession
from instant_ic.config.params import ParameterError, load_file
from instant_ic.console.protocol import PREFIX, VERSION, PageProtocolError, decode_frame
from instant_ic.depth.manifest import ManifestError, load_manifest
from instant_ic.experiments.slam_logs import LogError, read_log
from instant_ic.msg import message_type, serialize
from instant_ic.slam.map_files import MapError, load_grid
from instant_ic.util.limits import decode_image, load_image
from tests.fuzz.targets import fix_chunk

NESTED = b"[" * 100_000


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of three texts."""
    text = message_type("String")
    with BagWriter(tmp_path / "bag") as writer:
        for stamp in range(3):
            writer.write("/text", "std_msgs/msg/String", bytes(serialize(text("x"))), 1 + stamp, SENSOR)
    return tmp_path / "bag"


def test_png_whose_chunk_declares_a_gigabyte_is_not_decoded(tmp_path: Path) -> None:
    import numpy as np

    good = cv2.imencode(".png", np.zeros((16, 16), np.uint8))[1].tobytes()
    assert decode_image(good, cv2.IMREAD_COLOR) is not None
    bomb = good[:33] + struct.pack(">I", 0x40000000) + good[37:]
    assert decode_image(bomb, cv2.IMREAD_COLOR) is None
    assert decode_image(bomb[:41], cv2.IMREAD_COLOR) is None  # the chunk's header alone
    assert decode_image(good + b"trailing", cv2.IMREAD_COLOR) is not None
    (tmp_path / "bomb.png").write_bytes(bomb)
    assert load_image(tmp_path / "bomb.png", cv2.IMREAD_COLOR) is None


@pytest.mark.parametrize("profiles", ["\0", "- history: [", "- {}", "- lifespan: {sec: 1}", "5", "x: y"])
def test_damaged_qos_in_a_bag_costs_no_message(profiles: str) -> None:
    assert preset_of_text(profiles) == RELIABLE


def test_damaged_definition_in_a_bag_is_an_unknown_type() -> None:
    damaged = Schema("a/msg/B", "ros2msg", "MSG: std_ms's/msg/String\nstring data\n", "")
    assert with_hash(damaged).encoding == ""


def test_type_whose_full_name_is_damaged_is_unknown() -> None:
    assert schema_or_unknown("std_msgs/msc/String").encoding == ""


def test_recover_takes_messages_whose_definition_is_damaged(bag: Path, tmp_path: Path) -> None:
    file = next(bag.glob("*.mcap"))
    content = file.read_bytes().replace(b"string data", b"str'ng data")
    file.write_bytes(fix_chunk(content))  # without check sums, or the chunk would be left out
    recover(file, tmp_path / "new")
    with BagReader(tmp_path / "new") as found:
        assert found.count == 3


def test_parameter_file_that_is_no_utf8_is_an_error_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "params.yaml"
    path.write_bytes(b"node:\n  ros__parameters:\n    name: \x92\n")
    with pytest.raises(ParameterError, match=r"params\.yaml:1: cannot be read: .*utf-8"):
        load_file(path, "node")


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        ("port", "9" * 400, "port must have at most 64 bits"),
        ("silence_s", "9" * 400, "silence_s must be a finite number"),
        ("port", "0x" + "f" * 5000, "port must have at most 64 bits"),
        ("port", "1:" + "59:" * 3000 + "59", "port must be int"),  # in base 60
    ],
)
def test_parameter_with_a_huge_number_is_an_error_with_its_place(
    tmp_path: Path, key: str, value: str, why: str
) -> None:
    from instant_ic.config.params import build
    from nodes.vlp16_driver import Vlp16DriverConfig

    path = tmp_path / "params.yaml"
    path.write_text(f"node:\n  ros__parameters:\n    {key}: {value}\n")
    with pytest.raises(ParameterError, match=rf"params\.yaml:3: .*{why}") as refused:
        build(Vlp16DriverConfig, load_file(path, "node"))
    assert len(str(refused.value)) < len(str(path)) + 200


@pytest.mark.parametrize("value", ["1" * 5000, "2001-13-45", "!!timestamp x", "{[]: 1}", "[" * 3000, '!!int "_"'])
def test_manifest_with_a_value_that_is_none_is_an_error(tmp_path: Path, value: str) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(f"name: {value}\n")
    with pytest.raises(ManifestError):
        load_manifest(path)


@pytest.mark.parametrize(
    "text",
    [
        "image: " + "x" * 5000,
        'image: "a\\0b"',
        "image: m.pgm\nresolution: !!timestamp x",
        "resolution: " + "1" * 5000,
        "resolution: " + "1" * 400,
        "resolution: 0.1\noccupied_thresh: .nan",
        "image: m.pgm\norigin: [" + "1" * 400 + ", 0]",
        "[" * 3000,
    ],
)
def test_map_file_with_a_value_that_is_none_is_an_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("origin: [0, 0]\n" + ("" if "resolution" in text else "resolution: 0.05\n") + text + "\n")
    with pytest.raises(MapError):
        load_grid(path)


def test_manifest_of_a_network_with_an_endless_input_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_text(f"model: m.onnx\nname: n\nlicence: l\ninput_height: 16\ninput_width: {10**400}\n")
    with pytest.raises(ManifestError, match="input_width"):
        load_manifest(path)


def test_manifest_key_that_is_not_text_is_an_unknown_key(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text("model: m.onnx\n!!binary geometry: radial\n")
    with pytest.raises(ManifestError, match="missing key"):
        load_manifest(path)


def test_redirect_of_the_camera_is_not_even_read() -> None:
    import requests

    response = requests.Response()
    response.status_code, response.headers["Location"] = 302, "http://\xbe/"
    assert DeviceSession("", "").get_redirect_target(response) is None


def test_nested_header_of_a_console_frame_is_a_protocol_error() -> None:
    with pytest.raises(PageProtocolError, match="binary frame"):
        decode_frame(PREFIX.pack(VERSION, 1, 0, 1, len(NESTED)) + NESTED)
    good = json.dumps({"a": 1}).encode()
    assert decode_frame(PREFIX.pack(VERSION, 1, 0, 1, len(good)) + good).header == {"a": 1}


@pytest.mark.timeout(20)
def test_stamp_of_a_slam_log_with_a_huge_exponent_is_a_bad_line(tmp_path: Path) -> None:
    log = tmp_path / "log"
    line = "FLASER 3 1.0 1.5 2.0 0 0 0 0 0 0 {} host 0.1\n"
    log.write_text(line.format("0.1") + line.format("1e99999999"))
    with pytest.raises(LogError, match="log:2: FLASER: time stamp '1e99999999' is not a decimal number below"):
        list(read_log(log))
