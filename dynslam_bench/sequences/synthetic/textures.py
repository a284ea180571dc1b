"""Procedural textures, drawn from a seed and packed with their mip levels into one atlas."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.sequences.synthetic.arithmetic import exp, sin

Image = NDArray[np.float64]
"""Float ``[S, S, 3]`` in 0-255, S a power of two; it wraps around."""


class TextureAtlas(NamedTuple):
    """All T textures and their mip levels as one array.

    Attributes:
        texels: uint8, four bytes a texel (the last unused), level after level, texture after
            texture.
        level_offset: int64 ``[T, L]`` offset of each level's first byte.
        log2_size: int32 ``[T]`` base-2 logarithm of each texture's edge.
    """

    texels: NDArray[np.uint8]
    level_offset: NDArray[np.int64]
    log2_size: NDArray[np.int32]


_LEVELS = 12
"""Mip levels of a texture, at most: of an edge of 2048 texels."""


def build_atlas(textures: list[Image]) -> TextureAtlas:
    """Pack textures with their mipmaps: each is halved by 2x2 means down to one texel.

    Args:
        textures: Colours ``[S, S, 3]`` from 0 to 255, red first; S is a power of two.
    """
    level_offset = np.zeros((len(textures), _LEVELS), np.int64)
    log2_size = np.zeros(len(textures), np.int32)
    parts: list[NDArray[np.uint8]] = []
    position = 0
    for index, image in enumerate(textures):
        # halve the image until one texel is left
        log2_size[index] = len(image).bit_length() - 1
        current = np.clip(image, 0, 255)
        for level in range(_LEVELS):
            # levels that the texture does not have are its last one
            level_offset[index, level:] = position
            # four bytes a texel, so that its address is a shift; the last byte stays empty
            texels = np.zeros((*current.shape[:2], 4), np.uint8)
            texels[..., :3] = np.floor(current + 0.5)
            parts.append(texels.ravel())
            position += texels.size
            if current.shape[0] == 1:
                break
            current = 0.25 * (
                current[::2, ::2] + current[1::2, ::2] + current[::2, 1::2] + current[1::2, 1::2]
            )
    return TextureAtlas(np.concatenate(parts), level_offset, log2_size)


def smooth_noise(
    rng: np.random.Generator, size: int, cells: int, cells_v: int | None = None
) -> NDArray[np.float64]:
    """Wrapping value noise in [-1, 1], ``[size, size]``, with `cells` x `cells_v` lattice cells, smoothly blended.

    Args:
        rng: Draws the lattice.
        size: Edge of the texture, texels.
        cells: Cells along u.
        cells_v: Cells along v; None for as many.
    """
    cells_v = cells if cells_v is None else cells_v
    lattice = rng.random((cells_v, cells)) * 2 - 1

    def corners_and_blend(
        n: int,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """The lattice points before and after each pixel along one axis, and the second one's weight."""
        x = np.arange(size) * n / size
        i = np.floor(x).astype(np.int64)
        f = x - i
        return i % n, (i + 1) % n, f * f * (3 - 2 * f)

    # bilinear between the lattice points, with smooth weights
    u0, u1, fu = corners_and_blend(cells)
    v0, v1, fv = corners_and_blend(cells_v)
    top = lattice[v0][:, u0] * (1 - fu) + lattice[v0][:, u1] * fu
    bottom = lattice[v1][:, u0] * (1 - fu) + lattice[v1][:, u1] * fu
    return top * (1 - fv[:, None]) + bottom * fv[:, None]


def fractal(rng: np.random.Generator, size: int, cells: int, octaves: int) -> NDArray[np.float64]:
    """Sum of octaves of `smooth_noise`, each half as strong as the one before; about [-1, 1]."""
    total = np.zeros((size, size))
    for octave in range(octaves):
        total += smooth_noise(rng, size, cells << octave) * 0.5**octave
    return total / 1.5


def _gray(values: NDArray[np.float64]) -> Image:
    """A grey image ``[S, S, 3]`` of values ``[S, S]``."""
    return np.repeat(values[..., None], 3, axis=2)


def plain(rng: np.random.Generator, size: int = 64, contrast: float = 4.0) -> Image:
    """A nearly even surface, to be tinted."""
    return _gray(235 + contrast * fractal(rng, size, 8, 3))


