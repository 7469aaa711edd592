"""Virtual space: views from panoramas with depth, by warping or by a hash-grid radiance field (numba or Triton)."""

from instant_ic.geometry.mesh_file import MeshError
from instant_ic.vspace.config import (
    FieldConfig,
    GeometryConfig,
    ReadinessConfig,
    TrainConfig,
    ViewContentConfig,
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
    "ReadinessConfig",
    "Space",
    "SpaceFileError",
    "SpaceState",
    "SpaceStatus",
    "TrainConfig",
    "View",
    "ViewContentConfig",
    "VirtualSpace",
    "VirtualSpaceConfig",
    "make_space",
]
