"""A keyframe prepared for training: panorama, depth prior with its edges, pose, uncertainty (paper, IV.A-B).

``prepare`` takes these steps:

1. Check panorama, pose, depth and uncertainty (``check_panorama``, ``check_pose``, ``_checked_depth``,
   ``_checked_sigma``), and mark sky (``sky_region``) and the robot itself (``robot_region``).
2. ``fill_holes``: fill unknown depth by a pyramid of weighted means (pull-push, Gortler et al., 1996).
3. ``_cut_tops``: cut assumed tops of objects at the upper edge that the image shows.
4. ``edge_quads``: mark the quads that cross a depth edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_pixels, nearest_pixels
from instant_ic.util.limits import load_image
from instant_ic.vspace.config import GeometryConfig

MOST_SIGMA = 0.5
"""Relative standard deviation above which depth counts as filled; views of it have less confidence."""
MOST_COORDINATE_M = 100_000.0
"""Distance from the map's origin above which float32 cannot represent centimetres."""
DEPTH_EDGE_RATIO = 0.10
"""Relative difference of neighbouring depths above which there is an edge, unless they lie on one plane."""

ROBOT, SKY, MOVED, ROOM = range(4)
"""Content of a pixel, numbered as in VspaceLayer.msg: the robot itself, sky, an object that has moved, or the room."""


@dataclass(frozen=True)
class PriorConfig:
    """Tuning of the preparation of keyframes.

    Attributes:
        top_rad: largest height of an object's assumed top in the image (``fill_kernels.cut_tops``).
        top_step: smallest ratio of the distances above and on such a top.
        top_sigma: smallest relative standard deviation at which a top counts as assumed.
        top_contrast: smallest difference in grey levels between an object and the surface above it.
        thing_share: share of the object's colour above which a mixed pixel belongs to the object.
        band_sigmas: truncation distance in standard deviations of the depth.
        band: smallest and largest truncation distance, relative to the depth.
        depth_m: smallest and largest depth, to which other depths are clipped.
        least_known: smallest share of known depth at which a keyframe is accepted.
        sky_rise: smallest mean sine of the elevation of an unknown region that is sky.
        abrupt: smallest share of an edge in the change over five pixels; a smaller step is a slope with noise.
        large: relative difference above which a step is an edge even if its neighbours change as much.
    """

    top_rad: float = 0.15
    top_step: float = 1.3
    top_sigma: float = 0.05
    top_contrast: float = 30.0
    thing_share: float = 0.15
    band_sigmas: float = 2.0
    band: tuple[float, float] = (0.05, 0.06)
    depth_m: tuple[float, float] = (0.2, 30.0)
    least_known: float = 0.5
    sky_rise: float = 0.17
    abrupt: float = 0.75
    large: float = 0.3


CONFIG = PriorConfig()


class KeyframeError(ValueError):
    """The keyframe cannot be used; the message says why."""


