"""Renderer of anti-aliased panoramas and perspective images of a world, with depth."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from instant_ic.geometry.colour import linear_to_srgb
from instant_ic.sim import kernels
from instant_ic.sim.world import World

FloatArray = npt.NDArray[np.floating]

#: Width, in pixels, over which a texture is averaged, for pixels inside a surface and for samples of edge pixels.
#: It is below 1 because the bilinear lookup blurs too.
_FOOTPRINT = 0.65
_EDGE_FOOTPRINT = 0.45


_Tables = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32]]


@dataclass(frozen=True)
class RenderedFrame:
    """An image with depth.

    Attributes:
        rgb: (H, W, 3) uint8 sRGB.
        depth_m: (H, W) float32 radial distance, metres; 0 where nothing is hit.
    """

    rgb: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]


@lru_cache(maxsize=1)
def _tone_table() -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32]]:
    """Return the table from square roots of radiance to sRGB, and the mean radiance of each sRGB value (256,).

    The curve is linear up to 0.6, then bends softly, so that lamps turn white gradually.
    """
    radiance = ((np.arange(kernels.TONE_SIZE) + 0.5) * (kernels.TONE_ROOT / (kernels.TONE_SIZE - 1))) ** 2
    knee = 0.6
    shoulder = knee + (1 - knee) * (1 - np.exp(-(radiance - knee) / (1 - knee)))
    table = np.rint(linear_to_srgb(np.where(radiance < knee, radiance, shoulder)) * 255).astype(np.uint8)
    count = np.bincount(table, minlength=256)
    mean = np.bincount(table, weights=radiance, minlength=256) / np.maximum(count, 1)
    return table, np.asarray(mean, np.float32)


@dataclass(frozen=True)
class _Lens:
    """Projection of an image: width, height, and horizontal field of view (None: equirect).

    The direction of a pixel is ``scale[row] * across[:, column] + down[:, row]``; in a perspective image it must be
    normalised. The tables begin one row and one column before the image and end one after it.
    """

    width: int
    height: int
    hfov_rad: float | None = None

    @property
    def pixel_rad(self) -> float:
        if self.hfov_rad is None:
            return math.pi / self.height
        return 2 * math.tan(0.5 * self.hfov_rad) / self.width

    def tables(self, rotation: FloatArray) -> _Tables:
        """Return ``across`` (3, W + 2), ``down`` (3, H + 2) and ``scale`` (H + 2,) for a camera's rotation (3, 3)."""
        columns, rows = np.arange(-1, self.width + 1), np.arange(-1, self.height + 1)
        if self.hfov_rad is None:
            azimuth = math.pi - (columns + 0.5) * (2 * math.pi / self.width)
            elevation = math.pi / 2 - (rows + 0.5) * (math.pi / self.height)
            across = rotation[:, :2] @ np.stack([np.cos(azimuth), np.sin(azimuth)])
            down, scale = rotation[:, 2:] * np.sin(elevation), np.cos(elevation)
        else:
            focal = 0.5 * self.width / math.tan(0.5 * self.hfov_rad)
            across = focal * rotation[:, :1] + rotation[:, 1:2] * (0.5 * (self.width - 1) - columns)
            down, scale = rotation[:, 2:] * (0.5 * (self.height - 1) - rows), np.ones(len(rows))
        return across.astype(np.float32), down.astype(np.float32), scale.astype(np.float32)


@lru_cache(maxsize=8)
def _strides(lens: _Lens) -> npt.NDArray[np.int32]:
    """Return the number of columns per shaded pixel in each row (H,).

    It grows towards the poles of a panorama, where columns lie close together: a stride covers at most the width of a
    pixel on the horizon.
    """
    if lens.hfov_rad is not None:
        return np.ones(lens.height, np.int32)
    elevation = (np.arange(lens.height) + 0.5) / lens.height * math.pi - math.pi / 2
    most = np.minimum(1 / np.cos(elevation), 16)
    return np.asarray(2 ** np.floor(np.log2(most)), np.int32)