def plaster(rng: np.random.Generator, size: int = 512) -> Image:
    """A painted wall: slow unevenness and fine grain."""
    return _gray(228 + 9 * fractal(rng, size, 3, 3) + 3 * smooth_noise(rng, size, 128))


def wood(rng: np.random.Generator, size: int = 256) -> Image:
    """Wood grain along u."""
    # wavy rings across v, and streaks along u
    warp = 6 * fractal(rng, size, 4, 2)
    v = np.arange(size)[:, None] + warp
    rings = sin(v * 2 * np.pi * 9 / size) * 0.5 + sin(v * 2 * np.pi * 23 / size + 1.3) * 0.3
    streak = smooth_noise(rng, size, 8, 128)
    return _gray(198 + 16 * rings + 14 * streak)


def carpet(rng: np.random.Generator, size: int = 512) -> Image:
    """Office carpet tiles: speckle, faint tile joints."""
    values = 200 + 14 * fractal(rng, size, 24, 3) + 12 * (rng.random((size, size)) - 0.5)
    # distance to the next joint: a tile is half the texture
    in_tile = np.arange(size) % (size // 2)
    joint = np.minimum(in_tile, size // 2 - in_tile)
    values -= 10 * exp(-((joint[:, None] / 1.5) ** 2)) + 10 * exp(-((joint[None, :] / 1.5) ** 2))
    return _gray(values)


def _rect(
    image: Image, u0: float, v0: float, u1: float, v1: float, color: NDArray[np.float64]
) -> None:
    """Fill a rectangle; its corners are given as shares of the image's edge."""
    size = image.shape[0]
    rows = slice(int(max(v0, 0) * size), int(min(v1, 1) * size))
    columns = slice(int(max(u0, 0) * size), int(min(u1, 1) * size))
    image[rows, columns] = color


def _text(
    rng: np.random.Generator,
    image: Image,
    area: tuple[float, float, float, float],
    lines: int,
    color: NDArray[np.float64],
) -> None:
    """Rows of word-like dashes in the area u0, v0, u1, v1."""
    # lines of full or shorter length, words of different lengths with gaps between them
    u0, v0, u1, v1 = area
    pitch = (v1 - v0) / lines
    for line in range(lines):
        u = u0
        end = u0 + (u1 - u0) * (1.0 if rng.random() < 0.7 else 0.3 + 0.6 * rng.random())
        while u < end:
            word = (u1 - u0) * (0.04 + 0.12 * rng.random())
            _rect(image, u, v0 + line * pitch, min(u + word, end), v0 + (line + 0.5) * pitch, color)
            u += word + (u1 - u0) * 0.025


def poster(rng: np.random.Generator, size: int = 256) -> Image:
    """A poster: a ground, a picture of discs and bars, a headline and text."""
    # ground and headline
    ground = 150 + 100 * rng.random(3)
    image = np.tile(ground, (size, size, 1))
    ink = 20 + 90 * rng.random(3)
    _rect(image, 0.03, 0.03, 0.97, 0.97, ground * 0.92)
    _rect(image, 0.1, 0.06, 0.55 + 0.3 * rng.random(), 0.13, ink)
    # a picture with discs, cut at its frame, ...
    yy, xx = (np.mgrid[0:size, 0:size] + 0.5) / size
    left = 0.08
    right = 0.92
    top = 0.18
    bottom = 0.62
    in_picture = (yy > top) & (yy < bottom) & (xx > left) & (xx < right)
    _rect(image, left, top, right, bottom, 60 + 150 * rng.random(3))
    for _ in range(int(rng.integers(5, 10))):
        u = 0.15 + 0.7 * rng.random()
        v = top + 0.06 + (bottom - top - 0.12) * rng.random()
        radius = 0.03 + 0.1 * rng.random()
        in_disc = (xx - u) ** 2 + (yy - v) ** 2 < radius * radius
        image[in_disc & in_picture] = 40 + 200 * rng.random(3)
    # ... and bars
    for _ in range(int(rng.integers(2, 5))):
        u = 0.1 + 0.6 * rng.random()
        v = top + (bottom - top) * 0.8 * rng.random()
        end = min(u + 0.2 * rng.random() + 0.05, right)
        _rect(image, u, v, end, min(v + 0.12, bottom), 40 + 200 * rng.random(3))
    # two columns of text
    _text(rng, image, (0.08, 0.67, 0.47, 0.95), 8, ink)
    _text(rng, image, (0.53, 0.67, 0.92, 0.95), 8, ink)
    return image


def screen(rng: np.random.Generator, size: int = 256) -> Image:
    """A monitor's picture: windows with title bars and text."""
    image = np.tile(np.array([40.0, 70.0, 110.0]) + 50 * rng.random(3), (size, size, 1))
    # three windows, each with a title bar and text
    for _ in range(3):
        u = 0.02 + 0.4 * rng.random()
        v = 0.02 + 0.35 * rng.random()
        w = 0.35 + 0.2 * rng.random()
        h = 0.35 + 0.25 * rng.random()
        dark = rng.random() < 0.4
        background = np.full(3, 40.0 if dark else 235.0)
        ink = np.full(3, 200.0 if dark else 60.0)
        _rect(image, u, v, u + w, v + h, background)
        _rect(image, u, v, u + w, v + 0.05, 90 + 90 * rng.random(3))
        _text(rng, image, (u + 0.02, v + 0.08, u + w - 0.03, v + h - 0.03), 8, ink)
    # the task bar
    _rect(image, 0, 0.95, 1, 1, np.full(3, 60.0))
    return image


def books(rng: np.random.Generator, size: int = 256) -> Image:
    """A row of book spines of different colours and heights, with titles."""
    image = np.full((size, size, 3), 45.0)
    u = 0
    while u < size:
        # a spine
        w = int(rng.integers(size // 24, size // 10))
        share = rng.random()
        top = int(size * 0.3 * share * share)
        color = 50 + 170 * rng.random(3)
        image[top:, u : u + w] = color
        # a dark line between it and the book before
        image[top:, u : u + 1] = color * 0.5
        # its title
        if rng.random() < 0.8:
            v = top + int(size * (0.1 + 0.2 * rng.random()))
            title = slice(u + w // 3, u + max(2 * w // 3, w // 3 + 2))
            image[v : v + int(size * 0.25), title] = 255 - 0.6 * color
        u += w
    return image


def keyboard(rng: np.random.Generator, size: int = 256) -> Image:
    """Keys on a dark base."""
    image = np.full((size, size, 3), 40.0)
    for row in range(5):
        for key in range(15):
            shade = np.full(3, 75 + 20 * rng.random())
            left = (key + 0.12) / 15
            right = (key + 0.9) / 15
            _rect(image, left, (row + 0.1) / 5, right, (row + 0.85) / 5, shade)
    return image


def plaid(rng: np.random.Generator, size: int = 256) -> Image:
    """A plaid weave: crossing bands of three colours, one tile of the repeat."""
    base, second, third = (30 + 200 * rng.random(3) for _ in range(3))
    # the first two must differ in brightness
    while abs(base.mean() - second.mean()) < 60:
        second = 20 + 220 * rng.random(3)
    repeats = 2
    t = (np.arange(size) * repeats / size) % 1.0

    def bands() -> NDArray[np.float64]:
        """Bands of the second and the third colour along one axis ``[S, 2]``."""
        centres = rng.random(3)
        widths = 0.05 + 0.12 * rng.random(3)
        weight = np.zeros((size, 2))
        for i in range(3):
            # distance on a circle: the texture wraps around
            near = np.abs((t - centres[i] + 0.5) % 1.0 - 0.5) < widths[i]
            weight[near, i % 2] = 1.0
        return weight

    # bands along both axes, blended over the ground, and the weave's diagonal
    bu = bands()
    bv = bands()
    image = np.tile(base, (size, size, 1))
    for weight, color in ((0, second), (1, third)):
        alpha = 0.45 * bu[None, :, weight] + 0.45 * bv[:, None, weight]
        image = image * (1 - alpha[..., None]) + color * alpha[..., None]
    twill = ((np.arange(size)[:, None] + np.arange(size)[None, :]) % 4 < 2) * 8.0 - 4.0
    return image + twill[..., None]


def print_shirt(rng: np.random.Generator, size: int = 256) -> Image:
    """A shirt with an all-over print of discs, bars and letters."""
    base = 40 + 190 * rng.random(3)
    image = np.tile(base, (size, size, 1))
    yy, xx = (np.mgrid[0:size, 0:size] + 0.5) / size
    # discs, bars and rings
    for _ in range(26):
        color = 20 + 225 * rng.random(3)
        u = rng.random()
        v = rng.random()
        r = 0.03 + 0.06 * rng.random()
        # distance to its centre on a torus: the texture wraps around
        du = (xx - u + 0.5) % 1 - 0.5
        dv = (yy - v + 0.5) % 1 - 0.5
        square = du * du + dv * dv
        disc = square < r * r
        bar = (np.abs(du) < r) & (np.abs(dv) < 0.35 * r)
        ring = (np.sqrt(square) < r) & (np.sqrt(square) > 0.6 * r)
        image[(disc, bar, ring)[rng.integers(3)]] = color
    return image + 4 * fractal(rng, size, 32, 2)[..., None]


def stripes(rng: np.random.Generator, size: int = 256) -> Image:
    """Horizontal stripes of two colours and a few widths."""
    first = 30 + 100 * rng.random(3)
    second = 140 + 110 * rng.random(3)
    image = np.tile(first, (size, size, 1))
    v = 0
    while v < size:
        # a stripe, then a gap, pixels
        w = int(rng.integers(8, 22))
        gap = int(rng.integers(8, 26))
        image[v : v + w] = second
        v += w + gap
    return image + 5 * fractal(rng, size, 32, 2)[..., None]


def denim(rng: np.random.Generator, size: int = 256) -> Image:
    """Woven trousers: fine diagonal grain and worn patches, to be tinted."""
    diagonal = ((np.arange(size)[:, None] * 2 + np.arange(size)[None, :]) % 6 < 3) * 12.0
    return _gray(200 + diagonal + 16 * fractal(rng, size, 6, 4))


def hair(rng: np.random.Generator, size: int = 128) -> Image:
    """Strands along v, to be tinted."""
    return _gray(190 + 45 * smooth_noise(rng, size, 64, 4) + 20 * smooth_noise(rng, size, 16, 2))


def face(rng: np.random.Generator, size: int = 256) -> Image:
    """A face, unrolled: u = 0.5 is the front, v from the crown (0) to the chin (1); to be tinted with the skin."""
    # pale skin, slightly uneven
    image = (
        np.tile(np.array([240.0, 236.0, 232.0]), (size, size, 1))
        + 4 * fractal(rng, size, 8, 3)[..., None]
    )
    yy, xx = (np.mgrid[0:size, 0:size] + 0.5) / size

    def blob(
        u: float, v: float, ru: float, rv: float, color: tuple[float, float, float], strength: float
    ) -> None:
        """Blend a soft ellipse with radii `ru` and `rv` about (u, v) into the image."""
        d = ((xx - u) / ru) ** 2 + ((yy - v) / rv) ** 2
        alpha = np.clip(1.6 * (1.2 - d), 0, 1)[..., None] * strength
        image[:] = image * (1 - alpha) + np.array(color) * alpha

    # on either side socket, white and iris of the eye, brow, and cheek
    gap = 0.075 + 0.01 * rng.random()
    for side in (-1, 1):
        blob(0.5 + side * gap, 0.43, 0.042, 0.034, (190, 170, 165), 0.7)
        blob(0.5 + side * gap, 0.44, 0.032, 0.018, (250, 250, 250), 1.0)
        blob(0.5 + side * gap, 0.44, 0.013, 0.016, (50, 40, 35), 1.0)
        blob(0.5 + side * gap, 0.375, 0.048, 0.012, (90, 70, 60), 0.9)
        blob(0.5 + side * 0.13, 0.6, 0.05, 0.06, (245, 200, 190), 0.35)
    # nose and mouth
    blob(0.5, 0.6, 0.035, 0.02, (180, 150, 145), 0.6)
    blob(0.5, 0.715, 0.06, 0.018, (190, 100, 100), 0.9)
    blob(0.5, 0.716, 0.055, 0.005, (110, 50, 50), 0.8)
    return image


MAKERS: dict[str, Callable[[np.random.Generator], Image]] = {
    "plain": plain,
    "plaster": plaster,
    "wood": wood,
    "carpet": carpet,
    "poster": poster,
    "screen": screen,
    "books": books,
    "keyboard": keyboard,
    "plaid": plaid,
    "print": print_shirt,
    "stripes": stripes,
    "denim": denim,
    "hair": hair,
    "face": face,
}
"""Texture makers by kind; a texture is named ``kind`` or ``kind:variant``."""
