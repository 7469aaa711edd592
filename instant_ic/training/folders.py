"""Folders of published panoramas with depth: Matterport3D, Stanford 2D-3D-S, Structured3D, and plain ones.

Sources of the layouts and units (checked 2026-11):

- Stanford 2D-3D-S, its README: 16-bit PNG, 1/512 m, 65535 is missing; panoramas hold the distance from the centre.
- Structured3D, its data_organization.md and README: 16-bit PNG, millimetres, 0 is missing; scenes from 03000 on are for
  validation, from 03250 on for testing. The documents do not say which distance is meant; distance from the camera is
  assumed.
- Matterport3D has no depth panoramas; users stitch them. The usual script (UniFuse's stitch.m) writes 16-bit PNG in
  units of 1/4000 m, distance from the camera. 3D60 and Pano3D render them as OpenEXR in metres.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.files import DEPTH_SUFFIXES, PICTURE_SUFFIXES, DepthFileError, load_depth, load_picture
from instant_ic.training.dataset import DatasetError, RenderedDataset, Sample

_HELD_OUT_SHARE = 0.08
_MOST_UNREADABLE = 0.01


@dataclass(frozen=True)
class Pair:
    """An image, its depth, their scene, and whether the data set's own split excludes it from training."""

    rgb: Path
    depth: Path
    scene: str
    held_out: bool | None = None


@dataclass(frozen=True)
class Layout:
    """Directory layout of a data set: description for messages, lister of images with depth, units a metre in PNG."""

    looks_like: str
    pictures: Callable[[Path], Iterator[Pair]]
    units_per_m: float = 1000.0


def _matterport(folder: Path) -> Iterator[Pair]:
    for depths in sorted(folder.glob("*/pano_depth")):
        scan = depths.parent
        pictures = next((scan / name for name in ("pano_skybox_color", "pano_color") if (scan / name).is_dir()), None)
        for rgb in _pictures(pictures) if pictures else ():
            yield Pair(rgb, depths / f"{rgb.stem}.png", scan.name)
    for rgb in sorted(folder.rglob("*_color_*.png")):  # 3D60, Pano3D
        scene = re.sub(r"^\d+_", "", rgb.name.split("_color_")[0])
        yield Pair(rgb, rgb.with_name(rgb.stem.replace("_color_", "_depth_") + ".exr"), scene)


def _stanford(folder: Path) -> Iterator[Pair]:
    for rgb in sorted(folder.glob("area_*/pano/rgb/*_rgb.png")):
        area = rgb.parents[2].name
        depth = rgb.parents[1] / "depth" / (rgb.stem.removesuffix("_rgb") + "_depth.png")
        yield Pair(rgb, depth, area, held_out=area.startswith("area_5"))  # fold 1, used in all publications


def _structured(folder: Path) -> Iterator[Pair]:
    for rgb in sorted(folder.glob("scene_*/2D_rendering/*/panorama/full/rgb_rawlight.png")):
        scene = rgb.parents[4].name
        number = scene.removeprefix("scene_")
        if number.isdigit() and int(number) >= 3250:
            continue  # the test scenes are used neither for training nor for model selection
        yield Pair(rgb, rgb.with_name("depth.png"), scene, number.isdigit() and int(number) >= 3000)


def _plain(folder: Path) -> Iterator[Pair]:
    rgbs, depths = folder / "rgb", folder / "depth"
    found = {path.relative_to(depths).with_suffix(""): path for path in sorted(depths.rglob("*"))
             if path.suffix.lower() in DEPTH_SUFFIXES}  # fmt: skip
    for rgb in _pictures(rgbs, deep=True):
        name = rgb.relative_to(rgbs).with_suffix("")
        scene = str(name.parent) if name.parent != Path() else str(name)
        yield Pair(rgb, found.get(name, depths / f"{name}.png"), scene)


def _pictures(folder: Path, deep: bool = False) -> list[Path]:
    names = folder.rglob("*") if deep else folder.glob("*")
    return sorted(path for path in names if path.suffix.lower() in PICTURE_SUFFIXES)


LAYOUTS: dict[str, Layout] = {
    "m3d": Layout("SCAN/pano_skybox_color/*.jpg with SCAN/pano_depth/*.png, or *_color_*.png with *_depth_*.exr",
                  _matterport, 4000.0),
    "s2d3d": Layout("area_N/pano/rgb/*_rgb.png with area_N/pano/depth/*_depth.png", _stanford, 512.0),
    "s3d": Layout("scene_N/2D_rendering/ROOM/panorama/full/rgb_rawlight.png with depth.png", _structured),
    "plain": Layout("rgb/NAME.jpg (or png) with depth/NAME.png (millimetres), .npy, .npz or .exr (metres)", _plain),
}  # fmt: skip


