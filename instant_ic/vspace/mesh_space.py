"""Conventional illusory control, which renders a place that was scanned beforehand (paper, section II).

``MeshSpace`` has the methods of ``VirtualSpace``, but it is not trained and READY at once. A keyframe is only compared
with the mesh, to adjust the mesh's colours and to warn if the mesh lies in the wrong place.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.image_quality import psnr_of_mse
from instant_ic.geometry.mesh_file import MeshError, load_mesh
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.raycast import RayCaster
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.prior import KeyframeError, area_average, check_panorama, check_pose
from instant_ic.vspace.readiness import UNSEEN_GAIN, Texture
from instant_ic.vspace.space import SpaceState, SpaceStatus, VirtualSpace
from instant_ic.vspace.texel_pyramids import TexelPyramids, texel_density
from instant_ic.vspace.view import RayRenderer, View, continue_unseen, equirect_rays, to_8bit

EDGE_RATIO = 0.03
"""Relative difference of neighbouring depths above which there is an edge; its pixels are rendered with four rays."""
_SUBPIXELS = ((-0.375, -0.125), (-0.125, 0.375), (0.125, -0.375), (0.375, 0.125))
_PROBE_WIDTH = 256
"""Width in pixels of the panoramas in which mesh and camera are compared."""
_MIN_SAMPLES = 200
_MAX_GAIN = 3.0
_NEAR, _LEAST_NEAR = 0.25, 0.7
"""Largest relative difference of two depths that agree, and smallest share of agreeing depths in a mesh well placed.
With small_house.glb and depth 10 % off, a mesh in its place had 0.98 or more; 1 m aside or turned by 20°, 0.43 to 0.80.
"""
_ASIDE = math.sin(math.radians(22.5))
"""Sine of the elevation up to which depths are compared, because floor and ceiling agree wherever the mesh lies."""


class MeshSpace(RayRenderer):
    """A mesh in the map, rendered by ray casting; not thread-safe.

    Raises:
        MeshError: the file cannot be used; the message says why.

    Example:
        >>> space = MeshSpace(VirtualSpaceConfig(source="mesh", mesh="house.glb"))  # doctest: +SKIP
        >>> space.render(map_from_camera, 320, 180, fov_rad=1.57).rgb
    """

    keyframe = None
    """Keyframe of the views, which a mesh does not have."""
    dissolving = False

    def __init__(self, config: VirtualSpaceConfig) -> None:
        self.config = config
        self._mesh = load_mesh(config.mesh, config.mesh_max_triangles)
        self._pyramids, self._texel_per_m = TexelPyramids.build(self._mesh.images), texel_density(self._mesh)
        x, y, z, yaw_deg = config.mesh_pose
        self._map_from_mesh = pose_matrix(x, y, z, yaw=math.radians(yaw_deg))
        triangles = self._mesh.triangles
        try:
            corners = np.arange(3 * len(triangles), dtype=np.int32).reshape(-1, 3)
            self._caster = RayCaster(triangles.reshape(-1, 3), corners)
        except ImportError as error:
            raise MeshError("a mesh as the virtual space needs the package embreex: pip install embreex") from error
        self._gain = np.ones(3, np.float32)
        self._mse = math.nan
        self._variance = 0.0
        self._warning = ""
        self.render(np.eye(4), 32, 16, 1.0)  # compile the kernels now, not at the operator's first view

    def set_keyframe(
        self,
        rgb: NDArray[np.uint8],
        depth_m: NDArray[np.floating],
        map_from_camera: NDArray[np.floating],
        relative_sigma: float | NDArray[np.floating],
    ) -> None:
        """Compare the mesh with a panorama; with ``mesh_fit_colours``, fit one factor per colour channel.

        Args: as ``prior.prepare``; ``relative_sigma`` is not used.

        Raises:
            KeyframeError: the panorama or the pose is invalid. The space does not change.
        """
        check_panorama(rgb)
        check_pose(map_from_camera)
        depth_m, pose = np.asarray(depth_m, np.float32), np.asarray(map_from_camera, np.float64)
        if depth_m.ndim != 2 or min(depth_m.shape) < 2:
            raise KeyframeError(f"depth must be (h, 2 h) (got {depth_m.shape})")
        width = min(_PROBE_WIDTH, rgb.shape[1])
        theirs: Floats = area_average(rgb, width // 2, width).astype(np.float32).reshape(-1, 3) / np.float32(255)
        rays = equirect_rays(pose, width)
        colour, range_m, _ = self._render_rays(rays)
        ours = colour / self._gain
        met = range_m > 0
        if self.config.mesh_fit_colours:
            self._fit_colours(theirs[met], ours[met])
        weight = np.sqrt(np.clip(1 - rays.directions[:, 2] ** 2, 0, 1))  # solid angle of a panorama's pixels
        if met.any():
            squared = np.mean((np.clip(ours[met] * self._gain, 0, 1) - theirs[met]) ** 2, axis=1)
            self._mse = float(np.average(squared, weights=weight[met]))
        else:
            self._mse = math.nan
        self._variance = Texture.of(rgb).variance
        aside = np.abs(rays.directions @ pose[:3, 2].astype(np.float32)) < _ASIDE
        self._check_place(depth_m, range_m, aside, width)

    def _fit_colours(self, theirs: Floats, ours: Floats) -> None:
        """Fit the factors of the mesh's colours by medians. Later keyframes change them by half of the difference."""
        usable = np.all((theirs > 0.05) & (theirs < 0.95) & (ours > 0.05) & (ours < 0.95), axis=1)
        if np.count_nonzero(usable) < _MIN_SAMPLES:
            return
        fit = np.clip(np.median(theirs[usable] / ours[usable], axis=0), 1 / _MAX_GAIN, _MAX_GAIN).astype(np.float32)
        self._gain = fit if math.isnan(self._mse) else np.sqrt(self._gain * fit)

    def _check_place(self, depth_m: Floats, range_m: Floats, aside: NDArray[np.bool_], width: int) -> None:
        """Warn if the keyframe's depth shows that the mesh lies elsewhere."""
        height = width // 2
        rows = (np.arange(height) + 0.5) * (depth_m.shape[0] / height)
        columns = (np.arange(width) + 0.5) * (depth_m.shape[1] / width)
        depth = depth_m[rows.astype(int)][:, columns.astype(int)].reshape(-1)
        known = aside & np.isfinite(depth) & (depth > 0)
        self._warning = ""
        if known.any():
            ratio = range_m[known] / depth[known]  # 0 if the ray hits nothing
            agrees = float(np.mean((ratio > 1 - _NEAR) & (ratio < 1 / (1 - _NEAR))))
            if agrees < _LEAST_NEAR:
                self._warning = (
                    f"only {agrees:.0%} of the mesh agrees with the depth measured at the newest keyframe;"
                    " check space.mesh_pose"
                )

    def train(self, budget_ms: float = math.inf, iterations: int | None = None) -> None:
        """Do nothing, because a mesh is not trained."""

    @property
    def status(self) -> SpaceStatus:
        """The status, READY at once; ``psnr_db`` compares mesh and newest keyframe and is NaN before the first."""
        corners = self._mesh.triangles.reshape(-1, 3)
        return SpaceStatus(
            state=SpaceState.READY,
            psnr_db=psnr_of_mse(self._mse),
            ready_radius_m=float(np.linalg.norm(np.ptp(corners, axis=0))),  # diagonal of the mesh's bounding box
            converged=True,
            source="mesh",
            device="cpu (embree)",
            warning=self._warning,
        )

    def _view(self, rays: Rays, projection: str) -> View:
        height, width = rays.shape
        colour, range_m, confidence = self._render_rays(rays)
        depth, confidence = range_m.reshape(height, width), confidence.reshape(height, width)
        image = continue_unseen(colour.reshape(height, width, 3), depth, confidence, wraps=projection == "equirect")
        unseen = float(np.mean(confidence == 0))
        mse = (1 - unseen) * self._mse + UNSEEN_GAIN * unseen * self._variance
        return View(to_8bit(image), depth, confidence, projection, psnr_of_mse(mse))

    def _render_rays(self, rays: Rays) -> tuple[Floats, Floats, Floats]:
        """Render rays; return colours (P, 3), 0 to 1, range (P,), 0 if a ray hits nothing, and confidence (P,)."""
        height, width = rays.shape
        turn = self._map_from_mesh[:3, :3].astype(np.float32)
        origin = ((rays.origin - self._map_from_mesh[:3, 3]) @ self._map_from_mesh[:3, :3]).astype(np.float32)
        directions = np.einsum("pj,ji->pi", rays.directions, turn)
        grid = directions.reshape(height, width, 3)
        across, down = (np.gradient(grid, axis=axis) for axis in (1, 0))
        if width > 2 * height - 1:  # a panorama: the first column's left neighbour is the last column
            across[:, 0] = across[:, 1]
            across[:, -1] = across[:, -2]
        pixel_rad = float(np.linalg.norm(down[height // 2, width // 2]))
        colour, range_m, face = self._cast(origin, directions, pixel_rad)
        edges = np.flatnonzero(self._fine(range_m.reshape(height, width), face, pixel_rad))
        if edges.size:
            total = np.zeros((edges.size, 3), np.float32)
            hits = np.zeros(edges.size, np.float32)
            for row, column in _SUBPIXELS:
                beside = directions[edges] + column * across.reshape(-1, 3)[edges] + row * down.reshape(-1, 3)[edges]
                beside /= np.linalg.norm(beside, axis=1, keepdims=True)
                some, _, met = self._cast(origin, beside, 0.6 * pixel_rad)
                total += some
                hits += met >= 0
            seen = edges[(hits > 0) & (face[edges] >= 0)]
            colour[seen] = (total / np.maximum(hits, 1)[:, None])[(hits > 0) & (face[edges] >= 0)]
        colour *= self._gain
        np.clip(colour, 0, 1, out=colour)
        return colour, range_m, (face >= 0).astype(np.float32)

    def _cast(self, origin: Floats, directions: Floats, pixel_rad: float) -> tuple[Floats, Floats, NDArray[np.int32]]:
        from instant_ic.vspace.mesh_kernels import shade

        mesh, pyramids = self._mesh, self._pyramids
        range_m, face = self._caster.cast(origin, directions)
        colour = np.empty((len(face), 3), np.float32)
        shade(
            mesh.triangles, mesh.corner_uv, mesh.corner_rgb, mesh.texture, self._texel_per_m, pyramids.texels,
            pyramids.start, pyramids.sizes, pyramids.levels, origin, directions, range_m, face, pixel_rad, colour,
        )  # fmt: skip
        return colour, np.where(face >= 0, range_m, 0).astype(np.float32), face

    def _fine(self, range_m: Floats, face: NDArray[np.int32], pixel_rad: float) -> NDArray[np.bool_]:
        """Mark pixels (P,) that need several rays: at depth edges, and where triangles are finer than a pixel."""
        edge = np.zeros(range_m.shape, bool)
        for axis in (0, 1):
            a, b = (range_m[1:], range_m[:-1]) if axis == 0 else (range_m[:, 1:], range_m[:, :-1])
            jump = np.abs(a - b) > EDGE_RATIO * np.minimum(a, b)
            for half in (np.s_[1:], np.s_[:-1]):
                edge[(half, np.s_[:]) if axis == 0 else (np.s_[:], half)] |= jump
        fine = edge.reshape(-1)
        density = self._texel_per_m[face]
        fine |= (self._mesh.texture[face] < 0) & (density * range_m.reshape(-1) * pixel_rad > 1)
        return fine & (face >= 0)


Space: TypeAlias = VirtualSpace | MeshSpace


def make_space(config: VirtualSpaceConfig | None = None, robot: NDArray[np.bool_] | None = None) -> Space:
    """Create the space for ``config.source``.

    Args:
        config: parameters of the space.
        robot: mask of the robot, see ``VirtualSpace``.

    Raises:
        MeshError: ``source`` is ``mesh``, and its file cannot be used.
        DeviceError: the requested device is absent or does not work.
    """
    config = config or VirtualSpaceConfig()
    return MeshSpace(config) if config.source == "mesh" else VirtualSpace(config, robot)
