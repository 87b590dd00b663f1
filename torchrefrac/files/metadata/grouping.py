"""Cameras of a capture: photographs of one body, lens and size share one."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Literal

from torchrefrac.files.metadata.gathered import Gathered
from torchrefrac.files.metadata.lens import Lens
from torchrefrac.files.metadata.photograph import Photograph
from torchrefrac.scene.capture import CaptureError

Rule = Literal["model", "folder"]


def camera_names(photographs: Sequence[Photograph], rule: Rule = "model") -> list[str]:
    """Of each photograph the name of its camera.

    rule "model": by make, model, serial number, focal length and size; "folder": by the folder in which they lie and by
    size, where cameras of one model do not tell their numbers.
    """
    groups = [_key(photograph, rule) for photograph in photographs]
    names: dict[tuple[object, ...], str] = {}
    for group, photograph in zip(groups, photographs, strict=True):
        if group not in names:
            name, taken = _name(photograph, rule), set(names.values())
            others = (f"{name}_{number}" for number in range(2, len(photographs) + 2))
            names[group] = name if name not in taken else next(other for other in others if other not in taken)
    return [names[group] for group in groups]


def shared_lens(lenses: Sequence[Lens]) -> Lens:
    """One lens for all photographs of a camera: the best known, and of these, number by number, the median."""
    best = min(lens.sigma for lens in lenses)
    alike = [lens for lens in lenses if lens.sigma == best]
    first = alike[0]
    alike = [lens for lens in alike if lens.source == first.source]

    def middle(name: str) -> tuple[float, ...]:
        return tuple(median(values) for values in zip(*(getattr(lens, name) for lens in alike), strict=True))

    focal, center = middle("focal"), middle("principal_point")
    return replace(
        first, focal=(focal[0], focal[1]), principal_point=(center[0], center[1]), distortion=middle("distortion")
    )


def by_camera(gathered: Sequence[Gathered], lenses: Sequence[Lens]) -> dict[str, Lens]:
    """The shared lens of each camera, from those of its photographs. Raises CaptureError where a table gives one camera
    to photographs of several sizes."""
    sizes: dict[str, tuple[int, int]] = {}
    for one in gathered:
        size = sizes.setdefault(one.camera, one.photograph.size)
        if size != one.photograph.size:
            found, wanted = (f"{width}x{height}" for width, height in (one.photograph.size, size))
            problem = f"is {found}, but others of camera {one.camera!r} are {wanted}; name another camera in the table"
            raise CaptureError(f"{one.name} {problem}")
    groups = {name: [lens for one, lens in zip(gathered, lenses, strict=True) if one.camera == name] for name in sizes}
    return {name: shared_lens(group) for name, group in groups.items()}


def _key(photograph: Photograph, rule: Rule) -> tuple[object, ...]:
    if rule == "folder":
        return photograph.path.parent, photograph.size
    return *photograph.body, photograph.focal_mm, photograph.size


def _name(photograph: Photograph, rule: Rule) -> str:
    _, model, _ = photograph.body
    lens = f"{photograph.focal_mm:g}mm" if photograph.focal_mm and rule == "model" else ""
    body = Path(photograph.path).parent.name if rule == "folder" else model
    parts = (body or "camera", lens, f"{photograph.width}x{photograph.height}")
    return re.sub(r"[^\w.-]+", "-", "_".join(part for part in parts if part))
