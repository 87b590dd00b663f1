"""What was found of the photographs of an import, and what is odd about them."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrefrac.files.metadata.gathered import SKY, Gathered
from torchrefrac.files.metadata.lens import Lens
from torchrefrac.files.metadata.placing import Placement
from torchrefrac.files.metadata.times import odd_times

FISHEYES = ("gopro", "insta360")
"""Makes of cameras with lenses that are no pinholes."""


def found(
    content: Mapping[str, Any], gathered: Sequence[Gathered], lenses: Mapping[str, Lens], placement: Placement
) -> dict[str, Any]:
    """How many photographs have what, by whose word."""
    images = content["images"]
    gravity = [one.attitude.source for one in gathered if one.attitude is not None and not one.looks_up]
    placed = [one.place_source for one, known in zip(gathered, placement.known, strict=True) if known]
    turned = [one.attitude.source for one, image in zip(gathered, images, strict=True)
              if "heading_deg" in image and one.attitude is not None]  # fmt: skip
    altitudes = placement.position[placement.known, 2] + placement.origin[2]
    return {
        "used": len(gathered),
        "cameras": {
            name: {
                "photographs": sum(one.camera == name for one in gathered),
                **{key: content["cameras"][name][key] for key in ("width", "height", "fx", "fy", "cx", "cy")},
                "focal_sigma": lens.sigma,
                "focal": lens.source,
                "principal_point": lens.center_source,
                "principal_point_sigma": lens.center_sigma,
                "distortion": lens.distortion_source,
                "distortion_sigma": lens.distortion_sigma,
            }
            for name, lens in lenses.items()
        },
        "gravity": _counts(gravity),
        "gravity_sigma_deg": content.get("down_in_cam_sigma_deg"),
        "heading": _counts(turned),
        "position": _counts(placed),
        "position_sigma": content.get("position_sigma"),
        "crs": placement.crs,
        "origin": list(placement.origin),
        "north_deg": round(float(placement.north_deg.mean()), 4),
        "vertical": None if placement.vertical is None else str(placement.vertical),
        "altitude_range": [float(altitudes.min()), float(altitudes.max())] if len(altitudes) else None,
        "height": sum("height" in image for image in images),
        "without_position": {gathered[i].name: reason for i, reason in placement.lacking.items()},
    }


def _counts(sources: Iterable[str]) -> dict[str, int]:
    return dict(Counter(sources).most_common())


def oddities(gathered: Sequence[Gathered], lenses: Mapping[str, Lens], films: Sequence[Path]) -> list[str]:
    """What is odd, one sentence each."""
    notes = [f"{one.name}: {note}" for one in gathered for note in one.photograph.notes]
    notes += [f"{one.name}: {SKY}; that is not used" for one in gathered if one.looks_up]
    bare = [one.name for one in gathered if not one.photograph.has_tags]
    if bare:
        several = f"{bare[0]} and {len(bare) - 1} others have" if len(bare) > 1 else f"{bare[0]} has"
        notes.append(
            f"{several} neither EXIF nor XMP: say what you know by camera= or focal_px=, and by a table "
            "(gravity as down_x, down_y, down_z; height; x, y, z)"
        )
    guessed = [one for one in gathered if lenses[one.camera].is_guessed]
    if guessed:
        notes.append(
            f"the focal length of {len(guessed)} photographs is a guess: calibrate the camera with `torchrefrac "
            "calibrate`, or give focal_px="
        )
    wide = {one.camera for one in gathered if one.photograph.body[0].lower() in FISHEYES}
    bent = [name for name in lenses if name in wide and not lenses[name].distortion_source]
    if bent:
        notes.append(
            f"{', '.join(bent)} bends straight lines, which no tag describes: calibrate it with `torchrefrac calibrate "
            "model=fisheye`"
        )
    if films:
        notes.append(f"{len(films)} films are not used, as {films[0].name}: name one as photos=FILM")
    return notes + odd_times([one.photograph.time for one in gathered], [one.name for one in gathered])
