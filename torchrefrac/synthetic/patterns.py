"""What repeats nowhere: stones, beans, grass, sand, rock, coral and the skin of fish, drawn from a seed, as RGB images.

All have detail from some texels up to the whole image, so that keypoints of any scale find something of their own.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, Shaped, UInt8

Colours = UInt8[np.ndarray, "height width 3"]
Grey = Float32[np.ndarray, "height width"]
Labels = Int[np.ndarray, "height width"]  # number of the thing at each texel from 1, 0 for the ground
LIGHT = np.array((-0.45, -0.55), dtype=np.float32)  # towards the light, in the image: from the upper left


def noise(size: tuple[int, int], rng: np.random.Generator, *, finest: float = 2.0, decay: float = 0.7) -> Grey:
    """Fractal noise of mean 0 and standard deviation 1: grids of random numbers, each half as
    fine as the one before and 1/decay times as strong, up to the size of the image."""
    height, width = size
    total = np.zeros(size, dtype=np.float32)
    cell, strength = min(finest, 0.5 * max(size)), 1.0
    while cell < max(size):
        shape = (int(height / cell) + 4, int(width / cell) + 4)
        grid = rng.standard_normal(shape, dtype=np.float32)
        way = cv2.INTER_LINEAR if cell < 8.0 else cv2.INTER_CUBIC
        moved = np.array(((1 / cell, 0, 1 + rng.random()), (0, 1 / cell, 1 + rng.random())))
        total += strength * cv2.warpAffine(
            grid, moved, (width, height), flags=way | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT_101
        )
        cell, strength = 2.0 * cell, strength / decay
    return (total - total.mean()) / total.std()


def gravel(size: tuple[int, int], seed: int, *, stone: float = 44.0, tint: float = 7.0) -> Colours:
    """Broken stones of many sizes, the largest about `stone` texels in radius, some warmer, some cooler by `tint`."""
    rng = np.random.default_rng(seed)
    height, width = size
    radius = _many_sizes(height * width, stone, rng)
    place = rng.random((len(radius), 2)) * (width, height)
    label = np.zeros(size, dtype=np.int32)
    corners = 9
    angle = np.sort(rng.random((len(radius), corners)), axis=1) * 2 * np.pi
    shape = radius[:, None] * rng.uniform(0.75, 1.05, (len(radius), corners))
    stretch, turn = rng.uniform(0.65, 1.0, len(radius))[:, None], rng.uniform(0, np.pi, len(radius))[:, None]
    along, across = shape * np.cos(angle), shape * np.sin(angle) * stretch
    x = place[:, :1] + along * np.cos(turn) - across * np.sin(turn)
    y = place[:, 1:] + along * np.sin(turn) + across * np.cos(turn)
    outline = np.rint(np.stack((x, y), axis=-1) * 16).astype(np.int32)
    for i, stone_outline in enumerate(outline):
        hull = cv2.convexHull(stone_outline)
        cv2.fillConvexPoly(label, hull + int(1.6 * radius[i]), 0.0, shift=4)
        cv2.fillConvexPoly(label, hull, i + 1.0, shift=4)
    x, y = _offsets(label, place, radius)
    light = _facets(label, x, y, rng, len(radius)) * (1.12 - 0.25 * (x * x + y * y))
    base = np.concatenate(((28.0,), rng.normal(138.0, 28.0, len(radius)))).astype(np.float32)
    grey = base[label] * light * (1.0 + 0.10 * noise(size, rng, decay=1.05))
    warmth = np.concatenate(((0.0,), rng.normal(0.0, 1.0, len(radius)))).astype(np.float32)[label] * tint
    return _finished(np.stack((grey + warmth, grey + 0.2 * warmth, grey - warmth), axis=-1), label)


def beans(size: tuple[int, int], seed: int, *, bean: float = 34.0) -> Colours:
    """Roasted coffee beans, about `bean` texels in half length, on a pile of their like."""
    rng = np.random.default_rng(seed)
    count = int(5.0 * size[0] * size[1] / bean**2)
    place = rng.random((count, 2)) * (size[1], size[0])
    half = bean * rng.uniform(0.7, 1.3, count)
    turn = rng.uniform(0.0, np.pi, count)
    wide = rng.uniform(0.62, 0.78, count)
    label = np.zeros(size, dtype=np.int32)
    for i in range(count):
        centre, axes = np.rint(place[i] * 16).astype(int), np.rint((half[i] * 16, half[i] * wide[i] * 16)).astype(int)
        for move, name in ((2.2 * bean, 0.0), (0.0, i + 1.0)):
            where = (int(centre[0] + move), int(centre[1] + move))
            cv2.ellipse(
                label, where, (int(axes[0]), int(axes[1])), float(np.degrees(turn[i])), 0, 360, name, -1, shift=4
            )
    x, y = _offsets(label, place, half)
    c, s = _by_label(np.cos(turn), label), _by_label(np.sin(turn), label)
    along, across = c * x + s * y, (c * y - s * x) / _by_label(wide, label, 1.0)
    dome = np.sqrt(np.clip(1.0 - along * along - across * across, 0.03, 1.0))
    light = 0.30 + 0.75 * dome + 0.55 * (x * LIGHT[0] + y * LIGHT[1])
    bend, front = _by_label(rng.normal(0.0, 0.22, count), label), _by_label(rng.random(count) < 0.6, label)
    crease = np.exp(-(((across - bend * np.sin(2.6 * along)) / 0.075) ** 2)) * front
    light = light * (1.0 - 0.8 * crease) + 1.3 * np.clip(light - 1.05, 0.0, None)
    light = light * (1.0 + 0.13 * noise(size, rng, decay=1.0))
    roast = _by_label(rng.normal(1.0, 0.28, count).clip(0.4, 1.7), label, 0.3)[..., None]
    return _finished(light[..., None] * roast * np.array((142.0, 92.0, 58.0), dtype=np.float32), label)


def grass(size: tuple[int, int], seed: int, *, blade: float = 60.0) -> Colours:
    """Blades, about `blade` texels long, fresh and dry, the lower ones in the dark, and some small leaves."""
    rng = np.random.default_rng(seed)
    height, width = size
    image = np.full((height, width, 3), (34, 36, 22), dtype=np.uint8)
    count = int(22.0 * height * width / blade**2)
    start = rng.random((count, 2)) * (width, height)
    angle = rng.uniform(0.0, 2 * np.pi, count)
    length, bend = blade * rng.gamma(4.0, 0.25, count), rng.normal(0.0, 0.7, count)
    rise = np.linspace(0.25, 1.0, count)[:, None]
    dry = rng.random(count)[:, None] ** 3
    colour = (1 - dry) * np.array((88, 150, 48)) + dry * np.array((205, 190, 120))
    colour = (colour * rise * rng.uniform(0.6, 1.35, (count, 1)) + rng.normal(0, 8, (count, 3))).clip(0, 255)
    t = np.linspace(0.0, 1.0, 5)
    way = angle[:, None] + bend[:, None] * t
    x = start[:, :1] + np.cumsum(np.cos(way), axis=1) * length[:, None] / len(t)
    y = start[:, 1:] + np.cumsum(np.sin(way), axis=1) * length[:, None] / len(t)
    lines = np.rint(np.stack((x, y), axis=-1) * 16).astype(np.int32)
    thick = rng.choice((1, 2, 3, 4), count, p=(0.3, 0.4, 0.2, 0.1))
    leaf = rng.random(count) < 0.04
    for i in range(count):
        tone = colour[i].tolist()
        cv2.polylines(image, [lines[i]], False, tone, int(thick[i]), cv2.LINE_AA, shift=4)
        if leaf[i]:
            axes = (int(1.6 * blade * rng.uniform(1.4, 2.6)), int(1.6 * blade * rng.uniform(1.0, 1.6)))
            where = (int(lines[i, -1, 0]), int(lines[i, -1, 1]))
            cv2.ellipse(image, where, axes, float(np.degrees(angle[i])), 0, 360, tone, -1, cv2.LINE_AA, shift=4)
    shade = 1.0 + 0.10 * noise(size, rng, finest=4.0, decay=0.8)
    return (image * shade[..., None]).clip(0, 255).astype(np.uint8)


def sand(size: tuple[int, int], seed: int, *, ripple: float = 70.0) -> Colours:
    """Sand with ripples about `ripple` texels apart, grains, and some pebbles and shells."""
    rng = np.random.default_rng(seed)
    height, width = size
    shift = 0.75 * ripple * noise(size, rng, finest=ripple, decay=0.6)
    steep = 19.0 * noise(size, rng, finest=2.0 * ripple, decay=0.7).clip(-0.6, 1.4) + 4.0
    row, column = np.mgrid[:height, :width].astype(np.float32)
    phase = (2 * np.pi / ripple) * (0.35 * column + row + shift)
    crest = np.sin(phase + 0.45 * np.cos(phase))
    grey = 150.0 + steep * crest + 17.0 * noise(size, rng, decay=1.0) + 19.0 * noise(size, rng, finest=3.0, decay=0.75)
    image = np.stack((grey + 20.0, grey + 2.0, grey - 36.0), axis=-1)
    count = height * width // 500
    small = 1.15 * rng.gamma(3.0, 1.0, count).clip(0.8, 9.0)
    place = rng.random((len(small), 2)) * (width, height)
    tone = rng.choice(np.array(((60, 56, 52), (228, 220, 205), (120, 88, 66), (96, 104, 106))), len(small))
    tone = tone * rng.uniform(0.7, 1.1, (len(small), 1))
    for i, reach in enumerate(small):
        centre = np.rint(place[i] * 16).astype(int)
        axes = (int(reach * 16), int(reach * 16 * rng.uniform(0.5, 1.0)))
        turn, low = float(rng.uniform(0, 180)), 0.55 * reach
        shadow, body = (int(centre[0] + low * 16), int(centre[1] + low * 16)), (int(centre[0]), int(centre[1]))
        cv2.ellipse(image, shadow, axes, turn, 0, 360, (70.0, 62.0, 46.0), -1, shift=4)
        cv2.ellipse(image, body, axes, turn, 0, 360, tone[i].tolist(), -1, shift=4)
    return cv2.GaussianBlur(image, (0, 0), 0.6).clip(0, 255).astype(np.uint8)


def _many_sizes(area: float, largest: float, rng: np.random.Generator) -> Float[np.ndarray, " n"]:
    """Radii from small, which would cover the area, to large, with some of the small ones on top of all."""
    sizes = [largest * 0.72**step for step in range(6, -1, -1) if step < 4 or largest * 0.72**step > 4.0]
    shares = (1.3, 0.6, 0.5, 0.5, 0.5, 0.4, 0.3)[: len(sizes)]
    counts = [int(np.ceil(share * area / (np.pi * size**2))) for size, share in zip(sizes, shares, strict=True)]
    radii = [size * rng.uniform(0.8, 1.2, n) for size, n in zip(sizes, counts, strict=True)]
    return np.concatenate((*radii, rng.choice(np.concatenate(radii[:3]), counts[3])))


def _by_label(values: Shaped[np.ndarray, " n"], label: Labels, ground: float = 0.0) -> Grey:
    return np.concatenate(((ground,), values)).astype(np.float32)[label]


def rock(size: tuple[int, int], seed: int, *, tone: tuple[float, float, float], grain: float = 2.0) -> Colours:
    """The face of a rock of that colour: strata, cracks, pits, and patches of a crust that is lighter or darker."""
    rng = np.random.default_rng(seed)
    row = np.mgrid[: size[0], : size[1]][0].astype(np.float32) / size[0]
    strata = np.sin(55.0 * row + 2.4 * noise(size, rng, finest=size[0] / 12.0))
    cracks = np.exp(-((noise(size, rng, finest=12.0 * grain, decay=0.75) / 0.045) ** 2))
    pits = noise(size, rng, finest=3.0 * grain, decay=0.95) > 1.7
    crust = np.tanh(2.5 * noise(size, rng, finest=10.0 * grain, decay=0.7))
    light = 1.0 + 0.10 * strata + 0.26 * noise(size, rng, finest=grain, decay=1.35) + 0.20 * crust
    light = light * (1.0 - 0.5 * cracks) * np.where(pits, 0.5, 1.0)
    tint = 1.0 + 0.10 * crust[..., None] * np.array((1.0, 0.2, -1.0), dtype=np.float32)
    colour = light[..., None] * tint * np.array(tone, dtype=np.float32)
    return cv2.GaussianBlur(colour, (0, 0), 0.6).clip(0, 255).astype(np.uint8)


def coral(size: tuple[int, int], seed: int, *, ridge: float = 22.0) -> Colours:
    """A brain coral: ridges, about `ridge` texels apart, that wind without an end, with dark grooves between them."""
    rng = np.random.default_rng(seed)
    winding = np.sin(5.0 * noise(size, rng, finest=1.6 * ridge, decay=0.95))
    light = 0.76 + 0.36 * winding + 0.2 * noise(size, rng, decay=1.3)
    tint = np.tanh(2.0 * noise(size, rng, finest=4.0 * ridge, decay=0.7))[..., None]
    colour = np.array((196.0, 148.0, 92.0)) + tint * np.array((12.0, -16.0, 12.0))
    polyps = noise(size, rng, finest=3.0, decay=0.95) > 1.9
    image = (light * np.where(polyps, 1.35, 1.0))[..., None] * colour
    return cv2.GaussianBlur(image, (0, 0), 0.6).clip(0, 255).astype(np.uint8)


def scales(
    size: tuple[int, int], seed: int, *, ground: tuple[float, float, float], stripe: tuple[float, float, float]
) -> Colours:
    """The skin of a fish, which is as long as the image is high: scales in rows, wavy stripes, speckles."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[: size[0], : size[1]].astype(np.float32) / (size[0] / 34.0)
    number = row.astype(np.int32)
    place = column + 0.5 * (number % 2)
    within = np.hypot(2.0 * (place % 1.0) - 1.0, row % 1.0)
    tone = rng.normal(1.0, 0.22, (int(number.max()) + 1, int(place.max()) + 1)).astype(np.float32)
    light = tone[number, place.astype(np.int32)] * np.where(within > 0.95, 0.55, 1.12 - 0.3 * within)
    wave = np.sin(0.62 * row + 1.3 * noise(size, rng, finest=size[0] / 8.0) + rng.uniform(0.0, 6.0))
    share = np.clip(3.0 * wave, 0.0, 1.0)[..., None]
    colour = (1.0 - share) * np.array(ground) + share * np.array(stripe)
    speckle = 1.0 + 0.16 * noise(size, rng, decay=1.0) - 0.45 * (noise(size, rng, finest=size[0] / 60.0) > 1.5)
    return cv2.GaussianBlur(colour * (light * speckle)[..., None], (0, 0), 0.7).clip(0, 255).astype(np.uint8)


