"""Subtitles beside a film by DJI: where its camera was, how it was turned and how far it zoomed, from moment to moment.

Older drones write one line a second, `GPS(longitude,latitude,satellites) BAROMETER:height`; newer ones one for each
frame, `[latitude: ..] [longitude: ..] [rel_alt: .. abs_alt: ..]`, some with the angles of their gimbal.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from torchrefrac.files.fields import MEGABYTE, MOST_MEGABYTES
from torchrefrac.files.metadata.attitude import Attitude
from torchrefrac.files.metadata.drones import gimbal_attitude
from torchrefrac.files.metadata.lens import Lens, believed_equivalent
from torchrefrac.files.metadata.photograph import Photograph
from torchrefrac.files.metadata.position import (
    HORIZONTAL_SIGMA,
    VERTICAL_SIGMA,
    Fix,
    Vertical,
    believed_altitudes,
    believed_place,
)

ENDING, UTF_16 = ".srt", (b"\xff\xfe", b"\xfe\xff")
NUMBER = r"([-+]?\d{1,20}(?:\.\d{0,20})?)"
TIME = re.compile(r"\b(\d{1,3}):(\d\d?):(\d\d?)[,.](\d{1,3})\s*-->")
NAMED = re.compile(rf"\b([A-Za-z_]{{1,30}})\s*:\s*{NUMBER}")
TUPLE = re.compile(rf"\bGPS\s*\(\s*{NUMBER}\s*,\s*{NUMBER}\s*,\s*{NUMBER}\s*(M?)\s*\)")
GIMBAL = re.compile(rf"\bG\.PRY\s*\(\s*{NUMBER}°?\s*,\s*{NUMBER}°?\s*,\s*{NUMBER}")
ABOVE_TAKE_OFF = re.compile(rf"\bBAROMETER\s*\(\s*{NUMBER}|\bH\s+{NUMBER}\s*m\b")
NAMES = {
    "latitude": ("latitude",), "longitude": ("longitude", "longtitude"), "sea_level": ("abs_alt", "altitude"),
    "take_off": ("rel_alt", "barometer", "hb"), "yaw": ("gb_yaw",), "pitch": ("gb_pitch",), "roll": ("gb_roll",),
}  # fmt: skip
"""What each quantity is called; DJI once misspelt one."""
TURNS = ("longitude", "yaw", "roll")  # that go round
LONGEST_GAP = 3.0  # s without a line, in which nothing is known
ZOOM = re.compile(rf"\bdzoom(?:_ratio)?\s*:\s*{NUMBER}")
FOCAL = re.compile(r"\bfocal_len\s*:\s*(\d{1,5})(\.\d{1,20})?")
TEN_THOUSANDTHS, TENTHS = (
    1000.0,
    10.0,
)  # as which whole numbers of zooms from here on, and of focal lengths, are written


@dataclass(frozen=True, eq=False)
class Subtitles:
    """path; of each quantity the seconds since the film began, ascending, and its value there: in degrees, m, and of
    the equivalent focal length in mm."""

    path: Path
    known: Mapping[str, tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]]

    @property
    def problem(self) -> str:
        """A sentence where they say nothing; empty otherwise."""
        return (
            "" if self.known else f"{self.path.name} says nothing that is read here of where or how the film was taken"
        )

    def at(self, seconds: float) -> dict[str, float]:
        """What is known at some time, between two lines in proportion."""
        return {
            name: value
            for name, (times, values) in self.known.items()
            if (value := _between(times, values, seconds)) is not None
        }

    def told(self, frame: Photograph, seconds: float) -> Photograph:
        """A frame of the film at some time, with what is known then and the frame does not say itself."""
        known = self.at(seconds)
        fix, attitude, lens = _fix(known), _attitude(known), _lens(known, frame)
        return replace(
            frame,
            fix=frame.fix or fix,
            attitude=frame.attitude or attitude,
            lens=lens if lens is not None and frame.lens.is_guessed else frame.lens,
            has_tags=frame.has_tags or fix is not None or attitude is not None or lens is not None,
        )


def subtitles_beside(film: Path) -> Subtitles | None:
    """Those with the name of a film; None where there are none."""
    stem = film.stem.lower()
    for path in sorted(film.parent.iterdir()):
        if path.suffix.lower() == ENDING and path.stem.lower() == stem and path.is_file():
            return read_subtitles(path)
    return None


def read_subtitles(path: Path) -> Subtitles:
    """Whatever can be read; other lines, and values that cannot be, are passed over."""
    if path.stat().st_size > MOST_MEGABYTES * MEGABYTE:
        return Subtitles(path, {})
    content = path.read_bytes()
    text = content.decode("utf-16" if content.startswith(UTF_16) else "utf-8-sig", errors="replace")
    rows: dict[str, dict[float, float]] = {}
    for seconds, lines in _blocks(text):
        for name, value in _values(lines).items():
            rows.setdefault(name, {})[seconds] = value
    known = {name: (np.array(sorted(of)), np.array([of[time] for time in sorted(of)])) for name, of in rows.items()}
    return Subtitles(path, {
        name: (times, np.unwrap(values, period=360.0) if name in TURNS else values)
        for name, (times, values) in known.items()
    })  # fmt: skip


def _blocks(text: str) -> Iterator[tuple[float, str]]:
    """The time of each block in seconds, and its lines."""
    starts = list(TIME.finditer(text))
    ends = [*(start.start() for start in starts[1:]), len(text)]
    for start, end in zip(starts, ends, strict=False):
        hours, minutes, seconds, fraction = start.groups()
        since = 3600.0 * int(hours) + 60.0 * int(minutes) + int(seconds) + int(fraction) / 10.0 ** len(fraction)
        yield since, text[start.end() : end]


def _values(lines: str) -> dict[str, float]:
    """The quantities that a block has; without a position that cannot be one."""
    named = {name.lower(): float(number) for name, number in NAMED.findall(lines)}
    values = {name: named[word] for name, words in NAMES.items() for word in words[::-1] if word in named}
    values |= {name: value for name, value in _unnamed(lines).items() if name not in values}
    if believed_place(values.get("latitude"), values.get("longitude")) is None:
        values = {name: value for name, value in values.items() if name not in ("latitude", "longitude")}
    focal = _focal(lines)
    return values if focal is None else values | {"focal": focal}


def _unnamed(lines: str) -> dict[str, float]:
    """The quantities that older drones write by their places.

    Longitude comes first, and then the number of satellites; but latitude where a length follows ("0.0M"), or where
    these could be no longitude and latitude. A third number with a point is an altitude.
    """
    values: dict[str, float] = {}
    place, gimbal, height = TUPLE.search(lines), GIMBAL.search(lines), ABOVE_TAKE_OFF.search(lines)
    if place is not None:
        longitude, latitude = float(place[1]), float(place[2])
        if place[4] or abs(latitude) > 90.0:
            longitude, latitude = latitude, longitude
        values |= {"longitude": longitude, "latitude": latitude}
        if "." in place[3] and not place[4]:
            values["sea_level"] = float(place[3])
    if gimbal is not None:
        values |= dict(zip(("pitch", "roll", "yaw"), map(float, gimbal.groups()), strict=True))
    if height is not None:
        values["take_off"] = float(height[1] or height[2])
    return values


def _focal(lines: str) -> float | None:
    """The equivalent focal length in mm: whole numbers are tenths. None where the picture is zoomed by cutting, which
    some drones count in and others do not."""
    focal, zoom = FOCAL.search(lines), ZOOM.search(lines)
    ratio = 1.0 if zoom is None else float(zoom[1])
    if focal is None or (ratio / 10_000.0 if ratio >= TEN_THOUSANDTHS else ratio) != 1.0:
        return None
    return int(focal[1]) / TENTHS if focal[2] is None else float(focal[1] + focal[2])


def _between(times: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], seconds: float) -> float | None:
    """Between the neighbours in time; None where both are too far apart, or the nearest is too far away."""
    after = int(np.searchsorted(times, seconds))
    before, after = max(after - 1, 0), min(after, len(times) - 1)
    is_near = min(abs(seconds - times[before]), abs(times[after] - seconds)) <= LONGEST_GAP
    if not is_near or times[after] - times[before] > LONGEST_GAP:
        return None
    return float(np.interp(seconds, times, values))


def _fix(known: Mapping[str, float]) -> Fix | None:
    if "latitude" not in known or "longitude" not in known:
        return None
    longitude = known["longitude"] - 360.0 * round(known["longitude"] / 360.0)
    altitudes = {Vertical.SEA_LEVEL: known.get("sea_level"), Vertical.TAKE_OFF: known.get("take_off")}
    sigma = HORIZONTAL_SIGMA, VERTICAL_SIGMA
    return Fix(known["latitude"], longitude, believed_altitudes(altitudes), sigma, "subtitles")


def _attitude(known: Mapping[str, float]) -> Attitude | None:
    return gimbal_attitude([known.get(name) for name in ("yaw", "pitch", "roll")], "gimbal (subtitles)")


def _lens(known: Mapping[str, float], frame: Photograph) -> Lens | None:
    focal = known.get("focal")
    return None if focal is None else believed_equivalent(focal, *frame.size, "subtitles, 35 mm equivalent")
