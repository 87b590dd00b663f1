"""`survey.json`: read, with everything checked before anything is computed, and written."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchrefrac.files.capture import pixel_shift
from torchrefrac.files.control_points import Stated
from torchrefrac.files.control_table import read_control_table
from torchrefrac.files.fields import Fields, read_json, write_json
from torchrefrac.files.gcp_list import read_gcp_list
from torchrefrac.files.measured import UNIT_TOLERANCE
from torchrefrac.files.survey_place import survey_in_place
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.georeference import Georeference
from torchrefrac.scene.survey import (
    ControlPoint,
    Matrix,
    ScaleBar,
    Survey,
    SurveyedImage,
    SurveyError,
    WaterMark,
    resolve,
)

SURVEY = "survey.json"
"""Its name beside a capture.json."""
FORMAT = "torchrefrac-survey/1"
GAUGE = "gauge "
"""How the sources of levels begin that gauges state."""
WATERLINE = "waterline"
"""The source of levels that points of the shore state."""
Covariance = Float[Tensor, "3 3"]
IMAGE_FIELDS = {
    "down_in_cam": ("down_in_cam_sigma_deg",),
    "height": ("height_sigma",),
    "center": ("center_sigma", "center_covariance"),
}
CONTROL_FIELDS = {"observations": (), "position": ("sigma",), "on_waterline": ("waterline_sigma",), "check": ()}
READERS = {".txt": read_gcp_list, ".csv": read_control_table}
"""Of files that are no survey.json, by how their names end."""
RANGE = 1e100  # of lengths and sigmas: their squares and the inverses of those are finite
SYMMETRY_TOLERANCE = 1e-6  # of covariances, relative to the standard deviations they belong to
MIN_EIGENVALUE = 1e-10  # of correlations; below, the digits that people write do not tell them from singular ones


def read_survey(path: str | Path, names: Sequence[str], place: Georeference | None = None) -> Survey:
    """Read what was measured on site and resolve it against `names`, those of the views of a scene: a `survey.json`, a
    table of ground control points (.csv, beside it one of clicks, see `control_table`) or a `gcp_list.txt` (.txt).

    place: where the local frame of the scene stands, if that is known; see `survey_in_place` for positions that have
    the coordinates of a map.

    Everything in the file but `format` is optional; `pixel_origin` is "corner" (COLMAP) unless it says "center"
    (OpenCV). What was measured of an image that is not among `names` is checked like the rest, then left out, and the
    image is listed in `skipped`: images that could not be registered are common. A ground control point that this
    leaves with fewer than two observations, or with none where its position is known, is left out too, with its scale
    bars, and listed in `skipped_controls`.

    Raises SurveyError with one sentence for anything that cannot be right: a missing or malformed file, a name given
    twice, an unknown or mistyped field, a sigma that is not positive and finite, a covariance that is not symmetric and
    positive definite, a measurement without its sigma or a sigma without its measurement, a down_in_cam that is no
    unit vector, a height that is not above the water, a point with too few observations, a scale bar to a point that
    does not exist, and a file none of whose images is among `names`.
    """
    path = Path(path)
    try:
        stated = READERS.get(path.suffix.lower(), _read_json)(path).of_images(names)
    except CaptureError as error:  # the typed fields speak for every file of a capture
        raise SurveyError(str(error)) from None
    clicked = (image for point in stated.controls.values() for image in point.pixels)
    mentioned = {*stated.images, *clicked}
    survey = resolve(stated.images, stated.controls, stated.bars, names, stated.water)
    if mentioned and len(survey.skipped) == len(mentioned):
        wanted = f"the scene has none of them; its images are {_some(names)}"
        raise SurveyError(f"{path} names the images {_some(survey.skipped)}, but {wanted}")
    return survey_in_place(survey, stated.crs, place, path)


def _read_json(path: Path) -> Stated:
    top = read_json(path, "does not exist, but must say what was measured on site")
    top.only("format", "pixel_origin", "crs", "images", "marks", "scale_bars", "water_level", "gauges", "waterline")
    top.must_be("format", FORMAT)
    shift = pixel_shift(top, top.text("pixel_origin") if "pixel_origin" in top else "corner")
    images = {name: _image(image) for name, image in top.members("images").items()}
    controls = {name: _control_point(entry, shift) for name, entry in top.members("marks").items()}
    for name, point in controls.items():
        if not point.is_placed:
            wanted = "must be at least 2x, or 1x beside a position"
            raise top.fail(f"marks.{name}", f"is observed {len(point.pixels)}x, but {wanted}")
    bars = [_bar(bar, controls) for bar in top.objects("scale_bars")] if "scale_bars" in top else []
    return Stated(controls, images, bars, _water(top), top.text("crs", "") or None)


def _water(top: Fields) -> list[WaterMark]:
    """Heights of the water, by themselves and by gauges, and points of its line."""
    stated = {"water_level": top.object("water_level")} if "water_level" in top else {}
    stated |= {GAUGE + name: gauge for name, gauge in top.members("gauges").items()}
    marks = []
    for source, fields in stated.items():
        fields.only("height", "sigma", "epoch", "position")
        height, sigma = fields.number("height"), _positive(fields, "sigma")
        x, y = fields.numbers("position", 2) if "position" in fields else (None, None)
        marks.append(WaterMark(source, (x, y, height), sigma, fields.text("epoch", "")))
    for line in top.objects("waterline") if "waterline" in top else []:
        line.only("points", "sigma", "epoch")
        sigma, epoch = _positive(line, "sigma"), line.text("epoch", "")
        marks += [WaterMark(WATERLINE, (x, y, z), sigma, epoch) for x, y, z in line.rows("points", 3)]
    return marks


def write_survey(survey: Survey, path: str | Path) -> None:
    """Write what `read_survey` makes the same survey of, for the same names, to rounding; without what was skipped.

    Raises SurveyError where errors of the known position of a point go together, which the format has no place for.
    """
    write_json(
        {
            "format": FORMAT,
            "pixel_origin": "corner",
            "images": _written_images(survey),
            "marks": _written_controls(survey, Path(path)),
            "scale_bars": [
                {"from": survey.control_names[start], "to": survey.control_names[end], "length": length, "sigma": sigma}
                for start, end, length, sigma in _rows(
                    survey.bar_from, survey.bar_to, survey.bar_length, survey.bar_sigma
                )
            ],
            **_written_water(survey),
        },
        Path(path),
    )


def _written_water(survey: Survey) -> dict[str, Any]:
    """Levels of each source as it would be read."""
    columns = survey.level, survey.level_position, survey.level_has_place, survey.level_sigma
    gauges: dict[str, Any] = {}
    levels: dict[str, Any] = {}
    lines: list[dict[str, Any]] = []
    for i, position, has_place, sigma in _rows(*columns):
        of = {"epoch": survey.level_epochs[i]} if survey.level_epochs[i] else {}
        source, place = survey.level_sources[i], {"position": position[:2]} if has_place else {}
        if source.startswith(GAUGE):
            gauges[source.removeprefix(GAUGE)] = {"height": position[2], "sigma": sigma, **place, **of}
        elif source == WATERLINE:
            lines.append({"points": [position], "sigma": sigma, **of})
        else:
            levels = {"water_level": {"height": position[2], "sigma": sigma, **place, **of}}
    return levels | ({"gauges": gauges} if gauges else {}) | ({"waterline": lines} if lines else {})


def _written_images(survey: Survey) -> dict[str, dict[str, Any]]:
    images: dict[str, dict[str, Any]] = {}
    for i, down, sigma in _rows(survey.down_image, survey.down_in_cam, survey.down_sigma.rad2deg()):
        images.setdefault(survey.names[i], {}).update(down_in_cam=down, down_in_cam_sigma_deg=sigma)
    for i, height, sigma in _rows(survey.height_image, survey.height, survey.height_sigma):
        images.setdefault(survey.names[i], {}).update(height=height, height_sigma=sigma)
    covariances = torch.linalg.inv(survey.center_information)
    for i, center, covariance in _rows(survey.center_image, survey.center, covariances):
        images.setdefault(survey.names[i], {}).update(center=center, center_covariance=covariance)
    return images


def _written_controls(survey: Survey, path: Path) -> dict[str, dict[str, Any]]:
    controls: list[dict[str, Any]] = [{"observations": {}} for _ in survey.control_names]
    for i, image, pixel in _rows(survey.control, survey.control_image, survey.control_pixels):
        controls[i]["observations"][survey.names[image]] = pixel
    variance = survey.known_information.diagonal(dim1=-2, dim2=-1)
    for i, position, sigma in _rows(survey.known_control, survey.known_position, variance.rsqrt()):
        controls[i] |= {"position": position, "sigma": sigma}
    if not torch.equal(survey.known_information, variance.diag_embed()):
        name = survey.control_names[int(survey.known_control[0])]
        raise SurveyError(f"{path} has no place for errors of positions that go together, as of {name}; give sigmas")
    spread = survey.check_information.diagonal(dim1=-2, dim2=-1).rsqrt()
    for i, position, sigma in _rows(survey.check_control, survey.check_position, spread):
        controls[i] |= {"position": position, "sigma": sigma, "check": True}
    for i, sigma in _rows(survey.waterline_control, survey.waterline_sigma):
        controls[i] |= {"on_waterline": True, "waterline_sigma": sigma}
    return dict(zip(survey.control_names, controls, strict=True))


def _rows(*columns: Shaped[Tensor, "n ..."]) -> list[tuple[Any, ...]]:
    """Of each row of a table what the columns have there."""
    return list(zip(*(column.tolist() for column in columns), strict=True))


def _image(image: Fields) -> SurveyedImage:
    _paired(image, IMAGE_FIELDS)
    down = height = center = None
    if "down_in_cam" in image:
        down = _unit(image, "down_in_cam"), math.radians(_positive(image, "down_in_cam_sigma_deg"))
    if "height" in image:
        height = _positive(image, "height"), _positive(image, "height_sigma")
    if "center" in image:
        given = [name for name in IMAGE_FIELDS["center"] if name in image]
        if len(given) != 1:
            found = " and ".join(given) or "neither center_sigma nor center_covariance"
            raise image.fail("center", f"has {found}, but needs one of the two")
        read = _covariance if given == ["center_covariance"] else _diagonal
        center = image.position("center"), _information(image, given[0], read(image, given[0]))
    return SurveyedImage(down, height, center)


def _control_point(entry: Fields, shift: float) -> ControlPoint:
    _paired(entry, CONTROL_FIELDS)
    pixels: dict[str, list[float]] = {}
    if "observations" in entry:
        seen = entry.object("observations")
        pixels = {image: [x + shift for x in seen.numbers(image, 2)] for image in seen.names()}
    known = waterline = None
    if "position" in entry:
        known = entry.position("position"), _information(entry, "sigma", _diagonal(entry, "sigma"))
    if "on_waterline" in entry and entry.flag("on_waterline"):
        waterline = _positive(entry, "waterline_sigma")
    check = entry.flag("check") if "check" in entry else False
    if check and known is None:
        raise entry.fail("check", "is true, but without a position there is nothing to compare with")
    return ControlPoint(pixels, known, waterline, check)


def _bar(bar: Fields, controls: Mapping[str, ControlPoint]) -> ScaleBar:
    bar.only("from", "to", "length", "sigma")
    for end in ("from", "to"):
        if bar.text(end) not in controls:
            raise bar.fail(end, f"is {bar.text(end)!r}, but must be one of the marks ({_some(controls) or 'none'})")
    if bar.text("from") == bar.text("to"):
        raise bar.fail("to", f"is {bar.text('to')!r}, but must be another mark than from")
    return ScaleBar(bar.text("from"), bar.text("to"), _positive(bar, "length"), _positive(bar, "sigma"))


def _paired(entry: Fields, fields: Mapping[str, tuple[str, ...]]) -> None:
    """Refuse fields that are neither measurements nor the sigmas that go with them, and sigmas that stand alone."""
    entry.only(*fields, *(sigma for sigmas in fields.values() for sigma in sigmas))
    for measured, sigmas in fields.items():
        for sigma in sigmas:
            if sigma in entry and measured not in entry:
                raise entry.fail(sigma, f"is given without {measured}; give both or neither")


def _positive(fields: Fields, name: str) -> float:
    return _within(fields, name, fields.number(name))


def _within(fields: Fields, name: str, value: float) -> float:
    if value <= 0.0:
        raise fields.fail(name, f"is {value:g}, but must be above 0")
    if not 1.0 / RANGE <= value <= RANGE:
        raise fields.fail(name, f"is {value:g}, but must lie between {1.0 / RANGE:g} and {RANGE:g}")
    return value


def _unit(fields: Fields, name: str) -> list[float]:
    vector = fields.numbers(name, 3)
    norm = math.hypot(*vector)
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise fields.fail(name, f"has length {norm:.4f}, but must be a unit vector (within {UNIT_TOLERANCE:g})")
    return [x / norm for x in vector]


def _information(fields: Fields, name: str, covariance: Covariance) -> Matrix:
    """The inverse of a covariance, by way of the correlations, whose condition no choice of units can spoil."""
    scale = covariance.diagonal().rsqrt()
    correlation = covariance * scale[:, None] * scale
    finite = bool(correlation.isfinite().all() and scale.square().isfinite().all())
    if not finite or torch.linalg.eigvalsh(correlation)[0] <= MIN_EIGENVALUE:
        raise fields.fail(name, f"is {covariance.tolist()}, but must be positive definite")
    return (torch.cholesky_inverse(torch.linalg.cholesky(correlation)) * scale[:, None] * scale).tolist()


def _diagonal(fields: Fields, name: str) -> Covariance:
    """The covariance of sigmas: one for each axis, or the same for all."""
    one_for_all = not fields.is_list(name)
    sigmas = [fields.number(name)] * 3 if one_for_all else fields.numbers(name, 3)
    sigmas = [_within(fields, name if one_for_all else f"{name}[{i}]", sigma) for i, sigma in enumerate(sigmas)]
    return torch.diag(torch.tensor(sigmas, dtype=torch.float64).square())


def _covariance(fields: Fields, name: str) -> Covariance:
    covariance = torch.tensor(fields.matrix(name), dtype=torch.float64)
    sigma = covariance.diagonal().abs().sqrt()
    if not ((covariance - covariance.mT).abs() <= SYMMETRY_TOLERANCE * sigma[:, None] * sigma).all():
        raise fields.fail(name, f"is {covariance.tolist()}, but must be symmetric")
    return covariance / 2.0 + covariance.mT / 2.0


def _some(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
