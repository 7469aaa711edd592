"""A simulated 3D scan of a place: the mesh of conventional illusory control (paper, V.A).

Stations measure ranges and take panoramas in the world as it was at the time of the scan. The scans are registered with
errors, fused in a grid of signed distances (Curless and Levoy 1996) and meshed by marching cubes. Each triangle gets
its colours from the station that sees it best. The result is a GLB file for ``space.source: mesh``.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.worlds import moved_by, things
from instant_ic.geometry.poses import pose_matrix

if TYPE_CHECKING:
    from instant_ic.sim.world import World

Floats: TypeAlias = NDArray[np.floating]

STATION_HEIGHT_M = 1.5
RANGE_M = (0.4, 15.0)
"""Ranges that the scanner measures."""
AROUND_M = 7.0
"""Stations stand within this distance of the start."""
_CLEARANCE_M = 0.4
_GRAZING = 0.08
"""Surfaces that a beam meets at a smaller sine give no return."""
_BAND_CELLS = 2
_AT_ONCE = 500_000
"""Cells that are fused together, which bounds the memory."""
_SHIFT_M = 0.4
"""Largest displacement of a moved object along each axis."""


@dataclass(frozen=True)
class ScanQuality:
    """Errors of a scan; by default those of a tripod scanner registered by its clouds alone, a year ago (paper, V.A).

    Attributes:
        noise_m: standard deviation of a range.
        registration_m: standard deviation of a station's position on each axis.
        registration_deg: standard deviation of its heading; a quarter of it for roll and pitch.
        cell_m: edge of the grid's cells and about that of the triangles; thinner objects are lost.
        spacing_m: distance between stations.
        width: width of the stations' panoramas, pixels.
        colour: standard deviation of the logarithm of the white balance; twice it for the exposure, half it for each
            texture.
        older: share of the free-standing objects that stood elsewhere at the time of the scan.
    """

    noise_m: float = 0.004
    registration_m: float = 0.01
    registration_deg: float = 0.1
    cell_m: float = 0.04
    spacing_m: float = 3.0
    width: int = 4096
    colour: float = 0.12
    older: float = 0.5


@dataclass(frozen=True)
class Station:
    """One position of the scanner.

    Attributes:
        pose: map_from_station as registered, (4, 4).
        range_m: measured ranges, (H, 2 H); 0 without a return.
        rgb: panorama, (2 H, 4 H, 3), or (H, 2 H, 3) like the ranges.
    """

    pose: NDArray[np.float64]
    range_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    def pixels(self, points: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """Return the row and column in ``range_m``, and distance, of points (N, 3) in the map."""
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        distance = np.linalg.norm(local, axis=1)
        u, v = _equirect_uv(local)
        height, width = self.range_m.shape
        return np.minimum((v * height).astype(int), height - 1), (u * width).astype(int) % width, distance


def aged(world: World, quality: ScanQuality, rng: np.random.Generator) -> World:
    """Return the world at the time of its scan: with other light and colours, and some objects elsewhere."""
    drift = np.exp(rng.normal(0, 0.5 * quality.colour, (int(world.texture.max()) + 1, 3)))[world.texture]
    light = np.exp(rng.normal(0, quality.colour, 3) + rng.normal(0, 2 * quality.colour))
    tint, emission = world.tint * drift * light, world.emission * np.float32(light.mean())
    older = replace(world, tint=tint.astype(np.float32), emission=emission.astype(np.float32))
    found, _, _ = things(world)
    for label in range(1, int(found.max(initial=0)) + 1):
        if rng.random() < quality.older:
            older = moved_by(older, found == label, np.array([*rng.uniform(-_SHIFT_M, _SHIFT_M, 2), 0.0]))
    return older


def station_places(world: World, start: Sequence[float], spacing_m: float, rng: np.random.Generator) -> Floats:
    """Choose positions (N, 2) on the free floor around a start, no two nearer than the spacing.

    Raises:
        ValueError: there is no free floor at the start.
    """
    mask = world.occupied(0.03, 1.9, 0.05)
    free = mask.centre(mask.reachable((start[0], start[1]), _CLEARANCE_M))
    away = np.linalg.norm(free - np.asarray(start[:2]), axis=1)
    free, away = free[away < AROUND_M], away[away < AROUND_M]
    if not len(free):
        raise ValueError(f"world {world.name!r}: no free floor for a scanner around {start[0]:g},{start[1]:g}")
    order = rng.permutation(len(free))
    chosen: list[Floats] = []
    # The scanner does not stand where the robot starts.
    for place in (free[int(np.argmin(np.abs(away - 0.5 * spacing_m)))], *free[order]):
        if all(np.linalg.norm(place - other) >= spacing_m for other in chosen):
            chosen.append(place)
    return np.array(chosen)


def take_station(world: World, place: Floats, quality: ScanQuality, rng: np.random.Generator) -> Station:
    """Scan a world from a position (2,)."""
    from instant_ic.sim.render import EquirectRenderer

    true = pose_matrix(place[0], place[1], STATION_HEIGHT_M, yaw=float(rng.uniform(-math.pi, math.pi)))
    renderer = EquirectRenderer(world)
    frame = renderer.render(true, quality.width, quality.width // 2)
    range_m = np.ascontiguousarray(frame.depth_m[::2, ::2])
    directions = _directions(range_m.shape[1])
    _, face = renderer.cast(true[:3, 3], directions.reshape(-1, 3) @ true[:3, :3].T.astype(np.float32))
    surface = world.face_surface[np.maximum(face, 0)]
    sine = np.abs(np.einsum("ij,ij->i", world.normal[surface], directions.reshape(-1, 3) @ true[:3, :3].T))
    # Glass gives no return. Upright surfaces that emit light are windows.
    glass = (world.emission[surface] > 0) & (np.abs(world.normal[surface, 2]) < 0.5)
    lost = (face < 0) | (sine < _GRAZING) | glass
    range_m = range_m + rng.normal(0, quality.noise_m, range_m.shape).astype(np.float32)
    range_m[lost.reshape(range_m.shape) | (range_m < RANGE_M[0]) | (range_m > RANGE_M[1])] = 0
    tilt, turn = (math.radians(quality.registration_deg * share) for share in (0.25, 1.0))
    roll, pitch, yaw = rng.normal(0, [tilt, tilt, turn])
    x, y, z = rng.normal(0, quality.registration_m, 3)
    error = pose_matrix(x, y, z, roll, pitch, yaw)
    return Station(true @ error, range_m, frame.rgb)


def fuse(stations: Sequence[Station], cell_m: float) -> tuple[Floats, NDArray[np.int64]]:
    """Mesh the stations' ranges: vertices (V, 3) and faces (F, 3), with holes where nothing was measured.

    Raises:
        ValueError: nothing was measured.
    """
    from scipy.ndimage import binary_dilation
    from skimage.measure import marching_cubes

    points = np.concatenate([_points(one) for one in stations])
    if not len(points):
        raise ValueError("the scanner measured nothing")
    low = points.min(axis=0) - (_BAND_CELLS + 1) * cell_m
    cells = ((points - low) / cell_m).astype(int)
    band = np.zeros(cells.max(axis=0) + _BAND_CELLS + 3, bool)
    band[tuple(cells.T)] = True
    band = binary_dilation(band, iterations=_BAND_CELLS)
    at = np.argwhere(band).astype(np.int32)
    total, weight = np.zeros(len(at), np.float32), np.zeros(len(at), np.float32)
    reach = _BAND_CELLS * cell_m
    for begin in range(0, len(at), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        centres = low + at[part] * cell_m
        for one in stations:
            row, column, distance = one.pixels(centres)
            measured = one.range_m[row, column]
            signed = measured - distance
            share = np.where((measured > 0) & (signed > -reach), 1 / np.maximum(distance, 0.5) ** 2, 0)
            total[part] += share * np.clip(signed / reach, -1, 1)
            weight[part] += share
    seen = weight > 0
    known = np.zeros(band.shape, bool)
    known[tuple(at[seen].T)] = True
    volume = np.ones(band.shape, np.float32)
    volume[tuple(at[seen].T)] = total[seen] / weight[seen]
    vertices, faces, _, _ = marching_cubes(volume, 0.0, mask=known)
    # A vertex lies between two cells; beside an unknown one the surface is an artefact.
    sure = known[tuple(np.floor(vertices).astype(int).T)] & known[tuple(np.ceil(vertices).astype(int).T)]
    return low + vertices * cell_m, np.asarray(faces[sure[faces].all(axis=1)], np.int64)


def best_stations(triangles: Floats, stations: Sequence[Station], tolerance_m: float) -> NDArray[np.intp]:
    """Return the station (F,) that sees each triangle (F, 3, 3) nearest and most squarely; -1 if none does."""
    centre = triangles.mean(axis=1)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    best, chosen = np.zeros(len(triangles)), np.full(len(triangles), -1)
    for number, one in enumerate(stations):
        row, column, distance = one.pixels(centre)
        ray = (centre - one.pose[:3, 3]) / distance[:, None]
        visible = np.abs(one.range_m[row, column] - distance) < tolerance_m
        score = visible * np.abs(np.einsum("ij,ij->i", normal, ray)) / distance**2
        better = score > best
        best[better], chosen[better] = score[better], number
    return chosen


def scan_world(
    world: World,
    start: Sequence[float],
    quality: ScanQuality,
    seed: int,
    path: Path,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> dict[str, Any]:
    """Scan a world around a start and write the mesh as a GLB file.

    Args:
        world: world to scan; ``quality.older`` and ``quality.colour`` change a copy of it first.
        start: (x, y, ...) of the drive, on the free floor.
        quality: errors of the scan.
        seed: seed of all errors.
        path: GLB file to write.
        origin: (x, y, yaw) of the file's frame in the world.

    Returns:
        Number of ``stations`` and of ``triangles``.

    Raises:
        ValueError: there is no free floor, or nothing was measured.
    """
    import trimesh
    from PIL import Image

    rng = np.random.default_rng([73, seed])
    older = aged(world, quality, rng)
    places = station_places(older, start, quality.spacing_m, rng)
    stations = [take_station(older, place, quality, rng) for place in places]
    vertices, faces = fuse(stations, quality.cell_m)
    triangles = vertices[faces]
    chosen = best_stations(triangles, stations, 2 * quality.cell_m)
    scene, count = trimesh.Scene(), 0
    map_from_file = pose_matrix(origin[0], origin[1], yaw=origin[2])
    for number, one in enumerate(stations):
        corners = triangles[chosen == number].reshape(-1, 3)
        if not len(corners):
            continue
        u, v = _equirect_uv((corners - one.pose[:3, 3]) @ one.pose[:3, :3])
        u = u.reshape(-1, 3)
        u -= np.rint(u - u[:, :1])  # a triangle across the panorama's seam
        jpeg = io.BytesIO()
        Image.fromarray(one.rgb).save(jpeg, "JPEG", quality=95)
        look = trimesh.visual.TextureVisuals(
            np.column_stack([u.reshape(-1), 1 - v]),
            trimesh.visual.material.PBRMaterial(baseColorTexture=Image.open(jpeg)),
        )
        local = (corners - map_from_file[:3, 3]) @ map_from_file[:3, :3]
        # glTF has y up: (x, y, z) becomes (x, z, -y).
        turned = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]])
        own = np.arange(len(corners)).reshape(-1, 3)
        scene.add_geometry(trimesh.Trimesh(turned, own, visual=look, process=False), f"station{number}")
        count += len(own)
    path.write_bytes(scene.export(file_type="glb"))
    return {"stations": len(stations), "triangles": count}


def _points(station: Station) -> NDArray[np.float64]:
    """Return every measured point in the map, (N, 3)."""
    directions = _directions(station.range_m.shape[1])
    met = station.range_m > 0
    local = directions[met] * station.range_m[met][:, None]
    return np.asarray(local @ station.pose[:3, :3].T + station.pose[:3, 3], np.float64)


def _directions(width: int) -> NDArray[np.float32]:
    from instant_ic.geometry.projections import equirect_directions

    return equirect_directions(width, width // 2)


def _equirect_uv(local: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the texture coordinates in 0..1 of points (N, 3) in a panorama's frame, v downwards."""
    x, y, z = np.asarray(local, np.float64).T
    u = 0.5 - np.arctan2(y, x) / (2 * math.pi)
    return u, 0.5 - np.arctan2(z, np.hypot(x, y)) / math.pi
