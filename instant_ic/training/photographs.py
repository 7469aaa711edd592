"""Photographic textures for training worlds, unpacked from a wheel because they are not in this repository."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.colour import srgb_to_linear
from instant_ic.sim.textures import TextureSet, texture_set
from instant_ic.sim.world import World
from instant_ic.training.dataset import DatasetError

SIZE = 512
WHEEL_FOLDER = "robosuite/models/assets/textures/"
"""Folder of the textures in the wheel of robosuite (MIT licence)."""
NOT_A_SURFACE = ("bread", "can", "cereal", "lemon", "soda", "glass")
PHOTO_SHARE = 0.75


def unpack(wheel: Path, folder: Path) -> int:
    """Write the surface textures of a robosuite wheel into a folder as JPEG of at most ``SIZE``; return their number.

    Raises:
        DatasetError: the file is not a wheel of robosuite, or a texture in it cannot be decoded.
    """
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    try:
        with zipfile.ZipFile(wheel) as archive:
            for name in archive.namelist():
                stem = Path(name).stem
                if not (name.startswith(WHEEL_FOLDER) and name.endswith(".png")) or stem in NOT_A_SURFACE:
                    continue
                image = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_COLOR)
                if image is None:
                    raise DatasetError(f"{wheel}: {name} cannot be decoded as an image")
                scale = min(1.0, SIZE / max(image.shape[:2]))
                image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(folder / f"{stem}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 92])
                count += 1
    except (OSError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{wheel}: not a wheel that can be read ({error})") from error
    if count == 0:
        raise DatasetError(f"{wheel}: no textures under {WHEEL_FOLDER}; give a wheel of robosuite 1.5")
    return count


@lru_cache(maxsize=1)
def load(folder: str) -> TextureSet:
    """Return the texture set of all images of a folder.

    Raises:
        DatasetError: the folder has no image that can be read.
    """
    images = []
    for path in sorted(Path(folder).glob("*.jpg")) + sorted(Path(folder).glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise DatasetError(f"{path}: cannot be decoded as an image")
        images.append(srgb_to_linear(image[..., ::-1].astype(np.float32) / 255))
    if not images:
        raise DatasetError(f"{folder}: no textures (*.jpg, *.png); make them with ic depth textures")
    return texture_set(list(images), [False] * len(images))


def with_photographs(world: World, folder: str, rng: np.random.Generator) -> World:
    """Return the world with most repeating textures exchanged for random photographs of about the same brightness."""
    own, photos = world.textures, load(folder)
    count = len(own.levels)
    joined = TextureSet(
        np.concatenate([own.texels, photos.texels]),
        np.concatenate([own.level_offset, photos.level_offset + len(own.texels)]),
        *(np.concatenate([getattr(own, k), getattr(photos, k)]) for k in ("level_size", "levels", "clamp", "mean")),
    )
    index: NDArray[np.int32] = np.arange(count, dtype=np.int32)
    exchanged = (own.clamp == 0) & (rng.random(count) < PHOTO_SHARE)
    index[exchanged] = count + rng.integers(0, len(photos.levels), int(exchanged.sum()))
    texture = index[world.texture]
    # A dark wood instead of white paint would make the baked light of the room implausible.
    ratio = (own.mean.mean(1)[world.texture] + 0.05) / (joined.mean.mean(1)[texture] + 0.05)
    tint = world.tint * np.clip(ratio, 0.5, 2.0)[:, None].astype(np.float32) ** np.float32(0.7)
    return replace(world, texture=texture, tint=tint, textures=joined)
