"""CPU time to decode a VLP-16 capture, including reading the file, compared with velodyne_decoder (C++).

Both read the same file in the same process, alternating, so that neither benefits from a warmer machine. Prints one
JSON object:

    python benchmarks/lidar.py [capture.pcap] [--runs 15]
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import velodyne_decoder as vd

from instant_ic.lidar.config import DecoderConfig
from instant_ic.lidar.recording import Recording

RECORDING = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "vlp16" / "einride_recording.pcap"


def ours(path: Path) -> tuple[int, int]:
    """(revolutions, points) with our decoder."""
    revolutions = list(Recording(path, DecoderConfig(min_range=0.1)))
    return len(revolutions), sum(len(revolution.points) for revolution in revolutions)


def theirs(path: Path) -> tuple[int, int]:
    """(scans, points) with velodyne_decoder and the same packed point layout."""
    config = vd.Config(model=vd.Model.VLP16)
    config.max_range = 130.0
    scans = list(vd.read_pcap(str(path), config, as_pcl_structs=True))
    return len(scans), sum(len(scan.points) for scan in scans)


def cpu_ms(decode: Callable[[Path], tuple[int, int]], path: Path) -> float:
    """CPU milliseconds to decode the whole file once."""
    start = time.process_time()
    decode(path)
    return (time.process_time() - start) * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path, nargs="?", default=RECORDING)
    parser.add_argument("--runs", type=int, default=15)
    args = parser.parse_args()
    if not args.capture.exists():
        parser.error(f"{args.capture} is not there; give a VLP-16 capture")

    (_, our_points), (_, their_points) = ours(args.capture), theirs(args.capture)  # also compiles and warms up
    firings = sum(len(revolution.firing_time) for revolution in Recording(args.capture))
    revolutions = firings * 55.296e-6 / 0.1  # of 100 ms, so that both are divided by the same number
    samples: dict[str, list[float]] = {"ours": [], "velodyne_decoder": []}
    for _ in range(args.runs):
        samples["ours"].append(cpu_ms(ours, args.capture) / revolutions)
        samples["velodyne_decoder"].append(cpu_ms(theirs, args.capture) / revolutions)
    medians = {name: statistics.median(values) for name, values in samples.items()}
    print(
        json.dumps(
            {
                "capture": args.capture.name,
                "revolutions": round(revolutions, 2),
                "points": {"ours": our_points, "velodyne_decoder": their_points},
                "cpu_ms_per_revolution": {name: round(value, 3) for name, value in medians.items()},
                "fastest": {name: round(min(values), 3) for name, values in samples.items()},
                "ratio": round(medians["ours"] / medians["velodyne_decoder"], 3),
            }
        )
    )


if __name__ == "__main__":
    main()
