"""What boards and tags in photographs make of a survey: points to be found in all of them, and the lengths between."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from torchrefrac.files.metadata.boards import Sighting
from torchrefrac.scene.survey import ControlPoint, ScaleBar, Survey, resolve

LEAST_SIGMA = 1e-4  # m; of a length on a board, however short it is
HALF_A_PIXEL = 0.5  # from the pixels of OpenCV to those of a scene
DIAGONALS = np.array(((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)))


def survey_of(sightings: Mapping[str, Sequence[Sighting]], sigma: float) -> Survey:
    """Of what each photograph shows, by its name: every corner that two of them show as a ground control point, and
    scale bars between the outermost corners of each board or tag, known to `sigma` of their lengths (in m).

    Nothing is known of where boards are, to each other or in the world.
    """
    pixels: dict[str, dict[str, list[float]]] = {}
    places: dict[str, dict[str, Float[np.ndarray, " 3"]]] = {}
    for image, boards in sightings.items():
        for board in boards:
            corners = zip(board.number.tolist(), board.place.astype(float), board.pixels.tolist(), strict=True)
            for number, place, (x, y) in corners:
                name = f"{board.name} corner {number}"
                pixels.setdefault(name, {})[image] = [x + HALF_A_PIXEL, y + HALF_A_PIXEL]
                places.setdefault(board.name, {})[name] = place
    points = {name: ControlPoint(seen) for name, seen in sorted(pixels.items()) if ControlPoint(seen).is_placed}
    bars = [
        bar
        for corners in places.values()
        for bar in _bars({name: place for name, place in corners.items() if name in points}, sigma)
    ]
    return resolve({}, points, bars, list(sightings))


def found_on(sightings: Mapping[str, Sequence[Sighting]]) -> dict[str, int]:
    """How many photographs show each board or tag."""
    return dict(Counter(board.name for boards in sightings.values() for board in boards))


def _bars(corners: Mapping[str, Float[np.ndarray, " 3"]], sigma: float) -> Iterator[ScaleBar]:
    """Between the corners that are farthest out along the diagonals: the sides and diagonals of a tag, or of what is
    seen of a board."""
    if not corners:
        return
    names, place = list(corners), np.stack(list(corners.values()))
    outermost = dict.fromkeys((place[:, :2] @ DIAGONALS.T).argmax(axis=0).tolist())
    for start, end in combinations(outermost, 2):
        length = float(np.linalg.norm(place[start] - place[end]))
        yield ScaleBar(names[start], names[end], length, max(sigma * length, LEAST_SIGMA))
