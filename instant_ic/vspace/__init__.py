"""Virtual space: hash-grid radiance field from a panorama with depth (needs numpy; numba or torch to compute)."""

from instant_ic.geometry.mesh_file import MeshError
from instant_ic.vspace.config import (
    FieldConfig,
    GeometryConfig,
    PictureConfig,
    ReadinessConfig,
    TrainConfig,
    VirtualSpaceConfig,
)
from instant_ic.vspace.mesh_space import MeshSpace, Space, make_space
from instant_ic.vspace.prior import KeyframeError
from instant_ic.vspace.saved import SpaceFileError
from instant_ic.vspace.space import NotReadyError, SpaceState, SpaceStatus, VirtualSpace
from instant_ic.vspace.view import View
from instant_ic.vspace.warp import PanoramaWarp

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
    "SpaceState",
    "SpaceStatus",
    "TrainConfig",
    "View",
    "VirtualSpace",
    "VirtualSpaceConfig",
    "make_space",
]
