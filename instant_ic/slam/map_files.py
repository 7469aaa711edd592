"""Maps on disk: ``NAME.yaml`` and ``NAME.pgm`` in ROS format, and ``NAME.graph.npz`` for extending the map.

The image follows map_saver and map_server (nav2): 0 is occupied, 254 free, 205 unknown, and the top row has the largest
y.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.scalars import to_float
from instant_ic.config.yaml_text import read_spelled, resolved
from instant_ic.slam.keyframes import ScanKeyframe
from instant_ic.slam.occupancy import OccupancyGrid
from instant_ic.slam.pose_graph import Edge
from instant_ic.slam.scan import FloatArray, ScanPoints
from instant_ic.util.limits import check_arrays, load_image

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.25
WRITTEN_FREE_THRESH = 0.196
"""Free threshold in written files. It is below 0.1961, the occupancy of grey 205, so that readers keep 205 unknown."""
_GRAPH_VERSION = 1


class MapError(ValueError):
    """A map cannot be written or read."""


def graph_file(stem: Path) -> Path:
    """Return the path of the pose graph beside ``stem.yaml``."""
    return stem.with_name(stem.name + ".graph.npz")


def ros_map(
    values: NDArray[np.int8], resolution: float, origin: Sequence[float] | NDArray[np.float64], image: str
) -> tuple[NDArray[np.uint8], str]:
    """Return the image (H, W), largest y on top, and the YAML text of a map, in map_server's format.

    Args:
        values: cells, (H, W), lowest y first: 0..100, or -1 if unknown.
        resolution: metres per cell.
        origin: lower left corner (x, y) in metres.
        image: file name of the image, for the YAML text.

    Raises:
        MapError: the map is empty.
    """
    if values.size == 0:
        raise MapError("the map is empty: nothing to save")
    picture = np.full(values.shape, 205, dtype=np.uint8)
    picture[values >= round(100 * OCCUPIED_THRESH)] = 0
    picture[(values >= 0) & (values <= round(100 * FREE_THRESH))] = 254
    text = (
        f"image: {image}\nmode: trinary\nresolution: {resolution:.9g}\n"
        f"origin: [{origin[0]:.9g}, {origin[1]:.9g}, 0]\nnegate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {WRITTEN_FREE_THRESH}\n"
    )
    return np.ascontiguousarray(picture[::-1]), text


def save_grid(stem: Path, grid: OccupancyGrid) -> list[Path]:
    """Write ``stem.pgm`` and ``stem.yaml``, and return their paths.

    Raises:
        MapError: the map is empty, or the folder is not writable.
    """
    image, text = stem.with_name(stem.name + ".pgm"), stem.with_name(stem.name + ".yaml")
    picture, words = ros_map(grid.values, grid.resolution, grid.origin, image.name)
    height, width = picture.shape
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        image.write_bytes(f"P5\n{width} {height}\n255\n".encode() + picture.tobytes())
        text.write_text(words)
    except OSError as error:
        raise MapError(f"the map cannot be written: {error}") from None
    return [text, image]


def load_grid(path: Path) -> OccupancyGrid:
    """Read a ROS map from its YAML file, given with or without extension.

    Cells are free, occupied or unknown, as in map_server's mode ``trinary``. The image may have any format that OpenCV
    reads.

    Raises:
        MapError: a file is missing or invalid.
    """
    import cv2
    import yaml

    path = path if path.suffix in (".yaml", ".yml") else path.with_name(path.name + ".yaml")
    try:
        content = read_spelled(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise MapError(f"map {path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise MapError(f"{path}: must have the keys image, resolution and origin")
    resolution = _number(path, content, "resolution", None)
    occupied = _number(path, content, "occupied_thresh", OCCUPIED_THRESH)
    free = _number(path, content, "free_thresh", FREE_THRESH)
    if not resolution > 0:
        raise MapError(f"{path}: resolution must be > 0 (got {resolution})")
    if not 0 <= free < occupied <= 1:
        raise MapError(f"{path}: need 0 <= free_thresh < occupied_thresh <= 1 (got {free}, {occupied})")
    origin = content.get("origin")
    if not isinstance(origin, list) or len(origin) < 2:
        raise MapError(f"{path}: origin must be [x, y, yaw] (got {origin!r})")
    origin = [_checked_number(f"{path}: origin", part) for part in origin]
    if len(origin) > 2 and abs(origin[2]) > 1e-6:
        raise MapError(f"{path}: a rotated map (origin yaw {origin[2]}) is not supported: rotate the image instead")
    mode = str(content.get("mode", "trinary"))
    if mode != "trinary":
        raise MapError(f"{path}: mode must be trinary (got {mode!r}); save the map again with mode trinary")
    image = path.parent / str(content.get("image", ""))
    try:
        found = image.is_file()
    except (OSError, ValueError):  # the name cannot be a file name
        found = False
    if not found:
        raise MapError(f"{path}: image {image} does not exist")
    picture: Any = load_image(image, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise MapError(f"{image} cannot be decoded as an image")
    grey = picture[::-1].astype(np.float64)
    values = np.full(grey.shape, -1, dtype=np.int8)
    try:
        negate = resolved(content.get("negate"))
    except yaml.YAMLError as error:
        raise MapError(f"{path}: negate must be 0 or 1: {error}") from None
    share = grey / 255 if negate else (255 - grey) / 255
    # Grey 205 is unknown at any threshold. nav2 writes the threshold 0.25, which would make 205 free.
    unknown = (grey == 205) & (not negate)
    values[(share < free) & ~unknown] = 0
    values[share > occupied] = 100
    return OccupancyGrid(values, resolution, np.array(origin[:2], dtype=np.float64))


_MOST_NUMBER = 1e9
"""Bound of all numbers in a map file. YAML also allows NaN, infinity, and integers too large for a float."""


def _number(path: Path, content: dict[str, Any], key: str, default: float | None) -> float:
    return _checked_number(f"{path}: {key}", content.get(key, default))


def _checked_number(what: str, value: Any) -> float:
    with suppress(ValueError):
        if abs(number := to_float(value)) < _MOST_NUMBER:
            return number
    raise MapError(f"{what} must be a number (got {value!r})")


def occupied_points(grid: OccupancyGrid) -> FloatArray:
    """Return the centres of the occupied cells in the map frame, (n, 2)."""
    rows, columns = np.nonzero(grid.values >= round(100 * OCCUPIED_THRESH))
    points: FloatArray = grid.origin + grid.resolution * (np.column_stack([columns, rows]) + 0.5)
    return points


def save_graph(stem: Path, keyframes: Sequence[ScanKeyframe], edges: Sequence[Edge]) -> Path:
    """Write keyframes and edges to ``stem.graph.npz``, and return its path.

    Raises:
        MapError: the file cannot be written.
    """
    path = graph_file(stem)
    arrays: dict[str, Any] = {
        "version": np.array(_GRAPH_VERSION),
        "stamps": np.array([k.stamp_ns for k in keyframes], dtype=np.int64),
        "points": np.concatenate([np.zeros((0, 2)), *(k.scan.points for k in keyframes)]).astype(np.float32),
        "joined": np.concatenate([np.zeros(0, dtype=np.bool_), *(k.scan.joined for k in keyframes)]),
        "point_counts": np.array([len(k.scan.points) for k in keyframes], dtype=np.int64),
        "origins": np.array([k.scan.origin for k in keyframes]).reshape(-1, 2),
        "edge_ends": np.array([(e.a, e.b) for e in edges], dtype=np.int64).reshape(-1, 2),
        "edge_poses": np.array([e.a_from_b for e in edges]).reshape(-1, 3),
        "edge_covariances": np.array([e.covariance for e in edges]).reshape(-1, 3, 3),
        "edge_robust": np.array([e.robust for e in edges], dtype=np.bool_),
    }
    for name, shape in (("map_from_base", (-1, 3)), ("step", (-1, 3)), *((n, (-1, 3, 3)) for n in _MATRICES)):
        arrays[name] = np.array([getattr(k, name) for k in keyframes]).reshape(shape)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)
    except OSError as error:
        raise MapError(f"the pose graph cannot be written: {error}") from None
    return path


_MATRICES = ("step_covariance", "drift")


def load_graph(stem: Path) -> tuple[list[ScanKeyframe], list[Edge]]:
    """Read keyframes and edges from a file written by `save_graph`.

    Raises:
        MapError: the file is missing or is not a saved graph.
    """
    path = graph_file(stem)
    try:
        if path.is_file():
            check_arrays(path)
        with np.load(path, allow_pickle=False) as file:
            data: dict[str, NDArray[Any]] = dict(file)
        if int(data["version"]) != _GRAPH_VERSION:
            raise MapError(f"{path}: version {int(data['version'])} is not supported, only {_GRAPH_VERSION}")
        cuts = np.cumsum(data["point_counts"])[:-1]
        points = np.split(data["points"].astype(np.float64), cuts)
        joined = np.split(data["joined"], cuts)
        keyframes = [
            ScanKeyframe(
                int(data["stamps"][k]), data["map_from_base"][k],
                ScanPoints(points[k], joined[k], data["origins"][k]),
                data["step"][k], data["step_covariance"][k], data["drift"][k],
            )
            for k in range(len(data["stamps"]))
        ]  # fmt: skip
        edges = [
            Edge(int(a), int(b), data["edge_poses"][k], data["edge_covariances"][k], bool(data["edge_robust"][k]))
            for k, (a, b) in enumerate(data["edge_ends"])
        ]
    except FileNotFoundError:
        raise MapError(f"no pose graph {path}: without it, use mode localization") from None
    except (OSError, ValueError, KeyError, IndexError, EOFError) as error:
        if isinstance(error, MapError):
            raise
        raise MapError(f"{path}: not a pose graph, or damaged: {error}") from None
    if not keyframes:
        raise MapError(f"{path}: contains no keyframe")
    if any(not 0 <= end < len(keyframes) for edge in edges for end in (edge.a, edge.b)):
        raise MapError(f"{path}: damaged: an edge refers to a missing keyframe")
    return keyframes, edges
