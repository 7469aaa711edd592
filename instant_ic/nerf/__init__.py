"""Virtual space: hash-grid radiance field from a panorama with depth (needs numpy; numba or torch to compute)."""

from .config import (
    FieldConfig,
    GeometryConfig,
    PictureConfig,
    ReadinessConfig,
    TrainConfig,
    VirtualSpaceConfig,
)
from .mesh_file import MeshError
from .mesh_space import MeshSpace, Space, make_space
from .prior import KeyframeError
from .saved import SpaceFileError
from .space import NotReadyError, State, Status, TrainStats, VirtualSpace
from .view import View
from .warp import PanoramaWarp

__all__ = [
    "FieldConfig",
    "GeometryConfig",
    "KeyframeError",
    "MeshError",
    "MeshSpace",
    "NotReadyError",
    "PanoramaWarp",
    "PictureConfig",
    "ReadinessConfig",
    "Space",
    "SpaceFileError",
    "State",
    "Status",
    "TrainConfig",
    "TrainStats",
    "View",
    "VirtualSpace",
    "VirtualSpaceConfig",
    "make_space",
]
