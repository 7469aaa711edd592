"""Speed of writing and reading bags, compared with rosbags' writer, and the cost of recording.

    python benchmarks/bags.py [--seconds 3] [--folder /tmp] [--out result.json]

Prints JSON. ``write``: messages of each size in one bag, MB/s of payload into the page cache, with and without zstd.
``read``: the same bag with our reader. ``record``: a publisher process sends 5.5 MB images at 30 Hz (and 20 kB messages
at 200 Hz) to the recorder node in its own process; reported are the recorder's CPU in % of one core and lost messages.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

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


_PUBLISH = """
import sys, time
from pathlib import Path
sys.path.insert(0, {root!r})
from instant_ic.bus.qos import SENSOR
from instant_ic.bus.local_transport import LocalTransport
from benchmarks.bags import picture
transport = LocalTransport(Path({run!r}), "camera", time.time_ns)
out = transport.advertise("/image", "sensor_msgs/msg/Image", SENSOR)
payload = picture({size})
while out.subscriber_count == 0:
    time.sleep(0.02)
due = time.monotonic()
for _ in range({count}):
    due += 1 / {hz}
    time.sleep(max(0, due - time.monotonic()))
    out.send(payload)
time.sleep(1.0)
transport.close()
"""


def recording(root: Path, size: int, hz: float, seconds: float, words: list[str]) -> dict[str, Any]:
    """CPU and lost messages of a recorder while a publisher sends."""
    from instant_ic.bag import BagReader

    run, bag = Path(tempfile.mkdtemp(prefix="ic-")), root / f"record{time.monotonic_ns()}"
    environment = {**os.environ, "INSTANT_IC_RUN_DIR": str(run)}
    count = int(hz * seconds)
    code = _PUBLISH.format(root=str(Path(__file__).resolve().parents[1]), run=str(run), size=size, count=count, hz=hz)
    ic = [sys.executable, "-m", "instant_ic.cli.main", "bag", "record", "-o", str(bag), "/image", *words]
    recorder = subprocess.Popen(ic, env=environment, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        # The publisher starts after the recorder has subscribed, so that the recorder's start-up is not counted.
        publisher = subprocess.Popen([sys.executable, "-c", code], env=environment)
        while not (bag / f"{bag.name}.mcap").exists():
            time.sleep(0.05)
        time.sleep(2.0)
        process = psutil.Process(recorder.pid)
        before, began_s = process.cpu_times(), time.monotonic()
        publisher.wait(seconds * 3 + 60)
        after, took_s = process.cpu_times(), time.monotonic() - began_s
        recorder.terminate()
        recorder.wait(60)
        with BagReader(bag) as reader:
            lost = json.loads(reader.custom.get("instant_ic.lost", "{}"))
            overflow = json.loads(reader.custom.get("instant_ic.overflow", "{}"))
            got = reader.count
    finally:
        recorder.kill()
        recorder.wait(10)
        shutil.rmtree(run, ignore_errors=True)
        shutil.rmtree(bag, ignore_errors=True)
    cpu = (after.user + after.system - before.user - before.system) / took_s * 100
    return {
        "MB/s": round(size * hz / 1e6, 1),
        "cpu_percent": round(cpu, 1),
        "sent": count,
        "recorded": got,
        "lost": sum(lost.values()) + sum(overflow.values()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="about 200 MB a second of each measurement")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="where the bags go")
    parser.add_argument("--out", type=Path, default=None)
    args = parser.parse_args()
    root = Path(tempfile.mkdtemp(dir=args.folder))
    writers: dict[str, Callable[[Path, bytes, int, bool], None]] = {"instant_ic": ours, "rosbags": rosbags}
    try:
        import foxglove as _found  # noqa: F401

        writers["foxglove-sdk"] = foxglove
    except ImportError:
        pass
    result: dict[str, Any] = {"write_MB_per_s": {}, "read_MB_per_s": {}, "zstd_size": {}, "record": {}}
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
        for name, size, hz in (("5.5 MB, 30 Hz", 5_500_000, 30.0), ("20 kB, 200 Hz", 20_000, 200.0)):
            for words in ([], ["--compression"]):
                key = f"{name}{', zstd' if words else ''}"
                result["record"][key] = recording(root, size, hz, 2 * args.seconds, words)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    text = json.dumps(result, indent=2)
    print(text)
    if args.out is not None:
        args.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
