"""Parameters of the virtual space and of the node ``nerf``. Each class checks its own values."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, ClassVar, TypeAlias

from instant_ic.config.ranges import Checked, Percent, Positive, PositiveInt, Range, Share, check_ranges, require

Coordinate: TypeAlias = Annotated[float, Range(-100_000, 100_000)]


@dataclass(frozen=True)
class FieldConfig:
    """Multi-resolution hash grid and the small network behind it.

    Attributes:
        levels: hash-grid levels, coarse to fine.
        log2_table: binary logarithm of a level's number of entries; 18 gives more detail and needs more memory.
        hidden: width of the network's hidden layer; more than 32 does not compile for NVIDIA GPUs of capability 9.0.
        geometry: distance: signed distance; density: as in the paper, with eight samples per pixel.
    """

    levels: Annotated[int, Range(1, 16)] = 8
    features: ClassVar[int] = 4  # of a table entry
    log2_table: Annotated[int, Range(10, 22)] = 17
    hidden: Annotated[int, Range(4, 32)] = 32
    geometry: str = "distance"

    def __post_init__(self) -> None:
        check_ranges(self)
        require(self, "geometry", self.geometry in ("distance", "density"), "distance or density")
        require(self, "hidden", self.hidden % 4 == 0, "a multiple of 4")


@dataclass(frozen=True)
class TrainConfig:
    """One training run over a keyframe.

    Attributes:
        ray_columns: rays of a batch in azimuth, evenly spaced; a multiple of 8.
        ray_rows: rays of a batch in height, evenly spaced in solid angle; a multiple of 8. A batch has ray_columns x
            ray_rows rays.
        iterations: number of iterations of a training run; training is then idle until the next keyframe.
        seed: seed of the initial weights and of the rays.
    """

    ray_columns: Annotated[int, Range(8, 1024)] = 128
    ray_rows: Annotated[int, Range(8, 1024)] = 64
    iterations: PositiveInt = 2000
    seed: Annotated[int, Range(low=0)] = 1

    def __post_init__(self) -> None:
        check_ranges(self)
        for key in ("ray_columns", "ray_rows"):
            require(self, key, getattr(self, key) % 8 == 0, "a multiple of 8")


@dataclass(frozen=True)
class GeometryConfig(Checked):
    """Use of the keyframe's depth for the field and the occupancy grid.

    Attributes:
        body_below_deg: degrees; pixels below this elevation show the robot itself and are left out; -90: none.
        sky_share: smallest share of the sphere at which a region of unknown depth above the horizon is sky; 1: no sky.
        cell_m: m; smallest cell of the occupancy grid.
    """

    body_below_deg: Annotated[float, Range(-90, 0)] = -90.0
    sky_share: Share = 0.05
    cell_m: Annotated[float, Range(above=0, high=1)] = 0.04


@dataclass(frozen=True)
class ReadinessConfig(Checked):
    """Conditions under which the space may be shown.

    Attributes:
        psnr_db: dB; PSNR of the training rays at which the space becomes ready.
        plateau_iterations: number of iterations over which plateau_db is measured.
        plateau_db: dB; the space also becomes ready once the PSNR's gain over plateau_iterations is below this.
        max_radius_m: m; largest distance from the keyframe at which a view may be shown.
    """

    psnr_db: Positive = 24.0
    plateau_iterations: PositiveInt = 100
    plateau_db: Positive = 0.3
    max_radius_m: Positive = 3.0


@dataclass(frozen=True)
class ViewContentConfig(Checked):
    """Content of a view: the keyframe's panorama warped by its depth, or the field if it is measured to be better.

    Attributes:
        field_gain_db: dB; the field is shown if it renders older keyframes better than the warp by this much, until it
            is worse than the warp.
        field_alone: always show the field, without measurement, from its first step on; for experiments.
        refresh_views: number of views over which a new keyframe is blended in; 1: shown at once.
    """

    field_gain_db: Annotated[float, Range(0, 20)] = 0.5
    field_alone: bool = False
    refresh_views: Annotated[int, Range(1, 60)] = 6


@dataclass(frozen=True)
class VirtualSpaceConfig:
    """Parameters of the virtual space, independent of the bus.

    Attributes:
        source: field: the panorama warped by its depth until the field is measured to be better; warp: only the warp,
            without training; auto: field on a GPU, otherwise warp, because a field trained on a CPU does not become
            better in time; mesh: a place scanned beforehand.
        mesh: file of the scanned place (GLB, glTF, PLY, OBJ), for source: mesh.
        mesh_pose: pose of the mesh in the map: x, y, z (m), yaw (degrees, counter-clockwise).
        mesh_max_triangles: larger meshes are refused.
        mesh_fit_colours: scale each colour channel so that the mesh looks like the newest keyframe.
        device: cpu: numba; cuda: Triton on an NVIDIA GPU, geometry distance only; auto: cuda if it works, else cpu.
        panorama_width: px; wider panoramas are area-averaged to this width.
        keyframes: number of newest keyframes on which the field is trained together, 1..8.
        older: number of older keyframes within 3 m whose pixels show places hidden from the newest; they cost no time
            per view.
        view: the keyframe's panorama warped by its depth, or the field.
    """

    source: str = "field"
    mesh: str = ""
    mesh_pose: tuple[Coordinate, Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0, 0.0)
    mesh_max_triangles: PositiveInt = 5_000_000
    mesh_fit_colours: bool = True
    device: str = "auto"
    panorama_width: Annotated[int, Range(64, 8192)] = 2048
    keyframes: Annotated[int, Range(1, 8)] = 1
    older: Annotated[int, Range(0, 4)] = 2
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    geometry: GeometryConfig = dataclasses.field(default_factory=GeometryConfig)
    readiness: ReadinessConfig = dataclasses.field(default_factory=ReadinessConfig)
    view: ViewContentConfig = dataclasses.field(default_factory=ViewContentConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        require(self, "device", self.device in ("auto", "cpu", "cuda"), "auto, cpu or cuda")
        cuda_density = self.device == "cuda" and self.field.geometry == "density"
        require(self, "device", not cuda_density, "auto or cpu with geometry density")
        require(self, "source", self.source in ("auto", "field", "warp", "mesh"), "auto, field, warp or mesh")
        require(self, "mesh", self.source != "mesh" or bool(self.mesh), "a file with source: mesh")
        require(self, "mesh_pose", len(self.mesh_pose) == 4, "x, y, z in metres and yaw in degrees")
        for key in ("ray_columns", "ray_rows") if self.field.geometry == "density" else ():
            require(self.train, key, getattr(self.train, key) % 16 == 0, "a multiple of 16 with density")


@dataclass(frozen=True)
class NerfConfig(Checked):
    """Parameters.

    Attributes:
        render_fps: target frame rate of requested views; training gets the remaining time.
        train_ms_per_frame: longest uninterrupted training in ms, and thus the longest wait of a requested view. While
            no view is requested, training may use all the time.
        max_view_pixels: largest view that may be requested; larger requests are refused.
        jpeg_quality: JPEG quality of views, 1 to 100.
        robot_mask: image, twice as wide as high, white where the panorama shows the robot itself or its stand (see also
            ``space.geometry.body_below_deg``); empty: no mask.
        space: the virtual space itself.
    """

    render_fps: Annotated[float, Range(0.5, 120)] = 10.0
    train_ms_per_frame: Positive = 50.0
    max_view_pixels: PositiveInt = 1280 * 720
    jpeg_quality: Percent = 85
    robot_mask: str = ""
    space: VirtualSpaceConfig = dataclasses.field(default_factory=VirtualSpaceConfig)