@dataclass(frozen=True)
class PanoramaPrior:
    """A keyframe, prepared for training and rendering.

    Attributes:
        rgb: panorama, (H, W, 3) uint8.
        inverse_depth: 1/m along the ray, (h, w) float32, h = w/2, holes filled.
        known: 1 where the depth was measured or estimated and its sigma is below ``MOST_SIGMA``, (h, w) uint8.
        depth_edge: 1 where the quad between pixel (v, u) and (v + 1, u + 1) crosses a depth edge, (h, w) uint8.
        map_from_camera: pose of the camera, (4, 4).
        relative_sigma: median of ``sigma`` over the image.
        sigma: standard deviation of each pixel's depth, relative to the depth, (h, w) float32; ``MOST_SIGMA`` where the
            depth was filled.
        content: ``ROOM``, ``ROBOT``, ``SKY`` or ``MOVED``, (h, w) uint8; only ``ROOM`` has surfaces.
    """

    rgb: NDArray[np.uint8]
    inverse_depth: NDArray[np.float32]
    known: NDArray[np.uint8]
    depth_edge: NDArray[np.uint8]
    map_from_camera: NDArray[np.float64]
    relative_sigma: float
    sigma: NDArray[np.float32]
    content: NDArray[np.uint8]

    @property
    def band(self) -> float:
        """Truncation distance, relative to the depth: the field learns the signed distance up to it."""
        return float(np.clip(CONFIG.band_sigmas * self.relative_sigma, *CONFIG.band))

    @property
    def usable(self) -> NDArray[np.uint8]:
        """Pixels at which training may sample rays, (h, w); 1 or 0."""
        return (self.content == ROOM).astype(np.uint8)

    def in_camera(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Transform points (N, 3) of the map to the camera's frame."""
        pose = self.map_from_camera.astype(np.float32)
        return np.asarray(np.einsum("ij,jk->ik", points - pose[:3, 3], pose[:3, :3]))

    def sees(self, local: NDArray[np.float32], distance: NDArray[np.float32], share: float) -> NDArray[np.bool_]:
        """Return which points the keyframe sees: those near a surface of known depth, away from depth edges.

        Args:
            local: points in the camera's frame, (N, 3).
            distance: distance of each point, (N,).
            share: largest distance from the surface, as a share of ``distance``.
        """
        height, width = self.inverse_depth.shape
        u, v = equirect_pixels(local, width, height)
        at = np.clip(np.floor(v), 0, height - 1).astype(np.intp), np.floor(u).astype(np.intp) % width
        known = (self.known[at] == 1) & (self.depth_edge[at] == 0) & (self.content[at] == ROOM)
        return np.asarray(known & (np.abs(self.inverse_depth[at] * distance - 1) < share))

    def colours(self, local: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the panorama's nearest colours, 0 to 255, (N, 3), for points (N, 3) in the camera's frame."""
        height, width = self.rgb.shape[:2]
        return self.rgb[nearest_pixels(local, width, height)].astype(np.float32)

    def without(self, moved: NDArray[np.bool_]) -> PanoramaPrior:
        """Return the keyframe without the pixels in the mask ``moved`` (h, w), which replaces an earlier mask."""
        content = np.where(self.content == MOVED, ROOM, self.content)
        content[moved & (content == ROOM)] = MOVED
        return self if np.array_equal(content, self.content) else replace(self, content=content.astype(np.uint8))

    @property
    def median_depth_m(self) -> float:
        """Median of the depth within 60° of the horizon, in metres."""
        rows = self.inverse_depth.shape[0]
        return float(1.0 / np.median(self.inverse_depth[rows // 6 : rows - rows // 6]))


def prepare(
    rgb: NDArray[np.uint8],
    depth_m: NDArray[np.floating],
    map_from_camera: NDArray[np.floating],
    relative_sigma: float | NDArray[np.floating],
    config: GeometryConfig,
    panorama_width: int,
    robot: NDArray[np.bool_] | None = None,
) -> PanoramaPrior:
    """Check a keyframe and build its prior.

    Args:
        rgb: equirect panorama (H, W, 3) uint8, W = 2 H.
        depth_m: radial depth in metres, (h, w), w = 2 h; 0 is unknown. Its size may differ from the panorama's.
        map_from_camera: pose of the camera in the map, (4, 4).
        relative_sigma: standard deviation of the depth, relative to the depth: one number, or (h, w) with a value per
            pixel of the depth, which is not finite where the depth is unknown.
        config: geometry parameters.
        panorama_width: a wider panorama is area-averaged to this width.
        robot: mask of any size, (H, 2 H), True where the panorama shows the robot itself or its stand; pixels below
            ``config.body_below_deg`` are added.

    Raises:
        KeyframeError: wrong shape or type, values that are not finite, too little known depth, or an invalid pose.
    """
    check_panorama(rgb)
    check_pose(map_from_camera)
    depth, content = _checked_depth(depth_m, config, robot)
    sigma, each = _checked_sigma(relative_sigma, depth_m, depth)
    rgb = shrunk(rgb, panorama_width)
    sky = content == SKY
    known: NDArray[np.bool_] = depth > 0
    with np.errstate(divide="ignore"):
        inverse = np.where(known, 1.0 / np.clip(depth, *CONFIG.depth_m), 0.0)
    inverse = np.ascontiguousarray(fill_holes(inverse.astype(np.float32), known & ~sky))
    inverse[sky] = 1 / CONFIG.depth_m[1]
    if np.ndim(relative_sigma):
        _cut_tops(inverse, each, rgb, content == ROOM)
    known |= sky
    return PanoramaPrior(
        rgb=np.array(rgb, order="C"),  # copied: the caller may reuse its array, and numba recompiles for read-only ones
        inverse_depth=inverse,
        known=(known & ((each <= MOST_SIGMA) | sky) & (content != ROBOT)).astype(np.uint8),
        depth_edge=edge_quads(inverse, DEPTH_EDGE_RATIO),
        map_from_camera=np.array(map_from_camera, np.float64),
        relative_sigma=sigma,
        sigma=np.where(known, np.minimum(each, np.float32(MOST_SIGMA)), np.float32(MOST_SIGMA)),
        content=content,
    )


def _cut_tops(
    inverse: NDArray[np.float32], sigma: NDArray[np.float32], rgb: NDArray[np.uint8], room: NDArray[np.bool_]
) -> None:
    """Cut assumed tops of objects at the upper edge that the image shows, in place."""
    from instant_ic.vspace.fill_kernels import cut_tops

    height, width = inverse.shape
    colours = area_average(rgb, height, width).astype(np.float32)
    reach = max(2, round(CONFIG.top_rad / np.pi * height))
    tuning = (CONFIG.top_step, CONFIG.top_sigma, CONFIG.top_contrast, CONFIG.thing_share)
    cut_tops(inverse, sigma, colours, room, reach, *(np.float32(value) for value in tuning))


def check_panorama(rgb: NDArray[np.uint8]) -> None:
    """Raise KeyframeError unless an image is a panorama, (H, 2 H, 3) uint8, of more than one colour."""
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise KeyframeError(f"panorama must be (H, W, 3) uint8 (got {rgb.shape} {rgb.dtype})")
    height, width = rgb.shape[:2]
    if width != 2 * height or width < 32:
        raise KeyframeError(f"panorama must be twice as wide as high, 32 pixels or more (got {width} x {height})")
    if int(rgb.max()) - int(rgb.min()) < 2:
        raise KeyframeError("panorama has one colour only: covered lens or black image")


def check_pose(map_from_camera: NDArray[np.floating]) -> None:
    """Raise KeyframeError unless a matrix is a pose within ``MOST_COORDINATE_M`` of the map's origin."""
    pose = np.asarray(map_from_camera, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise KeyframeError(f"pose must be a finite 4x4 matrix (got shape {pose.shape})")
    far = float(np.abs(pose[:3, 3]).max())
    if far > MOST_COORDINATE_M:
        raise KeyframeError(f"pose lies {far:.3g} m from the map's origin (at most {MOST_COORDINATE_M:.0f} m)")
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise KeyframeError("pose contains no rotation matrix")


def _checked_depth(
    depth_m: NDArray[np.floating], config: GeometryConfig, robot: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the depth (h, w), reduced to at most 1024 columns, and the content of its pixels (h, w)."""
    if depth_m.ndim != 2 or depth_m.shape[1] != 2 * depth_m.shape[0] or depth_m.shape[1] < 32:
        raise KeyframeError(f"depth must be (H, 2 H), 32 columns or more (got {depth_m.shape})")
    bad = int(np.count_nonzero(~np.isfinite(depth_m)))
    if bad:
        raise KeyframeError(f"depth has {bad} values that are not finite; unknown depth must be 0")
    if float(depth_m.min()) < 0:
        raise KeyframeError(f"depth is negative (smallest {float(depth_m.min()):.3f} m)")
    # Pixels smaller than 0.35° do not improve the geometry, and the cost of edges and occupancy grows with the pixels.
    step = max(1, depth_m.shape[1] // 1024)
    rows = depth_m.shape[0] // step
    depth = np.minimum(depth_m[::step, ::step][:rows, : 2 * rows], CONFIG.depth_m[1]).astype(np.float32, order="C")
    content = np.full(depth.shape, ROOM, np.uint8)
    content[sky_region(depth == 0, config.sky_share)] = SKY
    content[robot_region(depth.shape[0], config.body_below_deg, robot)] = ROBOT
    share = float(np.count_nonzero(depth)) / max(1, int(np.count_nonzero(content != SKY)))
    if share < CONFIG.least_known:
        raise KeyframeError(f"depth is known in {share:.0%} of the image; {CONFIG.least_known:.0%} are needed")
    return depth, content


def robot_region(height: int, below_deg: float, robot: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return the pixels at which a panorama of ``height`` rows shows the robot itself, (h, 2 h).

    Raises:
        KeyframeError: the mask ``robot`` is not twice as wide as high.
    """
    elevation = 90 - (np.arange(height) + 0.5) * (180 / height)
    region = np.repeat((elevation < below_deg)[:, None], 2 * height, axis=1)
    if robot is None:
        return region
    if robot.ndim != 2 or robot.shape[1] != 2 * robot.shape[0] or robot.shape[0] < 1:
        raise KeyframeError(f"the robot's mask must be twice as wide as high (got {robot.shape})")
    rows = ((np.arange(height) + 0.5) * (robot.shape[0] / height)).astype(int)
    columns = ((np.arange(2 * height) + 0.5) * (robot.shape[1] / (2 * height))).astype(int)
    return np.asarray(region | (robot[rows][:, columns] > 0))


def sky_region(unknown: NDArray[np.bool_], least_share: float) -> NDArray[np.bool_]:
    """Return the regions of unknown depth that are sky, (h, w): high up, and at least ``least_share`` of the sphere.

    Unknown regions in a room are usually small. If they are not, ``least_share`` 1 lets them be filled from around.
    """
    height, width = unknown.shape
    area = np.cos(np.pi / 2 - (np.arange(height) + 0.5) * (np.pi / height)) * (np.pi / (2 * height * width))
    sky = np.zeros(unknown.shape, bool)
    if least_share >= 1 or float(unknown.sum(axis=1) @ area) < least_share:
        return sky
    from scipy.ndimage import find_objects, label

    labels, count = label(unknown)
    for row in range(height):  # a region may extend across the seam
        first, last = labels[row, 0], labels[row, -1]
        if first and last and first != last:
            labels[labels == last] = first
    rise = np.sin(np.pi / 2 - (np.arange(height) + 0.5) * (np.pi / height))
    for number, place in enumerate(find_objects(labels, count), 1):
        if place is None:
            continue
        part = labels[place] == number
        share = part.sum(axis=1) * area[place[0]]
        if share.sum() >= least_share and share @ rise[place[0]] > CONFIG.sky_rise * share.sum():
            sky[place] |= part
    return sky


def shrunk(rgb: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Area-average a panorama (H, 2 H, 3) to ``width`` if it is wider."""
    return rgb if rgb.shape[1] <= width else area_average(rgb, width // 2, width)


def _checked_sigma(
    relative_sigma: float | NDArray[np.floating], depth_m: NDArray[np.floating], depth: NDArray[np.float32]
) -> tuple[float, NDArray[np.float32]]:
    """Return the median uncertainty and that of each pixel, (h, w); inf where it is unknown."""
    sigma = np.asarray(relative_sigma, np.float32)
    if sigma.ndim == 0:
        if not np.isfinite(sigma) or sigma < 0:
            raise KeyframeError(f"relative_sigma must be finite and not negative (got {relative_sigma})")
        return float(relative_sigma), np.full(depth.shape, min(float(relative_sigma), MOST_SIGMA), np.float32)
    if sigma.shape != depth_m.shape:
        raise KeyframeError(f"relative_sigma must be a number or as large as depth {depth_m.shape} (got {sigma.shape})")
    step = max(1, depth_m.shape[1] // 1024)
    sigma = sigma[::step, ::step][: depth.shape[0], : depth.shape[1]]
    known = (depth > 0) & np.isfinite(sigma)
    if not known.any() or float(sigma[known].min()) < 0:
        raise KeyframeError("relative_sigma must have finite values, none of them negative")
    return float(np.median(sigma[known])), np.where(known, sigma, np.float32(np.inf))


def area_average(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Scale an image (H, W, C) to (height, width, C) by averaging over the area of each target pixel."""
    import cv2

    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8).reshape(
        height, width, -1
    )


def fill_holes(
    values: NDArray[np.float32], valid: NDArray[np.bool_], weight: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Fill invalid pixels from their surroundings by a pyramid of weighted means (pull, then push).

    Args:
        values: image, (H, W) or (H, W, C).
        valid: mask of the valid pixels, (H, W). If there are none, the result is zero.
        weight: positive weights of the valid pixels, (H, W); None weights all equally.
    """
    from instant_ic.vspace.fill_kernels import fill

    if valid.all():
        return values
    channels = values if values.ndim == 3 else values[..., None]
    w = valid.astype(np.float32) if weight is None else np.where(valid, weight, 0).astype(np.float32)
    filled = fill(channels, w)
    return filled if values.ndim == 3 else filled[..., 0]


def edge_quads(inverse_depth: NDArray[np.float32], ratio: float) -> NDArray[np.uint8]:
    """Mark with 1 each quad (v, u)-(v + 1, u + 1) across a depth edge; columns wrap, and the last row has no quads.

    There is an edge between two neighbours if their depths differ by more than ``ratio`` and extrapolating the inverse
    depth from neither side reaches the other. Inverse depth is linear along a plane, even one seen at a flat angle. On
    such a plane noise is as large as the change per pixel, so the step must also be most of the change around it.
    """
    inverse = inverse_depth.astype(np.float32)
    width = inverse.shape[1]
    columns = np.pad(inverse, ((0, 0), (2, 3)), "wrap")
    rows = np.pad(inverse, ((2, 3), (0, 0)), "edge")
    across = _edge_pairs([columns[:, k : k + width] for k in range(6)], ratio)
    down = _edge_pairs([rows[k : k + len(inverse)] for k in range(6)], ratio)
    depth_edge = across | np.concatenate([across[1:], across[-1:]]) | down | np.roll(down, -1, 1)
    return depth_edge.astype(np.uint8)


def _edge_pairs(line: list[NDArray[np.float32]], ratio: float) -> NDArray[np.bool_]:
    """Return whether there is an edge between the third and the fourth of six neighbouring pixels."""
    first, before, a, b, after, last = line
    jump, nearest = np.abs(a - b), np.minimum(a, b)
    limit = 0.5 * jump
    off = (np.abs(2 * a - before - b) > limit) & (np.abs(2 * b - after - a) > limit)
    abrupt = (jump > CONFIG.abrupt * np.abs(last - first)) | (jump > CONFIG.large * nearest)
    return (jump > ratio * nearest) & off & abrupt


def load_robot_mask(path: str | Path) -> NDArray[np.bool_]:
    """Load the mask of the robot in its panoramas.

    Args:
        path: image file, bright where panoramas show the robot.

    Returns:
        The mask, (H, 2 H).

    Raises:
        ValueError: the file is not an image, or the image is not twice as wide as high.
    """
    image = load_image(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"robot_mask {path}: no such file, or it cannot be decoded as an image")
    if image.shape[1] != 2 * image.shape[0]:
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"robot_mask {path}: must be twice as wide as high, like the panorama (got {size})")
    return np.asarray(image > 127)
