"""Overlay of LiDAR points on the panorama before and after the calibration, for visual inspection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from instant_ic.calibration.mount import CalibrationFrame
from instant_ic.depth.colour import coloured_depth
from instant_ic.depth.visibility import hidden, nearest_points
from instant_ic.geometry.poses import Matrix, transform_points


def overlay(frame: CalibrationFrame, camera_from_lidar: Matrix, width: int = 1600) -> NDArray[np.uint8]:
    """Render points, near ones bright and far ones dark, on a dimmed panorama; (width / 2, width, 3) RGB."""
    import cv2

    image = cv2.resize(frame.rgb, (width, width // 2), interpolation=cv2.INTER_AREA)
    image = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB) // 3 * 2
    points = transform_points(camera_from_lidar, np.asarray(frame.points, np.float64))
    rows, columns, range_m = nearest_points(points[~hidden(points)], width, width // 2)
    colours = coloured_depth(range_m[None], near=0.5, far=12.0)[0]
    for shift in (0, 1):
        image[np.minimum(rows + shift, width // 2 - 1), columns] = colours
    return np.asarray(image, np.uint8)


def before_and_after(
    frames: list[CalibrationFrame], before: Matrix, after: Matrix, most: int = 3, width: int = 1600
) -> NDArray[np.uint8]:
    """Render some frames, each with the overlay before and after, cropped to the rows that the LiDAR sees."""
    import cv2

    places = np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int)
    strips = []
    for number in places:
        for name, pose in (("before", before), ("after", after)):
            image = overlay(frames[number], pose, width)
            band = np.ascontiguousarray(image[round(0.25 * len(image)) : round(0.72 * len(image))])
            cv2.putText(
                band, f"{name}, image {number + 1}", (12, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2
            )
            strips.append(band)
    return np.concatenate(strips)
