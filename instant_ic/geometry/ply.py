"""Point clouds as binary PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_ply(path: Path, points: NDArray[np.floating]) -> None:
    """Write a point cloud.

    Args:
        path: file to write.
        points: points in metres, (N, 3).

    Raises:
        OSError: the file cannot be written.
    """
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    path.write_bytes(("\n".join([*head, "end_header"]) + "\n").encode() + points.astype("<f4").tobytes())
