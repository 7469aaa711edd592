"""Speed of writing and reading bags, compared with rosbags' and foxglove-sdk's writers.

    python benchmarks/bags.py [--seconds 3] [--folder /tmp] [--json result.json]

Prints JSON. ``write``: messages of each size in one bag, MB/s of payload into the page cache, with and without zstd.
``read``: the same bag with our reader.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from reporting import parser_of, report

SIZES = {"20 kB": 20_000, "200 kB": 200_000, "1.2 MB": 1_200_000, "5.5 MB": 5_500_000}
IMAGE = "sensor_msgs/msg/Image"


def picture(size: int) -> bytes:
    """Serialized image of about this size that compresses like a raw photo: smooth, with noise."""
    from instant_ic.msg import image_message, serialize

    height = max(1, int((size / 6) ** 0.5))
    width = max(1, size // (3 * height))
    rng = np.random.default_rng(0)
    ramp = np.linspace(0, 200, width)[None, :, None] + np.linspace(0, 40, height)[:, None, None]
    pixels = (ramp + rng.integers(0, 6, (height, width, 3))).astype(np.uint8)
    return bytes(serialize(image_message(pixels, "rgb8", "camera", 1)))


def ours(folder: Path, payload: bytes, count: int, compressed: bool) -> None:
    """Write with our writer."""
    from instant_ic.bag import BagWriter

    with BagWriter(folder, compressed) as writer:
        for index in range(count):
            writer.write("/image", IMAGE, payload, 1_000_000_000 + index)


def rosbags(folder: Path, payload: bytes, count: int, compressed: bool) -> None:
    """Write with the `rosbags` package."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    from instant_ic.msg import typestore

    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if compressed:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/image", IMAGE, typestore=typestore())
        for index in range(count):
            writer.write(connection, 1_000_000_000 + index, payload)


def foxglove(folder: Path, payload: bytes, count: int, compressed: bool) -> None:
    """Write with foxglove-sdk (Rust)."""
    import foxglove

    from instant_ic.bag.metadata import own_schema

    folder.mkdir()
    kind = foxglove.mcap.MCAPCompression.Zstd if compressed else None
    options = foxglove.mcap.MCAPWriteOptions(compression=kind, profile="ros2")
    with foxglove.open_mcap(str(folder / "file.mcap"), writer_options=options):
        schema = foxglove.Schema(name=IMAGE, encoding="ros2msg", data=own_schema(IMAGE).text.encode())
        channel = foxglove.Channel(f"/image{folder.name}", schema=schema, message_encoding="cdr")
        for index in range(count):
            channel.log(payload, log_time=1_000_000_000 + index)


def megabytes_a_second(
    function: Callable[[Path, bytes, int, bool], None], root: Path, payload: bytes, compressed: bool, seconds: float
) -> tuple[float, float]:
    """MB/s of payload, best of three runs, and the size of the bag relative to it."""
    count, best, share = max(3, int(2e8 * seconds / 3 / len(payload))), 0.0, 1.0
    for _ in range(3):
        folder = root / f"bag{time.monotonic_ns()}"
        began_s = time.perf_counter()
        function(folder, payload, count, compressed)
        best = max(best, count * len(payload) / (time.perf_counter() - began_s) / 1e6)
        share = sum(file.stat().st_size for file in folder.glob("*.mcap")) / (count * len(payload))
        shutil.rmtree(folder)
    return round(best, 1), round(share, 3)


def read_speed(root: Path, payload: bytes, seconds: float) -> dict[str, float]:
    """MB/s of our reader, plain and compressed."""
    from instant_ic.bag import BagReader

    found = {}
    for compressed in (False, True):
        folder = root / f"read{compressed}"
        count = max(3, int(2e8 * seconds / 3 / len(payload)))
        ours(folder, payload, count, compressed)
        began_s = time.perf_counter()
        with BagReader(folder) as reader:
            got = sum(len(message.payload) for message in reader.messages())
        found["zstd" if compressed else "plain"] = round(got / (time.perf_counter() - began_s) / 1e6, 1)
        shutil.rmtree(folder)
    return found


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=3.0, help="about 200 MB a second of each measurement")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="where the bags go")
    args = parser.parse_args()
    root = Path(tempfile.mkdtemp(dir=args.folder))
    writers: dict[str, Callable[[Path, bytes, int, bool], None]] = {"instant_ic": ours, "rosbags": rosbags}
    try:
        import foxglove as _found  # noqa: F401

        writers["foxglove-sdk"] = foxglove
    except ImportError:
        pass
    result: dict[str, Any] = {"write_MB_per_s": {}, "read_MB_per_s": {}, "zstd_size": {}}
    try:
        for name, size in SIZES.items():
            payload = picture(size)
            result["write_MB_per_s"][name] = {}
            for writer, function in writers.items():
                for compressed in (False, True):
                    key = f"{writer}{', zstd' if compressed else ''}"
                    speed, share = megabytes_a_second(function, root, payload, compressed, args.seconds)
                    result["write_MB_per_s"][name][key] = speed
                    if compressed:
                        result["zstd_size"].setdefault(name, {})[writer] = share
            result["read_MB_per_s"][name] = read_speed(root, payload, args.seconds)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    report(result, args.json)


if __name__ == "__main__":
    main()