def _offsets(label: Labels, place: Float[np.ndarray, "n 2"], radius: Float[np.ndarray, " n"]) -> tuple[Grey, Grey]:
    """Of each texel from its stone's centre, in its radii."""
    row, column = np.arange(label.shape[0], dtype=np.float32)[:, None], np.arange(label.shape[1], dtype=np.float32)
    size = _by_label(radius, label, 1e6)
    return (column - _by_label(place[:, 0], label)) / size, (row - _by_label(place[:, 1], label)) / size


def _facets(label: Labels, x: Grey, y: Grey, rng: np.random.Generator, count: int) -> Grey:
    """Brightness of broken stone: of four planes a stone, the lowest at each texel, by its slope to the light."""
    lowest, light = np.full(label.shape, np.inf, dtype=np.float32), np.empty(label.shape, dtype=np.float32)
    for facet in range(4):
        angle = rng.uniform(0, 2 * np.pi, count) + facet * np.pi / 2
        steep = rng.uniform(0.25, 0.9, count)
        sx, sy = _by_label(steep * np.cos(angle), label), _by_label(steep * np.sin(angle), label)
        level = sx * x + sy * y + _by_label(rng.uniform(0.0, 0.3, count), label)
        lower = level < lowest
        np.copyto(lowest, level, where=lower)
        np.copyto(light, 0.98 - 0.62 * (sx * LIGHT[0] + sy * LIGHT[1]), where=lower)
    return light


def _finished(colour: Float[np.ndarray, "height width 3"], label: Labels) -> Colours:
    """Darker where one thing meets the next, and rounded."""
    edge = np.zeros(label.shape, dtype=np.uint8)
    edge[:, 1:] |= label[:, 1:] != label[:, :-1]
    edge[1:] |= label[1:] != label[:-1]
    near = cv2.GaussianBlur(edge.astype(np.float32), (0, 0), 1.3)
    softened = cv2.GaussianBlur(colour, (0, 0), 0.6)
    return (softened * (1.0 - 0.75 * near.clip(0.0, 1.0))[..., None]).clip(0, 255).astype(np.uint8)
