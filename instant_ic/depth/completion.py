"""Input of depth completion, made of the fused depth that the network corrects."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import rays_of

Floats = NDArray[np.floating]
PRIOR_CHANNELS = 6
_AGREE, _AGREE_M = 0.02, 0.02
"""Largest difference of a trusted point from the depth built of all points: share of the depth, and metres."""
_MOST_M = 40.0


def prior_channels(
    depth_m: Floats, sigma: Floats, ranges_m: Floats, up: Floats, camera_height_m: float | None, network_m: Floats
) -> NDArray[np.float32]:
    """Build the channels (6, H, W) that a completion network receives besides the image.

    Args:
        depth_m: fused radial depth in metres, (H, W); 0 is unknown.
        sigma: relative standard deviation of ``depth_m``, (H, W).
        ranges_m: range of the confirmed point in each pixel in metres, (H, W); 0 if there is no point.
        up: up direction (against gravity) in the camera's frame, (3,).
        camera_height_m: height of the camera over the floor; None if unknown.
        network_m: depth of the network that uses only the image, scaled and corrected by points, (H, W); 0 is unknown.

    Returns:
        ``depth``; ``sigma`` (0 where unknown); ``measured``: 1 at trusted points, where the output equals the input;
        ``rise``: sine of the pixel's elevation; ``floor``: distance of a level floor, 0 above the horizon; ``network``.
    """
    depth = np.where((depth_m > 0) & (depth_m < _MOST_M), depth_m, 0).astype(np.float32)
    rise = rays_of(depth.shape) @ np.asarray(up, np.float32)
    floor = np.zeros_like(depth)
    if camera_height_m is not None:
        below = rise < -camera_height_m / _MOST_M
        floor[below] = -camera_height_m / rise[below]
    agree = np.abs(depth - ranges_m) <= _AGREE_M + _AGREE * ranges_m
    measured = (ranges_m > 0) & (depth > 0) & agree
    known_sigma = np.where((depth > 0) & np.isfinite(sigma), sigma, 0)
    network = np.where((network_m > 0) & (network_m < _MOST_M), network_m, 0)
    return np.stack((depth, known_sigma, measured, rise, floor, network)).astype(np.float32)
