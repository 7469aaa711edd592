"""Baked light: lamps and windows with soft shadows, one bounce, and ambient occlusion."""

import math

import numba
import numpy as np
import numpy.typing as npt

from instant_ic.sim import kernels
from instant_ic.sim.kept import kept
from instant_ic.sim.world import World

F32 = npt.NDArray[np.float32]

#: Largest size of an emitter piece; emitters are split for soft shadows.
_PIECE_M = 0.7
#: Ambient light in place of further bounces, as a share of the light on a lamp-lit wall.
_AMBIENT = 0.34
#: Median light of vertical surfaces after baking, which sets the exposure.
_LEVEL = 0.72
#: Number of rays per corner of a mesh file's triangle.
_MESH_RAYS = 24
#: Largest distance at which an object darkens the ambient light.
_AMBIENT_REACH_M = 1.6


def _texel_points(world: World) -> tuple[F32, npt.NDArray[np.int32]]:
    """Return the centres (L, 3) of all light texels, inset by 15 mm from the border, and their surfaces (L,)."""
    points: list[F32] = []
    owner: list[npt.NDArray[np.int32]] = []
    corners = world.vertices.reshape(-1, 4, 3).astype(np.float64)
    for s, (_, width, height) in enumerate(world.light_at):
        origin = corners[s, 0]
        du, dv = corners[s, 1] - origin, corners[s, 3] - origin
        edge_u = min(0.015 / float(np.linalg.norm(du)), 0.25)
        edge_v = min(0.015 / float(np.linalg.norm(dv)), 0.25)
        a = np.clip(np.linspace(0, 1, width), edge_u, 1 - edge_u)[None, :, None]
        b = np.clip(np.linspace(0, 1, height), edge_v, 1 - edge_v)[:, None, None]
        points.append((origin + a * du + b * dv).reshape(-1, 3).astype(np.float32))
        owner.append(np.full(int(width * height), s, np.int32))
    return np.concatenate(points), np.concatenate(owner)


def _emitter_pieces(world: World) -> tuple[F32, F32, F32]:
    """Return the points (E, 3), normals (E, 3) and power (E, 3) (radiance · area) of the pieces of all emitters."""
    points, normals, powers = [], [], []
    corners = world.vertices.reshape(-1, 4, 3)
    for s in np.flatnonzero(world.emission > 0):
        origin = corners[s, 0]
        du, dv = corners[s, 1] - origin, corners[s, 3] - origin
        lu, lv = float(np.linalg.norm(du)), float(np.linalg.norm(dv))
        nu, nv = max(1, round(lu / _PIECE_M)), max(1, round(lv / _PIECE_M))
        a, b = np.meshgrid((np.arange(nu) + 0.5) / nu, (np.arange(nv) + 0.5) / nv)
        points.append(origin + a.reshape(-1, 1) * du + b.reshape(-1, 1) * dv + 0.01 * world.normal[s])
        normals.append(np.repeat(world.normal[s][None], nu * nv, axis=0))
        colour = world.textures.mean[world.texture[s]] * world.tint[s] * world.emission[s]
        powers.append(np.repeat((colour * lu * lv / (nu * nv))[None], nu * nv, axis=0))
    if not points:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    return (
        np.concatenate(points).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(powers).astype(np.float32),
    )


@numba.njit(cache=True, nogil=True)
def _pairs(
    points: F32, normals: F32, emitter: F32, emitter_normal: F32, power: F32, reach_m: float, least: float,
    texel: npt.NDArray[np.int32], source: npt.NDArray[np.int32], weight: F32,
) -> int:  # fmt: skip
    """List the relevant (texel, emitter) pairs with their geometric factors; return their number."""
    count = 0
    for i in range(points.shape[0]):
        for e in range(emitter.shape[0]):
            dx = emitter[e, 0] - points[i, 0]
            dy = emitter[e, 1] - points[i, 1]
            dz = emitter[e, 2] - points[i, 2]
            square = dx * dx + dy * dy + dz * dz
            if square > reach_m * reach_m or square < 1e-6:
                continue
            cos_i = normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz
            cos_e = -(emitter_normal[e, 0] * dx + emitter_normal[e, 1] * dy + emitter_normal[e, 2] * dz)
            if cos_i <= 0.0 or cos_e <= 0.0:
                continue
            # The light is softened near the emitter, which is not a point.
            factor = cos_i * cos_e / (math.pi * square * (square + 0.15))
            if factor * power[e, 0] < least:
                continue
            if count == texel.shape[0]:
                return count
            texel[count] = i
            source[count] = e
            weight[count] = factor
            count += 1
    return count


