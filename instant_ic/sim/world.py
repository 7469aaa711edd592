"""A world: a triangle mesh of planar surfaces with filtered textures and baked light."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from instant_ic.geometry.raycast import RayCaster
from instant_ic.sim.contact import OccupancyMask, occupied_mask
from instant_ic.sim.textures import TextureSet, is_clamped, texture_set

FloatArray = npt.NDArray[np.floating]


@dataclass
class World:
    """Geometry, textures and light of a place, for renderer, LiDAR and contact test (metres, z up, floor at 0).

    A *surface* is a planar convex piece with one texture: a rectangle of a procedural world, or one triangle of a mesh
    file. Texture and light coordinates are affine in the hit point, so no barycentric coordinates are stored.

    Attributes:
        name: name given to ``make_world``.
        vertices: (V, 3) float32.
        faces: (F, 3) int32, counter-clockwise when viewed from the visible side.
        face_surface: (F,) int32, surface index of each face.
        normal: (S, 3) float32 unit normals.
        offset: (S,) float32, normal · p for points p on the surface.
        uv: (S, 2, 4) float32; (u, v) = uv @ (x, y, z, 1) in texture repeats, v downwards.
        texture: (S,) int32, index into ``textures``.
        tint: (S, 3) float32, factor on the texture's albedo.
        emission: (S,) float32 emitted radiance; a surface with a value above 0 ignores other light.
        light_at: (S, 3) int64: first texel, width and height in ``light``; width 0 selects ``light_linear``.
        light_uv: (S, 2, 4) float32; maps a point to light texel coordinates.
        light_linear: (S, 4) float32; light of a point on a surface without a light map (meshes from files).
        light: (L, 3) float32 baked irradiance / pi, so that albedo times light is the radiance.
        spawn: start pose (x, y, yaw) of a robot.
        zones: rectangles (x0, y0, x1, y1, height) of free space from which the world was built, if any.
    """

    name: str
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    face_surface: npt.NDArray[np.int32]
    normal: npt.NDArray[np.float32]
    offset: npt.NDArray[np.float32]
    uv: npt.NDArray[np.float32]
    texture: npt.NDArray[np.int32]
    tint: npt.NDArray[np.float32]
    emission: npt.NDArray[np.float32]
    textures: TextureSet
    light_at: npt.NDArray[np.int64]
    light_uv: npt.NDArray[np.float32]
    light_linear: npt.NDArray[np.float32]
    light: npt.NDArray[np.float32]
    spawn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    zones: list[tuple[float, float, float, float, float]] = field(default_factory=list)

    @cached_property
    def caster(self) -> RayCaster:
        """Ray caster of the mesh, created on first use."""
        return RayCaster(self.vertices, self.faces)

    @cached_property
    def texel_per_m(self) -> npt.NDArray[np.float32]:
        """Number of texels per metre of each surface's finest level (S,), the larger of u and v."""
        gradient = np.linalg.norm(self.uv[:, :, :3], axis=2)
        return np.asarray((gradient * self.textures.level_size[self.texture, 0]).max(axis=1), np.float32)

    @cached_property
    def forms(self) -> npt.NDArray[np.float32]:
        """Nine affine functions of a point for each surface, as coefficients of (x, y, z, 1), (S, 9, 4).

        0: distance from the plane; 1, 2: texture coordinates; 3, 4: coordinates in the light map, or, without a light
        map, 3: the light; 5-8: distances from the borders, positive inside.
        """
        count = len(self.normal)
        corners = self.vertices.reshape(count, -1, 3).astype(np.float64)
        sides = np.roll(corners, -1, axis=1) - corners
        inward = np.cross(self.normal[:, None], sides)
        inward /= np.maximum(np.linalg.norm(inward, axis=2, keepdims=True), 1e-12)
        depth = np.einsum("ski,ski->sk", inward, corners.mean(axis=1, keepdims=True) - corners)
        inward *= np.sign(depth)[..., None]
        forms = np.zeros((count, 9, 4), np.float32)
        forms[:, 0, :3], forms[:, 0, 3] = self.normal, -self.offset
        forms[:, 1:3] = self.uv
        forms[:, 3:5] = self.light_uv
        without_map = self.light_at[:, 1] == 0
        forms[without_map, 3] = self.light_linear[without_map]
        which = np.arange(4) % corners.shape[1]  # a triangle's first border counts twice
        forms[:, 5:, :3] = inward[:, which]
        forms[:, 5:, 3] = -np.einsum("ski,ski->sk", inward, corners)[:, which]
        return forms

    @cached_property
    def adjoining(self) -> npt.NDArray[np.int32]:
        """Surfaces (S, 4) that share a border with each rectangle, -1 for none; (S, 0) in a world of triangles."""
        corners = np.rint(self.vertices.reshape(len(self.normal), -1, 3) * 1e4).astype(np.int64)
        if corners.shape[1] != 4:
            return np.zeros((len(corners), 0), np.int32)
        owners: dict[frozenset[tuple[int, ...]], list[int]] = {}
        borders = [
            [frozenset((tuple(a), tuple(b))) for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
            for loop in corners.tolist()
        ]
        for s, loop in enumerate(borders):
            for border in loop:
                owners.setdefault(border, []).append(s)
        others = [
            [next((o for o in owners[border] if o != s), -1) for border in loop] for s, loop in enumerate(borders)
        ]
        return np.asarray(others, np.int32)

    def occupied(self, low_m: float = 0.03, high_m: float = 0.9, cell_m: float = 0.02) -> OccupancyMask:
        """Return the floor plan of the surfaces between two heights, which is cached."""
        key = (low_m, high_m, cell_m)
        if key not in self._masks:
            self._masks[key] = occupied_mask(self.vertices, self.faces, low_m, high_m, cell_m)
        return self._masks[key]

    @cached_property
    def _masks(self) -> dict[tuple[float, float, float], OccupancyMask]:
        return {}

    def sample_free_poses(self, rng: np.random.Generator, n: int, clearance_m: float = 0.35) -> npt.NDArray[np.float64]:
        """Sample random poses (n, 3), x, y, yaw, that are reachable from the spawn pose.

        Objects between 0.03 m and 1.9 m above the floor are at least ``clearance_m`` away.

        Raises:
            ValueError: no pose has this much clearance.
        """
        mask = self.occupied(0.03, 1.9, 0.05)
        cells = mask.reachable(self.spawn[:2], clearance_m)
        if len(cells) == 0:
            raise ValueError(f"world {self.name!r} has no place with {clearance_m} m of clearance")
        chosen = cells[rng.integers(0, len(cells), n)]
        xy = mask.centre(chosen) + rng.uniform(-0.5, 0.5, (n, 2)) * mask.cell_m
        return np.column_stack([xy, rng.uniform(-np.pi, np.pi, n)])


@dataclass(frozen=True)
class Material:
    """The look of a surface: procedural texture, texture size in metres (0: stretched over the surface), and tint."""

    texture: str
    size_m: float = 2.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    emission: float = 0.0


@dataclass
class _Panel:
    origin: FloatArray
    along_u: FloatArray
    along_v: FloatArray
    material: Material


class WorldBuilder:
    """A collection of rectangles from which a ``World`` is built; ``lighting.bake`` adds the light."""

    def __init__(self) -> None:
        self.panels: list[_Panel] = []

    def panel(self, origin: npt.ArrayLike, along_u: npt.ArrayLike, along_v: npt.ArrayLike, material: Material) -> None:
        """Add a rectangle. Seen from its front, ``origin`` is top left, ``along_u`` points right, ``along_v`` down."""
        self.panels.append(
            _Panel(np.asarray(origin, float), np.asarray(along_u, float), np.asarray(along_v, float), material)
        )

    def wall(
        self, start: tuple[float, float], end: tuple[float, float], low: float, high: float, material: Material
    ) -> None:
        """Add a vertical rectangle. Seen from its front, ``start`` is left and ``end`` right."""
        (x0, y0), (x1, y1) = start, end
        self.panel((x0, y0, high), (x1 - x0, y1 - y0, 0.0), (0.0, 0.0, low - high), material)

    def box(
        self,
        centre: tuple[float, float],
        size: tuple[float, float, float],
        low: float = 0.0,
        yaw: float = 0.0,
        side: Material | None = None,
        top: Material | None = None,
        front: Material | None = None,
    ) -> None:
        """Add a box that stands on z = ``low``. ``front`` is the material of the side along its own x axis."""
        side = side or Material("white")
        c, s = np.cos(yaw), np.sin(yaw)
        x = np.asarray([c, s, 0.0]) * size[0] / 2
        y = np.asarray([-s, c, 0.0]) * size[1] / 2
        z = np.asarray([0.0, 0.0, size[2]])
        base = np.asarray([centre[0], centre[1], low])
        for normal, right, material in ((x, y, front or side), (-x, -y, side), (y, -x, side), (-y, x, side)):
            self.panel(base + z + normal - right, 2 * right, -z, material)
        self.panel(base + z + x + y, -2 * y, -2 * x, top or side)
        if low > 0.01:
            self.panel(base + x - y, 2 * y, -2 * x, side)

    def build(self, name: str, light_cell_m: float, spawn: tuple[float, float, float]) -> World:
        """Build the world with light maps of about ``light_cell_m`` per texel, all set to 1."""
        panels = self.panels
        count = len(panels)
        origin = np.stack([p.origin for p in panels])
        du = np.stack([p.along_u for p in panels])
        dv = np.stack([p.along_v for p in panels])
        width = np.linalg.norm(du, axis=1)
        height = np.linalg.norm(dv, axis=1)
        unit_u, unit_v = du / width[:, None], dv / height[:, None]
        normal = np.cross(unit_v, unit_u)
        corners = np.stack([origin, origin + du, origin + du + dv, origin + dv], axis=1)
        base = 4 * np.arange(count)[:, None]
        faces = np.concatenate([base + [0, 3, 2], base + [0, 2, 1]], axis=1).reshape(-1, 3)

        names = sorted({p.material.texture for p in panels})
        textures = texture_set(list(names), [is_clamped(n) for n in names])
        index = np.asarray([names.index(p.material.texture) for p in panels], np.int32)
        uv = np.zeros((count, 2, 4))
        for i, panel in enumerate(panels):
            size = panel.material.size_m
            if size > 0:
                # The texture is anchored to the world, so that it continues across neighbouring panels of a wall.
                level = textures.level_size[index[i], 0]
                uv[i, 0, :3] = unit_u[i] / size
                uv[i, 1, :3] = unit_v[i] / (size * level[1] / level[0])
            else:
                uv[i, 0, :3] = unit_u[i] / width[i]
                uv[i, 1, :3] = unit_v[i] / height[i]
                uv[i, :, 3] = -(uv[i, :, :3] @ origin[i])

        cells = np.stack([np.maximum(2, np.ceil(s / light_cell_m).astype(int) + 1) for s in (width, height)], axis=1)
        texels = cells.prod(axis=1)
        first = np.concatenate([[0], np.cumsum(texels)[:-1]])
        light_uv = np.zeros((count, 2, 4))
        for axis, (unit, size_m) in enumerate(((unit_u, width), (unit_v, height))):
            light_uv[:, axis, :3] = unit / size_m[:, None] * (cells[:, axis, None] - 1)
            light_uv[:, axis, 3] = -np.einsum("si,si->s", light_uv[:, axis, :3], origin)
        return World(
            name=name,
            vertices=corners.reshape(-1, 3).astype(np.float32),
            faces=faces.astype(np.int32),
            face_surface=np.repeat(np.arange(count, dtype=np.int32), 2),
            normal=normal.astype(np.float32),
            offset=np.einsum("si,si->s", normal, origin).astype(np.float32),
            uv=uv.astype(np.float32),
            texture=index,
            tint=np.asarray([p.material.tint for p in panels], np.float32),
            emission=np.asarray([p.material.emission for p in panels], np.float32),
            textures=textures,
            light_at=np.column_stack([first, cells]).astype(np.int64),
            light_uv=light_uv.astype(np.float32),
            light_linear=np.zeros((count, 4), np.float32),
            light=np.ones((int(texels.sum()), 3), np.float32),
            spawn=spawn,
        )
