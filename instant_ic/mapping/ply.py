"""Point clouds as binary PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_ply(path: Path, points: NDArray[np.floating]) -> None:
    """Write points (N, 3) in metres.

    Raises:
        OSError: the file cannot be written.
    """
    fields = "".join(f"property float {name}\n" for name in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{fields}end_header\n"
    path.write_bytes(header.encode() + np.ascontiguousarray(points, "<f4").tobytes())
