"""A list of pairs of images to match, as COLMAP reads it: the names of two images a line."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool

from torchrefrac.files.control_points import text_lines
from torchrefrac.scene import CaptureError


def read_match_list(path: Path, names: Sequence[str]) -> Bool[torch.Tensor, "m m"]:
    """Which pairs of the images `names` a file lists, in any order; lines that begin with # say nothing. Names may
    have blanks.

    Raises CaptureError, with the line, for a name that is none of an image here, and for an image paired with itself.
    """
    known, chosen = {name: i for i, name in enumerate(names)}, torch.zeros(len(names), len(names), dtype=torch.bool)
    for number, line in text_lines(path, "a list of the names of two images a line"):
        if line.startswith("#"):
            continue
        first, second = (known[name] for name in _two_names(line, known, f"{path}: line {number}"))
        if first == second:
            raise CaptureError(f"{path}: line {number} pairs {names[first]} with itself; name two images")
        chosen[first, second] = chosen[second, first] = True
    if not bool(chosen.any()):
        raise CaptureError(f"{path} lists no pair, but must have the names of two images a line")
    return chosen


def _two_names(line: str, known: dict[str, int], where: str) -> tuple[str, str]:
    words = line.split(" ")
    if len(words) < 2:
        raise CaptureError(f"{where} has one name, but must have those of two images")
    parted = [(" ".join(words[:at]).strip(), " ".join(words[at:]).strip()) for at in range(1, len(words))]
    for first, second in parted:
        if first in known and second in known:
            return first, second
    first, second = next(((first, second) for first, second in parted if first in known), parted[0])
    unknown = second if first in known else first
    raise CaptureError(f"{where} names {unknown[:60]}, which is no image here: {', '.join(list(known)[:3])}, ...")
