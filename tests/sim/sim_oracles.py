"""Ranges in an empty box worked out by hand (slab method), which the tests hold ray casting against."""

import numpy as np
import numpy.typing as npt

LOW = np.asarray([-3.0, -2.0, 0.0])
HIGH = np.asarray([3.0, 2.0, 3.0])


def box_range(origin: npt.ArrayLike, directions: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Distance from a point inside the box to its walls along unit vectors (..., 3)."""
    o, d = np.asarray(origin, float), np.asarray(directions, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_wall = np.where(d > 0, (HIGH - o) / d, np.where(d < 0, (LOW - o) / d, np.inf))
    return np.asarray(to_wall.min(axis=-1))
