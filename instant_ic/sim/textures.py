"""Procedural textures and their mip pyramids.

Every texture is periodic and has enough high-frequency detail for depth and view synthesis. Lookups are always filtered
(bilinear in the nearest level of a pyramid that is averaged in linear light), like the optics of a camera.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from instant_ic.sim.kept import Arrays, kept

FloatArray = npt.NDArray[np.floating]

#: Largest number of levels, two per octave.
MAX_LEVELS = 24


@dataclass(frozen=True)
class TextureSet:
    """Mip pyramids of several textures in one buffer, in the layout that the kernels read.

    Attributes:
        texels: (N,) uint32, one texel each: red, green, blue in bytes 0..2, as square root of linear albedo · 255. Each
            level has a border of one texel, wrapped or clamped, so that a lookup needs no test at the texture's end.
        level_offset: (T, MAX_LEVELS) int64, index of a level's first entry in ``texels``, the corner of its border.
        level_size: (T, MAX_LEVELS, 2) int32, width and height of a level without the border.
        levels: (T,) int32, number of levels.
        clamp: (T,) uint8, 1 where the texture ends at its border instead of repeating.
        mean: (T, 3) float32, mean linear albedo.
    """

    texels: npt.NDArray[np.uint32]
    level_offset: npt.NDArray[np.int64]
    level_size: npt.NDArray[np.int32]
    levels: npt.NDArray[np.int32]
    clamp: npt.NDArray[np.uint8]
    mean: npt.NDArray[np.float32]


def _halve(image: FloatArray) -> npt.NDArray[np.float32]:
    height, width = image.shape[:2]
    if width > 1:
        even = image[:, : width // 2 * 2]
        image = 0.5 * (even[:, 0::2] + even[:, 1::2])
    if height > 1:
        even = image[: height // 2 * 2]
        image = 0.5 * (even[0::2] + even[1::2])
    return image.astype(np.float32)


def pyramid(albedo: FloatArray) -> list[npt.NDArray[np.float32]]:
    """Return the mip levels of a linear-light image (H, W, 3), two per octave, down to one texel."""
    import cv2

    levels = [np.asarray(albedo, np.float32)]
    while max(levels[-1].shape[:2]) > 1 and len(levels) < MAX_LEVELS - 1:
        whole = levels[-1]
        height, width = (max(1, round(size * math.sqrt(0.5))) for size in whole.shape[:2])
        between = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, 3)
        levels += [np.asarray(between, np.float32), _halve(whole)]
    return levels


def _pack(image: FloatArray, clamp: bool) -> npt.NDArray[np.uint32]:
    image = np.pad(image, ((1, 1), (1, 1), (0, 0)), "edge" if clamp else "wrap")
    root: npt.NDArray[np.uint32] = np.rint(np.sqrt(np.clip(image, 0.0, 1.0)) * 255.0).astype(np.uint32)
    shift = np.asarray([0, 8, 16], np.uint32)
    return np.asarray(np.bitwise_or.reduce(root << shift, axis=-1).ravel(), np.uint32)


@cache
def _packed_named(name: str) -> tuple[list[npt.NDArray[np.uint32]], list[tuple[int, int]], tuple[float, ...]]:
    def make() -> Arrays:
        levels, sizes, mean = _packed(make_texture(name), is_clamped(name))
        return {"texels": np.concatenate(levels), "sizes": np.asarray(sizes), "mean": np.asarray(mean)}

    arrays = kept("texture", [name], make)
    sizes = [(int(width), int(height)) for width, height in arrays["sizes"]]
    ends = np.cumsum([(width + 2) * (height + 2) for width, height in sizes])
    return np.split(arrays["texels"], ends[:-1]), sizes, tuple(arrays["mean"].tolist())


def _packed(
    albedo: FloatArray, clamp: bool
) -> tuple[list[npt.NDArray[np.uint32]], list[tuple[int, int]], tuple[float, ...]]:
    levels = pyramid(albedo)
    mean = tuple(float(c) for c in levels[0].reshape(-1, 3).mean(axis=0))
    return [_pack(level, clamp) for level in levels], [(lv.shape[1], lv.shape[0]) for lv in levels], mean


def texture_set(sources: list[str | FloatArray], clamped: list[bool]) -> TextureSet:
    """Make a texture set from names of procedural textures and linear-light images (H, W, 3) in 0..1."""
    count = len(sources)
    offset = np.zeros((count, MAX_LEVELS), np.int64)
    size = np.ones((count, MAX_LEVELS, 2), np.int32)
    levels = np.zeros(count, np.int32)
    mean = np.zeros((count, 3), np.float32)
    parts: list[npt.NDArray[np.uint32]] = []
    at = 0
    for index, source in enumerate(sources):
        if isinstance(source, str):
            packed, sizes, mean[index] = _packed_named(source)
        else:
            packed, sizes, mean[index] = _packed(source, clamped[index])
        levels[index] = len(packed)
        for level, (part, level_size) in enumerate(zip(packed, sizes, strict=True)):
            offset[index, level] = at
            size[index, level] = level_size
            parts.append(part)
            at += len(part)
    texels = np.concatenate(parts) if parts else np.zeros(1, np.uint32)
    return TextureSet(texels, offset, size, levels, np.asarray(clamped, np.uint8), mean)


# --- procedural textures ------------------------------------------------------------------------------------------


def _noise(rng: np.random.Generator, size: int, beta: float, lowest: float = 1.0) -> npt.NDArray[np.float32]:
    """Make periodic noise of unit variance whose amplitude falls as frequency^-beta above ``lowest`` cycles."""
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    spectrum = np.where(f >= lowest, np.maximum(f, 1.0) ** -beta, 0.0)
    white = rng.standard_normal((size, size)).astype(np.float32)
    field = np.fft.irfft2(np.fft.rfft2(white) * spectrum, s=(size, size))
    return (field / field.std()).astype(np.float32)


def _grey(field: FloatArray, colour: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> npt.NDArray[np.float32]:
    return np.clip(np.asarray(field)[..., None] * np.asarray(colour), 0.0, 1.0).astype(np.float32)


def _paint(rng: np.random.Generator) -> FloatArray:
    """Make roller-painted plaster: faint blotches, fine grain, some scuffs."""
    n = 512
    field = 0.84 + 0.022 * _noise(rng, n, 1.3, 2) + 0.024 * _noise(rng, n, 0.5, 24)
    scuff = np.clip(_noise(rng, n, 1.1, 3) - 2.0, 0, 1.5)
    return _grey(field - 0.10 * scuff)


def _roughcast(rng: np.random.Generator) -> FloatArray:
    n = 512
    field = 0.74 + 0.055 * _noise(rng, n, 0.8, 12) + 0.02 * _noise(rng, n, 1.5, 1)
    return _grey(field)


def _wallpaper(rng: np.random.Generator) -> FloatArray:
    n = 512
    x = np.arange(n)[None, :] / n
    y = np.arange(n)[:, None] / n
    stripes = 0.5 + 0.5 * np.sign(np.sin(2 * np.pi * 16 * x))
    motif = np.exp(-8 * (1 - np.cos(2 * np.pi * 8 * x)) - 6 * (1 - np.cos(2 * np.pi * 8 * y)))
    field = 0.72 + 0.07 * stripes - 0.30 * motif + 0.02 * _noise(rng, n, 0.6, 16)
    return _grey(field)


def _courses(
    rng: np.random.Generator, n: int, rows: int, tones: tuple[float, float], joint: float
) -> tuple[FloatArray, FloatArray]:
    """Make masonry of stones twice as long as high: their tones, and a mask of 0 in joints and 1 on stones, (n, n)."""
    columns = rows // 2
    y, x = np.mgrid[0:n, 0:n] / n
    row = np.floor(y * rows).astype(int)
    shifted = (x * columns + 0.5 * (row % 2)) % columns
    column = np.floor(shifted).astype(int)
    tone = rng.uniform(*tones, (rows, columns))[row, column]
    fy, fx = (y * rows) % 1, shifted % 1
    return tone, np.clip(np.minimum(np.minimum(fx, 1 - fx) * 2.0, np.minimum(fy, 1 - fy)) / joint, 0, 1)


def _brick(rng: np.random.Generator) -> FloatArray:
    n = 512
    tone, stones = _courses(rng, n, 16, (0.42, 0.72), 0.07)
    brick = _grey(tone + 0.05 * _noise(rng, n, 0.6, 8), (0.95, 0.62, 0.48))
    joint = _grey(0.62 + 0.04 * _noise(rng, n, 0.5, 8))
    return np.asarray(joint + (brick - joint) * stones[..., None], np.float32)


def _blocks(rng: np.random.Generator) -> FloatArray:
    """Make concrete blocks with a coat of paint."""
    n = 512
    tone, stones = _courses(rng, n, 10, (0.70, 0.78), 0.05)
    return _grey((tone + 0.035 * _noise(rng, n, 0.6, 16)) * (0.72 + 0.28 * stones))


def _floor_tiles(rng: np.random.Generator) -> FloatArray:
    n, count = 512, 8
    y, x = np.mgrid[0:n, 0:n] / n * count
    iy, ix = np.floor(y).astype(int), np.floor(x).astype(int)
    tone = (0.50 + 0.16 * ((ix + iy) % 2) + rng.uniform(-0.05, 0.05, (count, count))[iy, ix])[..., None]
    colour = np.where(((ix + iy) % 2)[..., None] == 1, (1.0, 0.97, 0.90), (0.78, 0.84, 0.90))
    fx, fy = x % 1, y % 1
    joint = np.clip(np.minimum(np.minimum(fx, 1 - fx), np.minimum(fy, 1 - fy)) / 0.03, 0, 1)[..., None]
    grain = (1 + 0.07 * _noise(rng, n, 0.9, 8) + 0.05 * _noise(rng, n, 0.2, 32))[..., None]
    return np.clip(tone * colour * grain * (0.45 + 0.55 * joint), 0, 1).astype(np.float32)


def _lino(rng: np.random.Generator) -> FloatArray:
    """Make speckled linoleum / terrazzo: small chips of several tones."""
    n = 512
    base = 0.46 + 0.03 * _noise(rng, n, 1.2, 2)
    image = _grey(base, (0.80, 0.86, 0.84))
    for threshold, colour in ((1.6, (0.85, 0.83, 0.76)), (1.8, (0.20, 0.22, 0.24)), (2.1, (0.55, 0.32, 0.22))):
        chips = np.clip((_noise(rng, n, 0.1, 20) * 0.5 + _noise(rng, n, 1.4, 40) - threshold) * 3, 0, 1)[..., None]
        image = image + (np.asarray(colour) - image) * chips
    return np.asarray(image, np.float32)


def _planks(rng: np.random.Generator) -> FloatArray:
    n, rows = 512, 12
    y, x = np.mgrid[0:n, 0:n] / n
    row = np.floor(y * rows).astype(int)
    start = rng.uniform(0, 1, rows)[row]
    piece = np.floor(((x + start) % 1) * 2).astype(int)
    tone = rng.uniform(0.30, 0.50, (rows, 2))[row, piece]
    streak = _noise(rng, n, 1.0, 2)
    grain = np.stack([np.roll(streak[(i * 37) % n], int(s * n)) for i, s in enumerate(rng.uniform(0, 1, n))])
    fine = np.repeat(rng.standard_normal((n, 1)), n, axis=1)
    fy, fx = (y * rows) % 1, ((x + start) * 2) % 1
    gap = np.clip(np.minimum(np.minimum(fx, 1 - fx) * 6, np.minimum(fy, 1 - fy)) / 0.05, 0, 1)
    field = tone * (1 + 0.10 * grain * 0.5 + 0.08 * fine + 0.05 * _noise(rng, n, 0.6, 8)) * (0.5 + 0.5 * gap)
    return _grey(field, (1.0, 0.74, 0.48))


def _carpet(rng: np.random.Generator) -> FloatArray:
    n = 512
    field = 0.34 + 0.05 * _noise(rng, n, 0.15, 8) + 0.03 * _noise(rng, n, 1.4, 1)
    y, x = np.mgrid[0:n, 0:n] / n * 4
    square = ((np.floor(x) + np.floor(y)) % 2) * 0.05
    return _grey(field + square, (0.82, 0.90, 1.0))


def _concrete(rng: np.random.Generator) -> FloatArray:
    n = 512
    pits = np.clip(_noise(rng, n, 0.4, 30) - 2.2, 0, 1)
    field = 0.45 + 0.05 * _noise(rng, n, 1.4, 1) + 0.03 * _noise(rng, n, 0.5, 16) - 0.2 * pits
    return _grey(field, (1.0, 0.98, 0.94))


def _ceiling_tiles(rng: np.random.Generator) -> FloatArray:
    n, count = 512, 4
    y, x = np.mgrid[0:n, 0:n] / n * count
    fx, fy = x % 1, y % 1
    joint = np.clip(np.minimum(np.minimum(fx, 1 - fx), np.minimum(fy, 1 - fy)) / 0.018, 0, 1)
    holes = np.clip(_noise(rng, n, 0.2, 24) - 1.4, 0, 1)
    return _grey((0.84 + 0.02 * _noise(rng, n, 0.6, 8) - 0.22 * holes) * (0.60 + 0.40 * joint))


def _wood(rng: np.random.Generator) -> FloatArray:
    """Make veneer with vertical grain (v runs along the grain)."""
    n = 256
    column = _noise(rng, n, 0.9, 2)[0]
    wave = _noise(rng, n, 2.0, 1) * 5
    index = (np.arange(n)[None, :] + wave).astype(int) % n
    field = 0.42 + 0.06 * column[index] + 0.02 * _noise(rng, n, 0.4, 16)
    return _grey(field, (1.0, 0.70, 0.42))


def _white(rng: np.random.Generator) -> FloatArray:
    """Make a white board or box: almost no contrast (the obstacle of the paper's Fig. 9)."""
    return _grey(0.84 + 0.006 * _noise(rng, 256, 0.8, 4))


def _metal(rng: np.random.Generator) -> FloatArray:
    n = 256
    brushed = np.repeat(rng.standard_normal((n, 1)), n, axis=1)
    return _grey(0.50 + 0.02 * brushed + 0.02 * _noise(rng, n, 0.5, 8), (0.94, 0.97, 1.0))


def _fabric(rng: np.random.Generator) -> FloatArray:
    n = 256
    y, x = np.mgrid[0:n, 0:n] / n
    weave = np.sin(2 * np.pi * 32 * x) * np.sin(2 * np.pi * 32 * y)
    return _grey(0.60 + 0.08 * weave + 0.06 * _noise(rng, n, 0.6, 4))


def _cardboard(rng: np.random.Generator) -> FloatArray:
    n = 256
    field = 0.52 + 0.02 * _noise(rng, n, 1.0, 2) + 0.015 * _noise(rng, n, 0.3, 16)
    image = _grey(field, (1.0, 0.78, 0.54))
    image[n // 2 - 12 : n // 2 + 12] = image[n // 2 - 12 : n // 2 + 12] * 0.5 + np.asarray((0.40, 0.34, 0.24))
    image[n // 5 : n // 5 + 30, 30:90] *= 0.35
    return np.clip(image, 0, 1).astype(np.float32)


def _books(rng: np.random.Generator) -> FloatArray:
    """Make the front of a bookcase: five shelves of spines."""
    height, width, shelves = 512, 256, 5
    image = np.full((height, width, 3), 0.05, np.float32)
    each = height // shelves
    for shelf in range(shelves):
        bottom = (shelf + 1) * each - 8
        image[bottom : bottom + 8] = (0.40, 0.27, 0.15)
        x = 4
        while x < width - 8:
            w = int(rng.integers(4, 13))
            tall = int(each * rng.uniform(0.55, 0.88))
            colour = np.clip(rng.uniform(0.05, 0.7, 3) * rng.uniform(0.4, 1.1), 0, 1)
            if rng.random() < 0.93:
                image[bottom - tall : bottom, x : x + w - 1] = colour
                band = bottom - int(tall * rng.uniform(0.6, 0.85))
                image[band : band + 6, x : x + w - 1] = np.clip(colour * 0.3 + 0.5, 0, 1)
            x += w
    return image


def _door(rng: np.random.Generator) -> FloatArray:
    """Make one door leaf with two recessed fields and a handle; not periodic."""
    height, width = 512, 224
    wood = np.tile(_wood(rng), (2, 1, 1))[:height, :width]
    image = wood * np.asarray((1.05, 1.0, 0.95))
    for top, bottom in ((40, 220), (260, 470)):
        image[top:bottom, 34 : width - 34] *= 0.86
        image[top : top + 5, 34 : width - 34] *= 0.55
        image[top:bottom, 34:39] *= 0.6
        image[bottom - 5 : bottom, 34 : width - 34] = image[bottom - 5 : bottom, 34 : width - 34] * 0.6 + 0.3
    image[262:270, width - 30 : width - 8] = 0.7
    image[256:276, width - 14 : width - 8] = 0.55
    return np.clip(image, 0, 1).astype(np.float32)


def _poster(rng: np.random.Generator) -> FloatArray:
    """Make a printed sheet: a title, an image of coloured shapes, lines of text."""
    height, width = 384, 272
    paper = np.asarray(rng.uniform(0.62, 0.86, 3), np.float32)
    image = np.ones((height, width, 3), np.float32) * paper
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    picture = (y > 70) & (y < 250) & (x > 20) & (x < width - 20)
    sky = rng.uniform(0.1, 0.8, 3)
    image[picture] = sky
    image[picture] *= (0.6 + 0.4 * (y[picture] - 70) / 180)[:, None]
    for _ in range(9):
        cx, cy, r = rng.uniform(30, width - 30), rng.uniform(80, 240), rng.uniform(8, 45)
        if rng.random() < 0.5:
            inside = np.hypot(x - cx, y - cy) < r
        else:
            inside = np.abs(x - cx) + np.abs(y - cy) * rng.uniform(0.5, 2) < r
        image[inside & picture] = rng.uniform(0.02, 0.85, 3)
    ink = rng.uniform(0.02, 0.15, 3)

    def text(top: int, size: int, left: int, right: int) -> None:
        at = left
        while at < right:
            w = int(rng.integers(max(size // 3, 2), size + 2))
            image[top : top + size, at : min(at + w, right)] = ink
            at += w + max(size // 3, 2)

    text(24, 22, 24, int(width * rng.uniform(0.7, 0.9)))
    for line in range(int(rng.integers(5, 9))):
        text(268 + line * 12, 6, 24, int(width * rng.uniform(0.6, 0.92)))
    image[:4] = image[-4:] = 0.12
    image[:, :4] = image[:, -4:] = 0.12
    return np.clip(image, 0, 1)


def _notices(rng: np.random.Generator) -> FloatArray:
    """Make a notice board with pinned sheets."""
    height, width = 256, 448
    cork = _grey(0.40 + 0.06 * _noise(rng, 512, 0.3, 16), (1.0, 0.70, 0.42))[:height, :width].copy()
    for _ in range(16):
        h, w = int(rng.integers(50, 96)), int(rng.integers(38, 80))
        top, left = int(rng.integers(8, height - h - 8)), int(rng.integers(8, width - w - 8))
        sheet = np.clip(rng.uniform(0.55, 0.9) * rng.uniform(0.75, 1.0, 3), 0, 1)
        cork[top : top + h, left : left + w] = sheet
        for line in range(top + 9, top + h - 6, 7):
            cork[line : line + 3, left + 6 : left + int(w * rng.uniform(0.6, 0.92))] = 0.10
        cork[top + 2 : top + 7, left + w // 2 : left + w // 2 + 5] = (0.7, 0.05, 0.05)
    cork[:6] = cork[-6:] = 0.30
    cork[:, :6] = cork[:, -6:] = 0.30
    return np.clip(cork, 0, 1).astype(np.float32)


def _window(rng: np.random.Generator) -> FloatArray:
    """Make the view through a sash window: sky, distant houses, trees."""
    height, width = 320, 384
    y = np.arange(height)[:, None] / height
    sky = np.stack([0.62 + 0.3 * y, 0.76 + 0.2 * y, np.full_like(y, 0.98)], axis=-1)
    image = np.repeat(sky, width, axis=1)
    cloud = np.clip(_noise(rng, 512, 1.5, 2)[:height, :width] * 0.25, 0, 0.5)[..., None]
    image = image + (1.0 - image) * cloud
    x = 0
    while x < width:
        w, top = int(rng.integers(24, 80)), int(height * rng.uniform(0.42, 0.66))
        colour = rng.uniform(0.22, 0.5, 3)
        image[top:, x : x + w] = colour
        for wy in range(top + 8, height - 8, 16):
            for wx in range(x + 5, min(x + w, width) - 8, 12):
                image[wy : wy + 9, wx : wx + 6] = colour * (0.4 if rng.random() < 0.7 else 1.5)
        x += w
    leaves = _noise(rng, 512, 0.9, 6)[:height, :width]
    crown = height * (0.80 + 0.06 * np.sin(np.arange(width) / 37.0) + 0.04 * np.sin(np.arange(width) / 11.0))
    tree = np.arange(height)[:, None] > crown[None, :]
    image[tree] = np.stack([0.12 + 0.04 * leaves, 0.26 + 0.08 * leaves, 0.08 + 0.02 * leaves], axis=-1)[tree]
    frame = np.asarray((0.80, 0.80, 0.78))
    for start in (0, width // 2 - 6, width - 12):
        image[:, start : start + 12] = frame
    for start in (0, height // 3 - 4, height - 12):
        image[start : start + (12 if start != height // 3 - 4 else 8)] = frame
    return np.clip(image, 0, 1).astype(np.float32)


def _lamp(rng: np.random.Generator) -> FloatArray:
    """Make the diffuser of a ceiling light: a grid of prisms."""
    n = 128
    y, x = np.mgrid[0:n, 0:n] / n
    return _grey(0.94 + 0.05 * np.sin(2 * np.pi * 16 * x) * np.sin(2 * np.pi * 16 * y))


#: Generators of textures by name. Their order is part of each texture's seed, so new ones must come last.
_GENERATORS: dict[str, Callable[[np.random.Generator], FloatArray]] = {
    make.__name__.removeprefix("_"): make
    for make in (
        _paint, _roughcast, _wallpaper, _brick, _blocks, _floor_tiles, _lino, _planks, _carpet, _concrete,
        _ceiling_tiles, _wood, _white, _metal, _fabric, _cardboard, _books, _door, _poster, _notices, _window, _lamp,
    )
}  # fmt: skip

#: Textures that end at their border (one image stretched over its surface).
CLAMPED = frozenset({"books", "door", "poster", "notices", "window", "cardboard"})


def make_texture(name: str) -> npt.NDArray[np.float32]:
    """Make the linear albedo (H, W, 3) of a texture named ``kind`` or ``kind:variant`` (variant: an integer seed).

    Raises:
        ValueError: the kind is unknown.
    """
    kind, _, variant = name.partition(":")
    if kind not in _GENERATORS:
        raise ValueError(f"no procedural texture {kind!r}; available: {', '.join(sorted(_GENERATORS))}")
    rng = np.random.default_rng([list(_GENERATORS).index(kind), int(variant or 0)])
    return np.asarray(_GENERATORS[kind](rng), np.float32)


def is_clamped(name: str) -> bool:
    """Return whether a procedural texture ends at its border instead of repeating."""
    return name.partition(":")[0] in CLAMPED
