"""Point clouds and meshes as binary PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_ply(
    path: Path,
    points: NDArray[np.floating],
    rgb: NDArray[np.uint8] | None = None,
    triangles: NDArray[np.int32] | None = None,
) -> None:
    """Write points (N, 3) in metres, with their colours (N, 3) and triangles (M, 3) where they are given.

    Raises:
        OSError: the file cannot be written.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    fields = [("xyz", "<f4", 3)]
    if rgb is not None:
        lines += [f"property uchar {colour}" for colour in ("red", "green", "blue")]
        fields.append(("rgb", "u1", 3))
    vertices = np.empty(len(points), fields)
    vertices["xyz"] = points
    if rgb is not None:
        vertices["rgb"] = rgb
    content = vertices.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), [("count", "u1"), ("vertices", "<i4", 3)])
        faces["count"], faces["vertices"] = 3, triangles
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        content += faces.tobytes()
    path.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + content)
