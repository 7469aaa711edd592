"""Folders of panoramas with depth for a training: rendered ones, and plain images with depth files."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.files import DEPTH_SUFFIXES, PICTURE_SUFFIXES, DepthFileError, load_depth, load_picture
from instant_ic.training.dataset import DatasetError, RenderedDataset, Sample

_HELD_OUT_SHARE = 0.08
_MOST_UNREADABLE = 0.01
_LOOKS_LIKE = "rgb/[SCENE/]NAME.jpg (or png) with depth/[SCENE/]NAME.png (millimetres), .npy, .npz or .exr (metres)"


@dataclass(frozen=True)
class DepthPair:
    """The files of a panorama and its depth, and the scene that they show."""

    rgb: Path
    depth: Path
    scene: str


@dataclass
class PlainFolder:
    """Panoramas of a folder, resized on reading: images by area averaging, depth by the nearest pixel.

    Attributes:
        folder: folder with ``rgb`` and ``depth``.
        size: height and width of the samples.
        pairs: files of the panoramas.
        unreadable: errors of damaged files by index; up to 1 % of the panoramas are skipped with a warning.
    """

    folder: Path
    size: tuple[int, int]
    pairs: list[DepthPair]
    unreadable: dict[int, str] = field(default_factory=dict)

    @property
    def info(self) -> dict[str, Any]:
        """Recipe for the training record, without the local path."""
        scenes = {pair.scene for pair in self.pairs}
        return {"kind": "plain", "folder": self.folder.name, "count": len(self.pairs), "scenes": len(scenes)}

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
        pair, (height, width) = self.pairs[index], self.size
        rgb, depth = load_picture(pair.rgb), load_depth(pair.depth)
        for path, shape in ((pair.rgb, rgb.shape), (pair.depth, depth.shape)):
            if shape[1] != 2 * shape[0]:
                raise DatasetError(f"{path}: {shape[1]} x {shape[0]} is not an equirect panorama (2:1)")
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        depth = np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
        return Sample(rgb, depth, index)

    def split(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the indices for training and for evaluation; the last scenes are held out.

        Raises:
            DatasetError: no panoramas for training.
        """
        scenes = sorted({pair.scene for pair in self.pairs})
        last = set(scenes[-max(1, round(len(scenes) * _HELD_OUT_SHARE)) :])
        held = np.array([pair.scene in last for pair in self.pairs])
        if held.all():
            raise DatasetError(f"{self.folder}: all {len(self)} panoramas are of one scene, which is reserved for "
                               "evaluation; add scenes for training")  # fmt: skip
        return np.flatnonzero(~held), np.flatnonzero(held)


def open_folder(name: str, size: tuple[int, int]) -> PlainFolder | RenderedDataset:
    """Open the panoramas that a user named.

    Args:
        name: ``LAYOUT:FOLDER`` with the layout ``rendered`` or ``plain``.
        size: height and width of the samples.

    Raises:
        DatasetError: unknown layout, missing folder, or no files in this layout.
    """
    kind, colon, place = name.partition(":")
    if kind not in ("rendered", "plain") or not colon:
        raise DatasetError(f"{name!r}: expected LAYOUT:FOLDER with LAYOUT rendered or plain")
    folder = Path(place).expanduser()
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder")
    return RenderedDataset(folder, size) if kind == "rendered" else _plain(folder, size)


def _plain(folder: Path, size: tuple[int, int]) -> PlainFolder:
    rgbs, depths = _files(folder / "rgb", PICTURE_SUFFIXES), _files(folder / "depth", DEPTH_SUFFIXES)
    pairs = [DepthPair(rgb, depths[name], str(name.parent if name.parent != Path() else name))
             for name, rgb in rgbs.items() if name in depths]  # fmt: skip
    alone = [rgb for name, rgb in rgbs.items() if name not in depths]
    first = f"{len(alone)} images have no depth; the first is {alone[0]}" if alone else ""
    if not pairs:
        raise DatasetError(f"{folder}: no panorama with depth: expected {_LOOKS_LIKE}. {first}")
    if alone:
        warnings.warn(f"{folder}: skipped: {first}", stacklevel=3)
    return PlainFolder(folder, size, pairs)


def _files(folder: Path, suffixes: tuple[str, ...]) -> dict[Path, Path]:
    """Return the files with one of the suffixes by their path in the folder without suffix."""
    found = (path for path in sorted(folder.rglob("*")) if path.suffix.lower() in suffixes)
    return {path.relative_to(folder).with_suffix(""): path for path in found}
