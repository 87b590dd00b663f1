"""What `torchrefrac import` prints: what was taken from where, and what was not found."""

import os
import shlex
from collections.abc import Iterator, Mapping
from functools import partial
from textwrap import wrap
from typing import Any

WIDTH, INDENT, LABEL, VALUE = 100, 2, 17, 26
MOST_LISTED = 12  # photographs with a reason each
ASSUMED = "not found: assumed"
_wrap = partial(wrap, break_on_hyphens=False)


def import_lines(report: Mapping[str, Any]) -> list[str]:
    """Of the report of an import; no line has more than a hundred characters."""
    used, left_out = report["used"], report["left_out"]
    head = f"{used} photographs of {_path(report['folder'])}"
    lines = [head + (f", {len(left_out)} left out" if left_out else ""), ""]
    for name, camera in report["cameras"].items():
        lines += [f"camera {name}: {camera['photographs']} photographs of {camera['width']} x {camera['height']}"]
        lines += _camera(camera)
    lines += ["", *_statements(report)]
    if report["without_position"]:
        lines += ["", "without a position", *_listed(report["without_position"])]
    if left_out:
        lines += ["", "left out", *_listed(left_out)]
    for note in report["notes"]:
        lines += ["", *_wrap(note, WIDTH)]
    out = _path(report["out"])
    lines += ["", f"written to {out}; go on with:"]
    return [*lines, f"  torchrefrac scene=capture {shlex.quote(f'scene.path={out}')} out=outputs/my_run"]


def _path(path: str) -> str:
    """As seen from here, or whole where that is shorter."""
    return min(os.path.relpath(path), path, key=len)


def _camera(camera: Mapping[str, Any]) -> Iterator[str]:
    middle = camera["cx"] - 0.5 * camera["width"], camera["cy"] - 0.5 * camera["height"]
    focal = f"{camera['fx']:.1f} px +- {100.0 * camera['focal_sigma']:.2g} %"
    yield from _row("focal length", focal, camera["focal"])
    center = "the middle" if not any(middle) else f"{middle[0]:+.1f}, {middle[1]:+.1f} px"
    distortion = "known" if camera["distortion"] else "none"
    center_sigma, sigma = _spread(camera["principal_point_sigma"], " px"), _spread(camera["distortion_sigma"], "")
    yield from _row("principal point", center + center_sigma, camera["principal_point"] or ASSUMED)
    yield from _row("distortion", distortion + sigma, camera["distortion"] or ASSUMED)


def _spread(sigma: float | None, unit: str) -> str:
    return "" if sigma is None else f" +- {sigma:.2g}{unit}"


def _statements(report: Mapping[str, Any]) -> Iterator[str]:
    used, sigma, marks = report["used"], report["position_sigma"], report.get("marks") or {}
    scale = "the board" if marks.get("scale_bars") else "heights alone"
    yield from _counted("gravity", report["gravity"], used, f"+- {report['gravity_sigma_deg']} degrees",
                        "it will be estimated from the refraction")  # fmt: skip
    side = "left" if report["north_deg"] < 0.0 else "right"
    north = f"true north is {abs(report['north_deg']):.2f} degrees {side} of the grid's" if report["crs"] else ""
    yield from _counted("heading", report["heading"], used, "", "nothing needs it", north)
    known = "" if sigma is None else f"+- {sigma[0]:.2g}, {sigma[2]:.2g} m"
    yield from _counted("position", report["position"], used, known, f"the scale follows from {scale}",
                        f"in {report['crs']}" if report["crs"] else "")  # fmt: skip
    if report["altitude_range"]:
        low, high = report["altitude_range"]
        yield from _row("altitude", f"{low:.1f} to {high:.1f} m", f"counted from: {report['vertical']}")
    how = "not found: give water_level or take_off_above_water" if not report["height"] else "above the water"
    yield from _row("height", f"{report['height']} of {used}", how)
    if marks:
        yield from _marks(marks, used)


def _marks(marks: Mapping[str, Any], used: int) -> Iterator[str]:
    """Boards or tags: how many corners of how many in how many photographs."""
    found = marks["found"]
    corners = f"{marks['corners']} corners in {marks['photographs']} of {used}"
    what = f"{len(found)} tag{'' if len(found) == 1 else 's'}" if marks["kind"] == "apriltag" else marks["kind"]
    how = f"{what}; {marks['scale_bars']} scale bars, in survey.json" if marks["corners"] else "not found in two"
    yield from _row("tags" if marks["kind"] == "apriltag" else "board", corners, how)


def _counted(
    label: str, sources: Mapping[str, int], used: int, sigma: str, otherwise: str, further: str = ""
) -> Iterator[str]:
    """A line for each source, how many photographs it serves and how well."""
    for source, count in sources.items():
        yield from _row(label, f"{count} of {used}  {sigma}", f"{source}; {further}" if further else source)
        label = further = ""
    if not sources:
        yield from _row(label, f"0 of {used}", f"not found: {otherwise}")


def _row(label: str, value: str, source: str) -> list[str]:
    """Three columns; what does not fit into the last goes on below."""
    first, *rest = _wrap(source, WIDTH - INDENT - LABEL - VALUE - 4) or [""]
    left = INDENT + LABEL + VALUE
    return [
        f"{'':{INDENT}}{label:<{LABEL}} {value:<{VALUE}}  {first}".rstrip(),
        *(f"{'':{left + 3}}{line}" for line in rest),
    ]


def _listed(reasons: Mapping[str, str]) -> Iterator[str]:
    """Names with the same reason together."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        by_reason.setdefault(reason, []).append(name)
    for reason, names in list(by_reason.items())[:MOST_LISTED]:
        shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        yield from _wrap(f"{shown}: {reason}", WIDTH - INDENT, initial_indent="  ", subsequent_indent="    ")
    if len(by_reason) > MOST_LISTED:
        yield f"  and {len(by_reason) - MOST_LISTED} reasons more, in import.json"
