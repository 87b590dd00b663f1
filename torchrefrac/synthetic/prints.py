"""What is printed or painted: labels, a checkerboard, wood, tiles, drawn from a seed, as RGB images."""

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from torchrefrac.synthetic.patterns import Colours, noise

Colour = tuple[float, float, float]
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_COMPLEX)
SYLLABLES = (
    "ka", "ro", "mi", "len", "tor", "ba", "su", "no", "del", "fi", "gra", "ve", "lu", "an", "pe", "sto", "ri", "qua",
    "em", "dor",
)  # fmt: skip


def label(
    size: tuple[int, int], seed: int, *, words: str, ground: Colour = (176.0, 52.0, 40.0), ink: Colour = (240, 226, 190)
) -> Colours:
    """A packet's print: `words` in large letters, bands, blocks of small print, a picture and a bar code."""
    rng = np.random.default_rng(seed)
    height, width = size
    image = np.full((height, width, 3), ground, dtype=np.float32)
    image *= 1.0 + 0.13 * noise(size, rng, finest=max(size) / 6, decay=0.6)[..., None]
    image = image.clip(0, 255).astype(np.uint8)
    unit = min(height, width)
    for _ in range(14):
        corner = rng.random(2) * (width, height)
        left, top, right, bottom = np.rint((*corner, *(corner + rng.uniform(0.06, 0.3, 2) * unit))).astype(int)
        shade = np.asarray(ground) * rng.uniform(0.35, 1.6) + rng.normal(0, 30, 3)
        image[max(top, 0) : bottom, max(left, 0) : right] = shade.clip(0, 255)
    for _ in range(10):
        _picture(image, rng.random(2) * (width, height), rng.uniform(0.05, 0.14) * unit, rng)
    for row in np.arange(0.04, 0.98, 0.115):
        _small_print(image, (0.03 + 0.3 * rng.random(), row), unit, ink, rng)
    for row in (0.12, 0.5, 0.88):
        _band(image, int((row + rng.uniform(-0.03, 0.03)) * height), unit, ink, rng)
    _bar_code(image, unit, rng)
    scale = 0.9 * width / cv2.getTextSize(words, FONTS[2], 1.0, 1)[0][0]
    scale = min(scale, 0.22 * height / 22.0)
    thick = max(2, int(2.2 * scale))
    for row in (0.34, 0.76):
        where = (int(rng.uniform(0.02, 0.08) * width), int(row * height))
        cv2.putText(image, words, where, FONTS[2], scale, (20.0, 18.0, 22.0), thick + max(3, unit // 90), cv2.LINE_AA)
        cv2.putText(image, words, where, FONTS[2], scale, ink, thick, cv2.LINE_AA)
    return _worn(image, rng)


def checkerboard(size: tuple[int, int], seed: int, *, columns: int, rows: int) -> Colours:
    """Light and dark squares, each with a word of its own, on paper with stains and dirt."""
    rng = np.random.default_rng(seed)
    height, width = size
    row, column = np.arange(height) * rows // height, np.arange(width) * columns // width
    dark = ((row[:, None] + column) % 2 == 1)[..., None]
    image = np.where(dark, np.array((62.0, 66.0, 74.0)), np.array((192.0, 188.0, 178.0))).astype(np.uint8)
    square = min(height / rows, width / columns)
    for j in range(rows):
        for i in range(columns):
            tone = 84.0 if (i + j) % 2 == 0 else 148.0
            corner = np.array((i * width / columns, j * height / rows))
            for row, share in ((0.42, 0.8), (0.82, 0.6)):
                words = _word(rng) + str(rng.integers(10, 100))
                wide = cv2.getTextSize(words, FONTS[1], 1.0, 1)[0][0]
                scale = min(share * square / wide, 0.012 * square)
                where = corner + square * np.array((rng.uniform(0.08, 0.92 - share), row))
                colour = (rng.normal(0, 25, 3) + tone).clip(0, 255).tolist()
                cv2.putText(image, words, (int(where[0]), int(where[1])), FONTS[1], scale, colour, 2, cv2.LINE_AA)
    return _worn(image * (1.0 + 0.09 * noise(size, rng, finest=12.0, decay=0.7))[..., None], rng, grain=7.0)


def wood(size: tuple[int, int], seed: int, *, plank: float = 180.0) -> Colours:
    """Planks, about `plank` texels wide, their grain along the width of the image."""
    rng = np.random.default_rng(seed)
    height, width = size
    row = np.mgrid[:height, :width][0].astype(np.float32)
    number = (row / plank).astype(np.int32)
    planks = int(number.max()) + 1
    coarse = noise((height, max(2, width // 16)), rng, decay=0.85)
    along = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    wavy = noise(size, rng, finest=40.0, decay=0.6)
    rings = np.sin(row / 7.0 + 3.5 * wavy + rng.uniform(0, 60, planks).astype(np.float32)[number])
    tone = rng.normal(1.0, 0.13, planks).astype(np.float32)[number]
    light = tone * (1.0 + 0.13 * along + 0.10 * rings + 0.05 * noise(size, rng, decay=1.2))
    light[(row % plank) < 3.0] *= 0.4
    for _ in range(max(1, height * width // 60000)):
        where = (int(rng.random() * width), int(rng.random() * height))
        reach = rng.uniform(2, 6)
        cv2.ellipse(light, where, (int(1.6 * reach), int(reach)), 0, 0, 360, 0.6, -1)
    light = cv2.GaussianBlur(light, (0, 0), 0.9)
    return (light[..., None] * np.array((158.0, 112.0, 70.0), dtype=np.float32)).clip(0, 255).astype(np.uint8)


def tiles(size: tuple[int, int], seed: int, *, tile: float = 64.0) -> Colours:
    """Small glazed tiles of many blues and greens, each speckled in its own way."""
    rng = np.random.default_rng(seed)
    height, width = size
    row, column = np.arange(height) / tile, np.arange(width) / tile
    palette = (60, 122, 140), (96, 160, 158), (150, 190, 176), (44, 84, 120), (196, 204, 190), (84, 110, 104)
    which = rng.integers(len(palette), size=(int(row[-1]) + 1, int(column[-1]) + 1))
    colours = np.array(palette)[which] * rng.uniform(0.7, 1.25, (*which.shape, 1))
    image = colours[row.astype(int)[:, None], column.astype(int)].astype(np.float32)
    image *= (1.0 + 0.15 * noise(size, rng, decay=1.0) + 0.10 * noise(size, rng, finest=tile / 2))[..., None]
    joint = ((row % 1.0) < 0.06)[:, None] | ((column % 1.0) < 0.06)
    image[joint] = np.array((92.0, 90.0, 84.0))
    return _worn(image, rng)


def _picture(image: Colours, centre: Float[np.ndarray, " 2"], reach: float, rng: np.random.Generator) -> None:
    """Rings, or a star."""
    where, colours = (int(centre[0]), int(centre[1])), rng.uniform(20, 245, (4, 3)).tolist()
    if rng.random() < 0.5:
        for share, colour in zip((1.0, 0.75, 0.5, 0.2), colours, strict=True):
            cv2.circle(image, where, int(share * reach), colour, -1, cv2.LINE_AA)
        return
    points = int(rng.integers(4, 9))
    angle = np.arange(2 * points) * np.pi / points + rng.uniform(0, np.pi)
    far = reach * np.where(np.arange(2 * points) % 2 == 0, 1.0, rng.uniform(0.35, 0.7))
    star = centre + far[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    cv2.fillPoly(image, [np.rint(star).astype(np.int32)], colours[0], cv2.LINE_AA)
    cv2.circle(image, where, int(0.3 * reach), colours[1], -1, cv2.LINE_AA)


def _small_print(image: Colours, place: tuple[float, float], unit: int, ink: Colour, rng: np.random.Generator) -> None:
    height, width = image.shape[:2]
    scale = unit * rng.uniform(0.0006, 0.0011)
    for line in range(3):
        words = " ".join(_word(rng) for _ in range(12))
        where = (int(place[0] * width), int(place[1] * height + 26.0 * scale * line))
        tone = tuple(rng.uniform(0.7, 1.0) * c for c in ink)
        cv2.putText(image, words, where, FONTS[rng.integers(2)], scale, tone, max(1, int(1.7 * scale)), cv2.LINE_AA)


def _band(image: Colours, row: int, unit: int, ink: Colour, rng: np.random.Generator) -> None:
    """A stripe of triangles that differ in width."""
    high = int(0.035 * unit)
    x = np.cumsum(rng.uniform(0.4, 1.8, 2 + 3 * image.shape[1] // high) * high)
    for left, right in zip(x[:-1:2], x[1::2], strict=False):
        corners = np.array(((left, row + high), (right, row + high), (0.5 * (left + right), row)))
        cv2.fillPoly(image, [np.rint(corners).astype(np.int32)], ink, cv2.LINE_AA)


def _bar_code(image: Colours, unit: int, rng: np.random.Generator) -> None:
    height, width = image.shape[:2]
    wide, high = int(0.3 * unit), int(0.14 * unit)
    left, top = int(rng.uniform(0.1, 0.6) * width), int(0.55 * height)
    image[top : top + high, left : left + wide] = 236.0
    x = left + 4
    while x < left + wide - 8:
        bar = int(rng.integers(1, 5)) * max(1, unit // 300)
        image[top + 4 : top + high - 4, x : x + bar] = 24.0
        x += bar + int(rng.integers(1, 4)) * max(1, unit // 300)


def _word(rng: np.random.Generator) -> str:
    return "".join(rng.choice(SYLLABLES, int(rng.integers(1, 4))))


def _worn(image: Shaped[np.ndarray, "height width 3"], rng: np.random.Generator, grain: float = 5.0) -> Colours:
    """Scratches and grain, softened as print is, and rounded."""
    height, width = image.shape[:2]
    for _ in range(height * width // 9000):
        start = rng.random(2) * (width, height)
        end = start + rng.normal(0, 0.02 * max(height, width), 2)
        tone = (rng.uniform(40, 225) + rng.normal(0, 12, 3)).clip(0, 255).tolist()
        ends = np.rint(np.stack((start, end)) * 16).astype(int).tolist()
        cv2.line(image, tuple(ends[0]), tuple(ends[1]), tone, 1, cv2.LINE_AA, 4)
    worn = image + grain * noise((height, width), rng, decay=1.0)[..., None]
    return cv2.GaussianBlur(worn, (0, 0), 0.6).clip(0, 255).astype(np.uint8)