@dataclass
class FolderDataset:
    """Panoramas of a folder, resized on reading: images by area averaging, depth by the nearest pixel.

    Attributes:
        layout: one of :data:`LAYOUTS`.
        size: height and width.
        alone: images without depth, which are skipped.
        unreadable: damaged files; up to 1 % of the panoramas are skipped with a warning.
    """

    folder: Path
    layout: str
    size: tuple[int, int]
    pairs: list[Pair]
    alone: list[Path] = field(default_factory=list)
    unreadable: dict[int, str] = field(default_factory=dict)

    @property
    def info(self) -> dict[str, Any]:
        """Recipe for the training record, without the local path."""
        scenes = {pair.scene for pair in self.pairs}
        return {"kind": self.layout, "folder": self.folder.name, "count": len(self.pairs), "scenes": len(scenes)}

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> Sample:
        """Return the panorama, or the next one if it is not readable.

        Raises:
            DatasetError: over 1 % of the panoramas are not readable; names the last.
        """
        for place in range(index, index + len(self.pairs)):
            at = place % len(self.pairs)
            if at in self.unreadable:
                continue
            try:
                return self._read(at)
            except (DatasetError, DepthFileError) as error:
                self.unreadable[at] = str(error)
                if len(self.unreadable) > _MOST_UNREADABLE * len(self.pairs):
                    raise DatasetError(f"{error} ({len(self.unreadable)} of {len(self.pairs)} panoramas of "
                                       f"{self.folder} are not readable)") from error  # fmt: skip
                warnings.warn(f"skipped: {error}", stacklevel=2)
        raise DatasetError(f"{self.folder}: no readable panorama")

    def _read(self, index: int) -> Sample:
        import cv2

        pair, (height, width) = self.pairs[index], self.size
        rgb = load_picture(pair.rgb)
        layout = LAYOUTS[self.layout]
        depth = load_depth(pair.depth, 1 / layout.units_per_m)
        for path, shape in ((pair.rgb, rgb.shape), (pair.depth, depth.shape)):
            if shape[1] != 2 * shape[0]:
                raise DatasetError(f"{path}: {shape[1]} x {shape[0]} is not an equirect panorama (2:1)")
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        depth = np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
        return Sample(rgb, depth, index)

    def split(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices for training and for evaluation: the data set's own split, or else the last scenes held out.

        Raises:
            DatasetError: no panoramas for training or none for evaluation.
        """
        if any(pair.held_out for pair in self.pairs):
            held = np.array([bool(pair.held_out) for pair in self.pairs])
        else:
            scenes = sorted({pair.scene for pair in self.pairs})
            last = set(scenes[-max(1, round(len(scenes) * _HELD_OUT_SHARE)) :])
            held = np.array([pair.scene in last for pair in self.pairs])
        if held.all():
            raise DatasetError(f"{self.folder}: all {len(self)} panoramas are in scenes reserved for evaluation; "
                               "add scenes for training")  # fmt: skip
        return np.flatnonzero(~held), np.flatnonzero(held)


def open_folder(name: str, size: tuple[int, int]) -> FolderDataset | RenderedDataset:
    """Open ``LAYOUT:FOLDER``, layout ``rendered`` or one of :data:`LAYOUTS`; ``size``: height and width of the samples.

    Raises:
        DatasetError: unknown layout, missing folder, or no files in this layout.
    """
    kind, colon, place = name.partition(":")
    if kind not in ("rendered", *LAYOUTS) or not colon:
        raise DatasetError(f"{name!r}: expected LAYOUT:FOLDER with LAYOUT one of rendered, {', '.join(LAYOUTS)}")
    folder = Path(place).expanduser()
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder")
    if kind == "rendered":
        return RenderedDataset(folder, size)
    found = list(LAYOUTS[kind].pictures(folder))
    pairs = [pair for pair in found if pair.depth.is_file()]
    if not pairs:
        other = next(
            (o for o, layout in LAYOUTS.items() if any(p.depth.is_file() for p in layout.pictures(folder))), ""
        )
        raise DatasetError(
            f"{folder}: no panorama with depth in layout {kind}: {LAYOUTS[kind].looks_like}"
            + (f" ({len(found)} images, the first without {found[0].depth.relative_to(folder)})" if found else "")
            + (f"; it looks like {other}" if other else "")
        )
    dataset = FolderDataset(folder, kind, size, pairs, [pair.rgb for pair in found if not pair.depth.is_file()])
    if dataset.alone:
        warnings.warn(f"{folder}: {len(dataset.alone)} images have no depth and are skipped; the first is "
                      f"{dataset.alone[0]}", stacklevel=2)  # fmt: skip
    return dataset
