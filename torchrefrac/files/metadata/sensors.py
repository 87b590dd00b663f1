"""Widths of sensors by the models of cameras that do not say them, in mm: of the whole width of a photograph."""

WIDTHS = {
    "FC200": 6.17, "FC220": 6.17, "FC300C": 6.31, "FC300S": 6.31, "FC300SE": 6.31, "FC300X": 6.31, "FC330": 6.25,
    "FC350": 6.17, "FC550": 17.3, "FC6310": 13.2, "FC6310R": 13.2, "FC6310S": 13.2, "FC6360": 4.87, "FC6510": 13.2,
    "FC6520": 17.3, "FC6540": 23.5, "FC2103": 6.17, "FC2204": 6.17, "FC2403": 6.4, "FC3170": 6.4, "FC3411": 13.2,
    "FC3582": 9.6, "FC7203": 6.17, "FC7303": 6.17, "FC8482": 9.6, "L1D-20C": 13.2, "L2D-20C": 17.4, "M3E": 17.4,
    "M3M": 17.4, "ZENMUSEP1": 35.9, "ZENMUSEL1": 13.2, "XT705": 13.2, "S.O.D.A.": 12.75,
}  # fmt: skip
"""Of drones. Where a model is missing, the resolution of its focal plane serves, or the 35 mm equivalent."""


def sensor_width(model: str) -> float | None:
    """In mm."""
    return WIDTHS.get(model.strip().upper())