def _cosine_directions(count: int) -> npt.NDArray[np.float64]:
    """Return the directions (count, 3) about +z, cosine-weighted and evenly spread (golden angle)."""
    k = np.arange(count)
    radius = np.sqrt((k + 0.5) / count)
    angle = k * math.pi * (3 - math.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)


def _frames(normals: F32) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return two unit vectors (N, 3) perpendicular to each of the normals (N, 3)."""
    n = normals.astype(np.float64)
    helper = np.where(np.abs(n[:, 2:3]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    tangent = np.cross(helper, n)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(n, tangent)


def _direct(world: World, points: F32, normals: F32) -> F32:
    """Return the direct irradiance / pi (L, 3) from lamps and windows."""
    light = np.zeros((len(points), 3), np.float32)
    emitter, emitter_normal, power = _emitter_pieces(world)
    if len(emitter) == 0:
        return light
    most = min(len(points) * len(emitter), 6_000_000)
    texel, source = np.empty(most, np.int32), np.empty(most, np.int32)
    weight = np.empty(most, np.float32)
    count = _pairs(points, normals, emitter, emitter_normal, power, 12.0, 0.004, texel, source, weight)
    texel, source, weight = texel[:count], source[:count], weight[:count]
    start = points[texel] + 0.004 * normals[texel]
    to = emitter[source] - start
    distance = np.linalg.norm(to, axis=1)
    seen = ~world.caster.occluded(start, to / distance[:, None], distance - 0.02)
    for k in range(3):
        light[:, k] = np.bincount(texel[seen], weights=weight[seen] * power[source[seen], k], minlength=len(points))
    return light


def _gather(world: World, points: F32, normals: F32, rays: int) -> tuple[F32, npt.NDArray[np.bool_]]:
    """Return the light of one bounce plus ambient light (L, 3), and the mask (L,) of the texels that are visible."""
    count = len(points)
    result = np.zeros((count, 3), np.float32)
    inside = np.zeros(count, np.int32)
    tangent, bitangent = _frames(normals)
    start = points + 0.004 * normals
    albedo = world.textures.mean[world.texture] * world.tint
    rng = np.random.default_rng(0)
    turn = rng.uniform(0, 2 * math.pi, count)
    cos, sin = np.cos(turn), np.sin(turn)
    for x, y, z in _cosine_directions(rays):
        a, b = x * cos - y * sin, x * sin + y * cos
        direction = (a[:, None] * tangent + b[:, None] * bitangent + z * normals).astype(np.float32)
        distance, face = world.caster.cast(start, direction)
        hit = face >= 0
        s = world.face_surface[np.where(hit, face, 0)]
        back = hit & (np.einsum("ij,ij->i", world.normal[s], direction) > 0)
        inside += back
        bounce = np.zeros((count, 3), np.float32)
        kernels.light_at_hits(
            s, np.where(hit & ~back, distance, -1.0).astype(np.float32), start, direction, world.light_at,
            world.light_uv, world.light, albedo, bounce,
        )  # fmt: skip
        openness = np.where(hit, np.minimum(distance / _AMBIENT_REACH_M, 1.0), 1.0)
        result += bounce + _AMBIENT * (0.25 + 0.75 * openness[:, None].astype(np.float32))
    return np.asarray(result / rays, np.float32), inside < 0.5 * rays


def _smooth(light: F32, valid: npt.NDArray[np.bool_], world: World) -> None:
    """Blur each map by a texel against sampling noise, and fill the texels that lie inside objects."""
    import cv2

    for first, width, height in world.light_at:
        part = slice(int(first), int(first + width * height))
        known = valid[part].reshape(height, width).astype(np.float32)
        image = light[part].reshape(height, width, 3) * known[..., None]
        # The blur is normalised over known texels and repeated until unknown ones have the light of their neighbours.
        total = cv2.GaussianBlur(image, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE).reshape(height, width, 3)
        share = cv2.GaussianBlur(known, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE)
        size = 3
        while (share < 1e-3).any() and size < 31:
            size += 4
            wide = cv2.GaussianBlur(image, (size, size), 0, borderType=cv2.BORDER_REPLICATE).reshape(height, width, 3)
            wide_share = cv2.GaussianBlur(known, (size, size), 0, borderType=cv2.BORDER_REPLICATE)
            lack = share < 1e-3
            total[lack], share[lack] = wide[lack], wide_share[lack]
        light[part] = (total / np.maximum(share, 1e-3)[..., None]).reshape(-1, 3)


def bake(world: World, rays: int = 48) -> None:
    """Compute ``world.light`` in place.

    Args:
        world: a procedural world (rectangles only).
        rays: rays per texel for bounce and occlusion.
    """
    fields: list[npt.NDArray[np.generic]] = [value for value in vars(world).values() if isinstance(value, np.ndarray)]
    parts: list[str | npt.NDArray[np.generic]] = [*fields, world.textures.mean, str(rays)]
    world.light[:] = kept("light", parts, lambda: {"light": _baked(world, rays)})["light"]


def _baked(world: World, rays: int) -> F32:
    points, owner = _texel_points(world)
    normals = world.normal[owner]
    direct = _direct(world, points, normals)
    world.light[:] = direct
    indirect, valid = _gather(world, points, normals, rays)
    light = np.ascontiguousarray(direct + indirect, np.float32)
    _smooth(light, valid, world)
    upright = np.abs(normals[:, 2]) < 0.5
    reference = np.median(light[upright & valid].mean(axis=1)) if (upright & valid).any() else light.mean()
    return np.asarray(light * np.float32(_LEVEL / max(float(reference), 1e-6)), np.float32)


def bake_mesh(world: World) -> None:
    """Compute ``light_linear`` of each triangle of a mesh file, on both sides: ambient light with occlusion.

    The mesh has no lamps, so the rooms get the light of a soft sky, stronger from above and dimmer near objects.
    """
    triangles = world.vertices[world.faces].astype(np.float64)
    count = len(triangles)
    centre = triangles.mean(axis=1)
    value = np.zeros((count, 3))
    directions = _cosine_directions(_MESH_RAYS)
    tangent, bitangent = _frames(world.normal)
    for corner in range(3):
        point = centre + 0.92 * (triangles[:, corner] - centre)
        best = np.zeros(count)
        for side in (1.0, -1.0):
            normal = side * world.normal
            start = (point + 0.004 * normal).astype(np.float32)
            total = np.zeros(count)
            for x, y, z in directions:
                direction = (x * tangent + y * bitangent + z * normal).astype(np.float32)
                distance, _ = world.caster.cast(start, direction)
                total += np.minimum(distance / _AMBIENT_REACH_M, 1.0) * (0.75 + 0.25 * direction[:, 2])
            best = np.maximum(best, total / _MESH_RAYS)
        value[:, corner] = 0.20 + 0.85 * best
    world.light_linear[:] = affine_on_triangles(triangles, value[..., None])[:, 0]


def affine_on_triangles(triangles: npt.NDArray[np.float64], values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the affine functions of a point that take given values at the corners and are constant along the normal.

    Args:
        triangles: corners in metres, (F, 3, 3).
        values: C values at each corner, (F, 3, C).

    Returns:
        Coefficients of (x, y, z, 1), (F, C, 4).
    """
    edges, change = triangles[:, 1:] - triangles[:, :1], values[:, 1:] - values[:, :1]
    gram = np.einsum("nij,nkj->nik", edges, edges)
    gram += (1e-9 * np.trace(gram, axis1=1, axis2=2) + 1e-18)[:, None, None] * np.eye(2)
    result = np.zeros((len(triangles), values.shape[2], 4))
    result[:, :, :3] = np.einsum("nij,nik->nkj", np.linalg.solve(gram, edges), change)
    result[:, :, 3] = values[:, 0] - np.einsum("nkj,nj->nk", result[:, :, :3], triangles[:, 0])
    return result
