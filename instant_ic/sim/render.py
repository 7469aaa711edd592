"""Renders anti-aliased panoramas and perspective images of a world, with depth."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from instant_ic.sim import kernels
from instant_ic.sim.textures import linear_to_srgb
from instant_ic.sim.world import World

FloatArray = npt.NDArray[np.floating]

#: Sample positions in edge pixels (rows, columns, pixels from the centre): rotated grid, one sample per row and column.
_SUBPIXELS = ((-0.375, -0.125), (-0.125, 0.375), (0.125, -0.375), (0.375, 0.125))

#: Share of a pixel over which a texture is averaged; below 1 because trilinear lookup also blurs. Compared with 16
#: samples per pixel in the corridor, 0.65 gives 41-44 dB, 1.0 gives 38-40 dB, 0.5 gives 39-43 dB and starts to alias.
_FOOTPRINT = 0.65


@dataclass(frozen=True)
class Frame:
    """Image with depth.

    Attributes:
        rgb: (H, W, 3) uint8 sRGB.
        depth_m: (H, W) float32 radial distance, metres; 0 where nothing is hit.
    """

    rgb: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]


@lru_cache(maxsize=1)
def _tone_table() -> npt.NDArray[np.uint8]:
    """Tone table from radiance to sRGB: linear up to 0.6, then a soft shoulder, so that lamps turn white gradually."""
    radiance = np.linspace(0.0, kernels.TONE_MAX, kernels.TONE_SIZE)
    knee = 0.6
    shoulder = knee + (1 - knee) * (1 - np.exp(-(radiance - knee) / (1 - knee)))
    return np.rint(linear_to_srgb(np.where(radiance < knee, radiance, shoulder)) * 255).astype(np.uint8)


def _equirect_rays(rows: FloatArray, columns: FloatArray, width: int, height: int) -> npt.NDArray[np.float32]:
    """Unit vectors (N, 3) at pixel indices: centre column along x, columns clockwise, rows from +90° down."""
    azimuth = math.pi - (columns + 0.5) * (2 * math.pi / width)
    elevation = math.pi / 2 - (rows + 0.5) * (math.pi / height)
    cosine = np.cos(elevation)
    rays = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return np.ascontiguousarray(rays, np.float32)


def _perspective_rays(
    rows: FloatArray, columns: FloatArray, width: int, height: int, hfov_rad: float
) -> npt.NDArray[np.float32]:
    focal = 0.5 * width / math.tan(0.5 * hfov_rad)
    rays = np.stack(
        [np.full(np.shape(columns), focal), 0.5 * (width - 1) - columns, 0.5 * (height - 1) - rows], axis=-1
    )
    return np.ascontiguousarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True), np.float32)


@dataclass(frozen=True)
class _Lens:
    """Projection of an image: width, height, and horizontal field of view (None: equirect)."""

    width: int
    height: int
    hfov_rad: float | None = None

    def rays(self, rows: FloatArray, columns: FloatArray) -> npt.NDArray[np.float32]:
        if self.hfov_rad is None:
            return _equirect_rays(rows, columns, self.width, self.height)
        return _perspective_rays(rows, columns, self.width, self.height, self.hfov_rad)

    @property
    def pixel_rad(self) -> float:
        if self.hfov_rad is None:
            return math.pi / self.height
        return 2 * math.tan(0.5 * self.hfov_rad) / self.width


@lru_cache(maxsize=8)
def _strides(lens: _Lens) -> npt.NDArray[np.int32]:
    """Number of columns per shaded pixel in each row; columns lie close together near the poles of a panorama.

    A stride covers at most the width of a pixel on the horizon.
    """
    if lens.hfov_rad is not None:
        return np.ones(lens.height, np.int32)
    elevation = (np.arange(lens.height) + 0.5) / lens.height * math.pi - math.pi / 2
    most = np.minimum(1 / np.cos(elevation), 16)
    return np.asarray(2 ** np.floor(np.log2(most)), np.int32)


@lru_cache(maxsize=8)
def _all_rays(lens: _Lens) -> npt.NDArray[np.float32]:
    rows, columns = np.mgrid[0 : lens.height, 0 : lens.width].reshape(2, -1).astype(np.float64)
    return lens.rays(rows, columns)


class EquirectRenderer:
    """Renders a world from any pose.

    Rays are cast for every fourth pixel in each direction and wherever neighbours show different surfaces. In between,
    the range follows from the surface's plane. Pixels on edges are cast and shaded at four points. Near the poles of a
    panorama only every second, fourth... pixel of a row is shaded, and the colours in between are interpolated.
    Only one thread at a time may use a renderer.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self._caster = world.caster

    def render(self, map_from_camera: FloatArray, width: int, height: int, supersample: int = 1) -> Frame:
        """Render an equirect panorama: centre column along x, rows from +90° to −90°.

        Args:
            map_from_camera: (4, 4) pose of the camera (x forward, y left, z up).
            width, height: pixels; usually 2:1.
            supersample: render at this multiple of the size and area-average; depth is taken at the centre instead.
        """
        return self._picture(np.asarray(map_from_camera), _Lens(width, height), supersample)

    def render_perspective(
        self, map_from_camera: FloatArray, width: int, height: int, hfov_rad: float, supersample: int = 1
    ) -> Frame:
        """Render a perspective image along the camera's x with square pixels; depth is radial too."""
        if not 0 < hfov_rad < math.pi:
            raise ValueError(f"hfov_rad must be between 0 and pi (got {hfov_rad})")
        return self._picture(np.asarray(map_from_camera), _Lens(width, height, hfov_rad), supersample)

    def cast(
        self, origins: FloatArray, directions: FloatArray
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Ranges (N,) in metres (inf = no hit) and faces (N,) (-1 = no hit) of rays in the world's frame."""
        return self._caster.cast(origins, directions)

    def _picture(self, map_from_camera: FloatArray, lens: _Lens, supersample: int) -> Frame:
        if supersample < 1:
            raise ValueError(f"supersample must be at least 1 (got {supersample})")
        if supersample == 1:
            radiance, depth = self._radiance(map_from_camera, lens)
        else:
            n = supersample
            fine, fine_depth = self._radiance(map_from_camera, _Lens(lens.width * n, lens.height * n, lens.hfov_rad))
            # Averaged as radiance and clipped at white like a sensor, so that lamps keep smooth borders.
            radiance = np.ascontiguousarray(
                np.minimum(fine, 1.5).reshape(lens.height, n, lens.width, n, 3).mean(axis=(1, 3)), np.float32
            )
            depth = np.ascontiguousarray(fine_depth[n // 2 :: n, n // 2 :: n])
        rgb = np.empty((lens.height, lens.width, 3), np.uint8)
        kernels.tone(radiance.reshape(-1, 3), _tone_table(), rgb.reshape(-1, 3))
        return Frame(rgb, depth)

    def _radiance(
        self, map_from_camera: FloatArray, lens: _Lens
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Radiance (H, W, 3) with anti-aliased edges, and radial depth (H, W)."""
        height, width = lens.height, lens.width
        rotation = np.ascontiguousarray(map_from_camera[:3, :3], np.float32)
        origin = np.ascontiguousarray(map_from_camera[:3, 3], np.float32)
        directions = np.empty((height * width, 3), np.float32)
        kernels.rotate(_all_rays(lens), rotation, directions)
        surface, range_m = self._visible(directions, origin, lens)
        radiance = np.empty((height * width, 3), np.float32)
        footprint = _FOOTPRINT * lens.pixel_rad
        strides = _strides(lens)

        listed = np.empty(height * width, np.int32)
        world = self.world
        count = kernels.edges(surface, range_m, world.normal, world.texture, lens.hfov_rad is None, listed)
        count = kernels.anchored(listed[:count], strides, width)
        edge = np.zeros((height, width), np.uint8)
        edge.reshape(-1)[listed[:count]] = 1
        plain = np.empty(height * width, np.int32)
        plain = plain[: kernels.plain_pixels(strides, edge, plain)]
        self._shade(surface.ravel(), range_m.ravel(), directions, origin, footprint, plain, radiance)
        if count:
            at = listed[:count]
            rows, columns = np.divmod(at, width)
            points = [lens.rays(rows + dr, columns + dc * strides[rows]) for dr, dc in _SUBPIXELS]
            sub = np.concatenate(points)
            rays = np.empty_like(sub)
            kernels.rotate(sub, rotation, rays)
            sub_range, sub_surface = self._caster.cast(origin, rays)
            kernels.surfaces_of(sub_surface, world.face_surface)
            colour = np.empty((len(rays), 3), np.float32)
            every = np.arange(len(rays), dtype=np.int32)
            self._shade(sub_surface, sub_range, rays, origin, 0.6 * footprint, every, colour)
            radiance[at] = np.minimum(colour, 1.5).reshape(len(_SUBPIXELS), count, 3).mean(axis=0)
        picture = radiance.reshape(height, width, 3)
        kernels.fill_rows(picture, strides)
        depth = np.where(surface >= 0, range_m, 0.0).astype(np.float32)
        return picture, depth

    def _visible(
        self, directions: npt.NDArray[np.float32], origin: npt.NDArray[np.float32], lens: _Lens
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """Surface (H, W), -1 = no hit, and range (H, W) of every pixel."""
        height, width = lens.height, lens.width
        world = self.world
        surface = np.full((height, width), -1, np.int32)
        range_m = np.zeros((height, width), np.float32)
        wraps = lens.hfov_rad is None
        coarse = 4
        listed = (np.arange(0, height, coarse)[:, None] * width + np.arange(0, width, coarse)[None, :]).ravel()
        step = coarse
        todo = np.empty(height * width, np.int32)
        while True:
            r, face = self._caster.cast(origin, directions[listed])
            kernels.surfaces_of(face, world.face_surface)
            surface.reshape(-1)[listed] = face
            range_m.reshape(-1)[listed] = r
            if step == 1:
                break
            step //= 2
            count = kernels.refine(surface, range_m, directions, origin, world.normal, world.offset, step, wraps, todo)
            listed = todo[:count].astype(np.int64)
            if count == 0 and step == 1:
                break
        return surface, range_m

    def _shade(
        self,
        surface: npt.NDArray[np.int32],
        range_m: npt.NDArray[np.float32],
        directions: npt.NDArray[np.float32],
        origin: npt.NDArray[np.float32],
        footprint_rad: float,
        listed: npt.NDArray[np.int32],
        out: npt.NDArray[np.float32],
    ) -> None:
        w, t = self.world, self.world.textures
        kernels.shade(
            surface, range_m, directions, origin, footprint_rad, w.normal, w.uv, w.texture, w.tint, w.emission,
            w.texel_per_m, t.texels, t.level_offset, t.level_size, t.levels, t.clamp, w.light_at, w.light_uv,
            w.light_linear, w.light, listed, out,
        )  # fmt: skip
