"""Files and messages that declare more than a machine holds are refused before they are decoded."""

from __future__ import annotations

import gzip
import json
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.depth.files import DepthFileError, load_depth, load_rgb
from instant_ic.experiments.slam_logs import LogError, read_log
from instant_ic.geometry.mesh_file import MeshError, load_mesh
from instant_ic.slam.map_files import MapError, load_grid
from instant_ic.util.jpeg import JpegError
from instant_ic.util.limits import MOST_ARRAY_BYTES, check_arrays, decode_image, decode_rgb, load_image
from instant_ic.vspace.saved import SpaceFileError, read


def png(width: int, height: int, bits: int = 8) -> bytes:
    """A PNG that declares a size; its rows are zeros, of which only a few are there."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    )


def jpeg(width: int, height: int) -> bytes:
    data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = data.index(b"\xff\xc0")
    return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


@pytest.mark.parametrize("data", [png(40_000, 40_000), jpeg(65_535, 65_535), b"", b"\x89PNG\r\n\x1a\n", b"BM" * 100])
def test_image_of_a_message_is_refused_by_its_declared_size(data: bytes) -> None:
    assert decode_image(data, cv2.IMREAD_COLOR) is None
    with pytest.raises(JpegError, match="at most"):
        decode_rgb(data, 64, 32)


def test_image_file_is_refused_by_its_declared_size(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(40_000, 40_000, 16))
    assert load_image(path, cv2.IMREAD_UNCHANGED) is None
    with pytest.raises(DepthFileError):
        load_depth(path)
    with pytest.raises(DepthFileError):
        load_rgb(path)
    (tmp_path / "map.yaml").write_text("image: bomb.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(MapError):
        load_grid(tmp_path / "map.yaml")
    (tmp_path / "map.pgm").write_bytes(b"P5\n60000 60000\n255\n" + bytes(100))
    assert load_image(tmp_path / "map.pgm", cv2.IMREAD_GRAYSCALE) is None


def test_opencv_knows_the_limit_from_the_first_import_on() -> None:
    code = "import instant_ic, os; print(os.environ['OPENCV_IO_MAX_IMAGE_PIXELS'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == str(160 << 20)


def bomb_npz(path: Path) -> Path:
    """An archive that declares 5 GB of arrays; nothing of it is read."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("depth.npy", b"x")
    content = bytearray(path.read_bytes())
    at = content.rindex(b"PK\x01\x02")
    content[at + 24 : at + 28] = struct.pack("<I", 0xFFFFFFFE)
    second = bytes(content)
    # Twice the same entry: together above the limit, each within what the format can say.
    directory = second[at : second.rindex(b"PK\x05\x06")]
    end = bytearray(second[second.rindex(b"PK\x05\x06") :])
    end[8:12] = struct.pack("<HH", 2, 2)
    end[12:16] = struct.pack("<I", 2 * len(directory))
    path.write_bytes(second[:at] + 2 * directory + bytes(end))
    return path


def test_arrays_are_refused_by_what_they_unpack_to(tmp_path: Path) -> None:
    path = bomb_npz(tmp_path / "depth.npz")
    with pytest.raises(ValueError, match=f"at most {MOST_ARRAY_BYTES >> 20} MB"):
        check_arrays(path)
    with pytest.raises(DepthFileError, match="at most"):
        load_depth(path)
    with pytest.raises(SpaceFileError, match="at most"):
        read(bomb_npz(tmp_path / "saved.npz"))


def test_log_with_an_endless_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.gz"
    with gzip.open(path, "wb") as file:
        for _ in range(64):
            file.write(b"1" * (1 << 20))
    with pytest.raises(LogError, match="characters"):
        list(read_log(path))


@pytest.mark.parametrize(
    "accessor",
    [
        {"componentType": 5126, "count": 1_000_000_000, "type": "VEC3"},
        {"bufferView": 0, "componentType": 5126, "count": 1_000_000_000, "type": "VEC3"},
    ],
)
def test_mesh_with_arrays_that_are_not_in_the_file_is_refused(tmp_path: Path, accessor: dict[str, object]) -> None:
    body = json.dumps(
        {
            "asset": {"version": "2.0"},
            "accessors": [accessor],
            "bufferViews": [{"buffer": 0, "byteLength": 4}],
            "buffers": [{"byteLength": 4}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
        }
    ).encode()
    body += b" " * (-len(body) % 4)
    content = struct.pack("<II", len(body), 0x4E4F534A) + body + struct.pack("<II", 4, 0x4E4942) + bytes(4)
    path = tmp_path / "bomb.glb"
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(content)) + content)
    with pytest.raises(MeshError, match="not in its buffers"):
        load_mesh(path)


def test_mesh_that_stands_at_many_nodes_is_counted_before_it_is_copied(tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.Scene()
    box = trimesh.creation.box()
    scene.add_geometry(box, geom_name="box")
    for number in range(200):
        scene.graph.update(frame_to=f"n{number}", geometry="box", matrix=np.eye(4))
    path = tmp_path / "many.glb"
    path.write_bytes(scene.export(file_type="glb"))
    with pytest.raises(MeshError, match="at least 1008 triangles"):
        load_mesh(path, max_triangles=1000)
