"""Surveys in the reference system of a map, brought into the local frame of a capture, or given one of their own."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.files.metadata.local_frame import REMEDY, Grid, has_projections, origin_of, zone_of
from torchrefrac.files.systems import horizontal_part, system_of
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.georeference import Georeference
from torchrefrac.scene.survey import POSITIONS, Survey, SurveyError

FARTHEST = 50_000.0
"""From the photographs, m; farther off nobody measures ground control."""
RECOGNISED = 10.0
"""Times that coordinates must be nearer to the origin of a capture on its map than to that of its local frame."""


def survey_in_place(survey: Survey, crs: str | None, place: Georeference | None, path: Path) -> Survey:
    """A survey whose positions have coordinates of the system `crs`, in the local frame `place` of a capture: by
    default in one whose origin is near them.

    Without a crs positions are in the local frame, unless their numbers are those of the map at its origin. Heights are
    taken as they are. Raises SurveyError for positions that are elsewhere, and for a system that pyproj does not know.
    """
    known = _positions(survey)
    if crs is None:
        return survey.placed(place) if place is not None and len(known) and _is_on_map(known, place) else survey
    if not has_projections():
        raise SurveyError(f"{path} has positions in {crs}, but pyproj is missing: {REMEDY}")
    try:
        if place is None:
            return _placed_anew(survey, known, crs)
        _require_near(known, crs, place, path)
        return _mapped(survey, crs, place.crs).placed(place)
    except CaptureError as error:
        raise SurveyError(f"{path}: {error}") from None


def _positions(survey: Survey) -> Float[Tensor, "k 3"]:
    """All that are known in three coordinates."""
    levels = survey.level_position[survey.level_has_place]
    return torch.cat((survey.center, survey.known_position, survey.check_position, levels))


def _is_on_map(known: Float[Tensor, "k 3"], place: Georeference) -> bool:
    """Whether coordinates are those of a map rather than of the local frame."""
    middle = known[:, :2].median(dim=0).values
    on_map = float((middle - middle.new_tensor(place.origin[:2])).norm())
    return RECOGNISED * on_map < float(middle.norm())


def _placed_anew(survey: Survey, known: Float[Tensor, "k 3"], crs: str) -> Survey:
    """In a local frame of its own, of a map in m: the zone of UTM where the positions are in degrees."""
    if not len(known):
        return survey
    grid = Grid(zone_of(known[:, 1].tolist(), known[:, 0].tolist()) if _plane(crs).is_geographic else crs)
    mapped = _mapped(survey, crs, grid.crs)
    position = _positions(mapped).numpy()
    origin = origin_of(position)
    scale = grid.scale_at(origin, float(np.median(position[:, 2])))
    return mapped.placed(Georeference(grid.crs, origin, scale=scale))


def _require_near(known: Float[Tensor, "k 3"], crs: str, place: Georeference, path: Path) -> None:
    """Refuse positions that are not where the photographs are."""
    if not len(known):
        return
    far, exchanged = (
        float(place.local(_transformed(positions, crs, place.crs))[:, :2].median(dim=0).values.norm())
        for positions in (known, known[:, [1, 0, 2]])
    )
    if far <= FARTHEST:
        return
    if exchanged <= FARTHEST:
        raise SurveyError(f"{path} has x and y exchanged: x is east (longitude), y north (latitude); exchange them")
    where = f"{far / 1000.0:.0f} km from the photographs" if far < np.inf else f"outside of {place.crs}"
    raise SurveyError(f"{path} has positions {where}, read as {crs}; check its reference system and its points")


def _mapped(survey: Survey, crs: str, wanted: str) -> Survey:
    """With positions in another reference system."""
    return replace(survey, **{name: _transformed(getattr(survey, name), crs, wanted) for name in POSITIONS})


def _transformed(positions: Float[Tensor, "k 3"], crs: str, wanted: str) -> Float[Tensor, "k 3"]:
    """Positions of one reference system in another; heights stay as they are."""
    from pyproj import Transformer  # noqa: PLC0415 - of an extra

    if not len(positions):
        return positions
    change = Transformer.from_crs(_plane(crs), _plane(wanted), always_xy=True)
    plane = torch.from_numpy(np.stack(change.transform(*positions[:, :2].T.numpy()), axis=-1))
    return torch.cat((plane, positions[:, 2:]), dim=1)


def _plane(crs: str) -> Any:
    """The horizontal part of a system."""
    try:
        return horizontal_part(system_of(crs))
    except ValueError:
        raise CaptureError(f"crs {crs!r} is not known to pyproj; give a code such as EPSG:32633") from None
