"""Compiled lookup of image edge strength at projected points."""

import math

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def strength_under(
    points: NDArray[np.float64],
    plane: NDArray[np.int64],
    strengths: NDArray[np.float32],
    camera_from_lidar: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Sample edge images bilinearly at projected points.

    Args:
        points: (N, 3) in the LiDAR's frame.
        plane: index of the edge image of each point, (N,).
        strengths: (P, H, W + 1) equirect edge images, the first column repeated at the end.
        camera_from_lidar: (4, 4).
        out: (N,) receives the samples.
    """
    height, width = strengths.shape[1], strengths.shape[2] - 1
    m = camera_from_lidar
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        u = (math.pi - math.atan2(y, x)) * (width / (2 * math.pi)) - 0.5
        v = (math.pi / 2 - math.atan2(z, math.sqrt(x * x + y * y))) * (height / math.pi) - 0.5
        if u < 0:
            u += width
        v = min(max(v, 0.0), height - 1.001)
        c, r = min(int(u), width - 1), int(v)
        fu, fv = u - c, v - r
        s = strengths[plane[i]]
        top = s[r, c] * (1 - fu) + s[r, c + 1] * fu
        bottom = s[r + 1, c] * (1 - fu) + s[r + 1, c + 1] * fu
        out[i] = top * (1 - fv) + bottom * fv