class EquirectRenderer:
    """A renderer of a world from any pose.

    Rays are cast for every fourth pixel in each direction, and for every second one where neighbours show different
    surfaces; the pixels in between show one of the surfaces around them. The coverage of a pixel on an edge is sampled
    at eight points. Near the poles of a panorama, only every second or fourth (and so on) pixel of a row is shaded, and
    the colours in between are interpolated. The world's light is read when the renderer is made.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self._caster = world.caster
        textures = world.textures
        per_lookup = (kernels.TONE_SIZE - 1) / kernels.TONE_ROOT / (255 * 256)
        tint_root = per_lookup * np.sqrt(world.tint)
        owner = np.repeat(np.arange(len(world.light_at)), world.light_at[:, 1] * world.light_at[:, 2])
        light = np.sqrt(world.light) * tint_root[owner] if len(owner) else np.ones((1, 3))
        looks = np.column_stack([world.texel_per_m, tint_root, np.sqrt(world.emission)])
        owns = np.column_stack(
            [world.texture, textures.levels[world.texture] - 1, textures.clamp[world.texture], world.light_at]
        )
        levels = np.concatenate([textures.level_offset[..., None], textures.level_size], axis=2)
        #: The fields of ``kernels.Scene`` after ``forms``.
        self._scene = (
            np.asarray(looks, np.float32), owns.astype(np.int64), levels.astype(np.int64), textures.texels,
            np.asarray(light, np.float32),
        )  # fmt: skip

    def render(self, map_from_camera: FloatArray, width: int, height: int, supersample: int = 1) -> RenderedFrame:
        """Render an equirect panorama: centre column along x, rows from +90° to −90°.

        Args:
            map_from_camera: pose of the camera (x forward, y left, z up), (4, 4).
            width: columns of the image.
            height: rows of the image; usually half the columns.
            supersample: factor by which the rendered image is larger before it is area-averaged; depth is taken at the
                pixel's centre.
        """
        return self._image(np.asarray(map_from_camera), _Lens(width, height), supersample)

    def render_perspective(
        self, map_from_camera: FloatArray, width: int, height: int, hfov_rad: float, supersample: int = 1
    ) -> RenderedFrame:
        """Render a perspective image along the camera's x axis, with square pixels and radial depth."""
        if not 0 < hfov_rad < math.pi:
            raise ValueError(f"hfov_rad must be between 0 and pi (got {hfov_rad})")
        return self._image(np.asarray(map_from_camera), _Lens(width, height, hfov_rad), supersample)

    def cast(
        self, origins: FloatArray, directions: FloatArray
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Return the ranges (N,) in metres (inf = no hit) and faces (N,) (-1 = no hit) of rays in the world's frame."""
        return self._caster.cast(origins, directions)

    def _image(self, map_from_camera: FloatArray, lens: _Lens, supersample: int) -> RenderedFrame:
        if supersample < 1:
            raise ValueError(f"supersample must be at least 1 (got {supersample})")
        if supersample == 1:
            return self._frame(map_from_camera, lens)
        n = supersample
        fine = self._frame(map_from_camera, _Lens(lens.width * n, lens.height * n, lens.hfov_rad))
        # Pixels are averaged as radiance, clipped at white as by a sensor, so that lamps have smooth edges.
        table, radiance = _tone_table()
        parts = np.minimum(radiance, 1.5)[fine.rgb].reshape(lens.height, n, lens.width, n, 3)
        index = np.sqrt(parts.mean(axis=(1, 3))) * ((kernels.TONE_SIZE - 1) / kernels.TONE_ROOT)
        return RenderedFrame(
            table[index.astype(np.int32)], np.ascontiguousarray(fine.depth_m[n // 2 :: n, n // 2 :: n])
        )

    def _frame(self, map_from_camera: FloatArray, lens: _Lens) -> RenderedFrame:
        world = self.world
        tables = lens.tables(map_from_camera[:3, :3])
        origin = np.asarray(map_from_camera[:3, 3], np.float32)
        forms = world.forms.copy()
        forms[:, :, 3] += forms[:, :, :3] @ origin
        surface = self._visible(tables, origin, forms, lens)
        rgb = np.empty((lens.height, lens.width, 3), np.uint8)
        depth = np.empty((lens.height, lens.width), np.float32)
        kernels.ranges(surface, *tables, forms, depth)
        projection = kernels.Projection(*tables, _strides(lens), lens.hfov_rad is None)
        footprint, edge_footprint = (np.float32(part * lens.pixel_rad) for part in (_FOOTPRINT, _EDGE_FOOTPRINT))
        kernels.compose(
            surface, projection, world.adjoining, footprint, edge_footprint, kernels.Scene(forms, *self._scene),
            _tone_table()[0], rgb,
        )  # fmt: skip
        return RenderedFrame(rgb, depth)

    def _visible(
        self,
        tables: _Tables,
        origin: npt.NDArray[np.float32],
        forms: npt.NDArray[np.float32],
        lens: _Lens,
    ) -> npt.NDArray[np.int32]:
        """Return the surface (H, W) of every pixel; SKY where nothing is hit."""
        width = lens.width
        surface = np.full((lens.height, width), kernels.UNKNOWN, np.int32)
        todo = np.empty(surface.size, np.int64)
        for step, whole in ((4, True), (2, True), (1, False), (1, True)):
            count = kernels.unknown(surface, step, whole, todo)
            rays = np.empty((count, 3), np.float32)
            kernels.rays(todo[:count], width, *tables, rays)
            _, face = self._caster.cast(origin, rays)
            kernels.place(surface, todo[:count], face, self.world.face_surface)
            if step > 1:
                kernels.fill_cells(surface, step, lens.hfov_rad is None)
            elif not whole:
                kernels.fill_guessed(surface, *tables, forms)
        return surface
