"""Widths of sensors by the models of cameras that do not say them, in mm: of the whole width of a photograph."""

WIDTHS = {
    "FC200": 6.17, "FC220": 6.17, "FC300C": 6.31, "FC300S": 6.31, "FC300X": 6.31, "FC300SE": 6.31,
    "FC330": 6.25, "FC350": 6.17, "FC550": 17.3, "FC6310": 13.2, "FC6310R": 13.2, "FC6310S": 13.2, "FC6360": 4.87,
    "FC6510": 13.2, "FC6520": 17.3, "FC6540": 23.5, "FC7203": 6.17, "FC7303": 6.17, "FC2103": 6.17, "FC2204": 6.17,
    "FC2220": 6.17, "FC2403": 6.4, "FC3170": 6.4, "FC3411": 13.2, "FC3582": 9.6, "FC8482": 9.6, "FC8282": 9.6,
    "FC9113": 13.2, "L1D-20C": 13.2, "L2D-20C": 17.4, "M3E": 17.4, "M3M": 17.4, "ZENMUSEP1": 35.9, "ZENMUSEL1": 13.2,
    "EP800": 13.2, "XT701": 13.2, "XT705": 13.2, "ANAFI": 5.96, "BEBOP 2": 5.96, "S.O.D.A.": 12.75, "CANONIXUS": 6.17,
    "HERO4 BLACK": 6.17, "HERO5 BLACK": 6.17, "HERO7 BLACK": 6.17, "HERO9 BLACK": 6.17,
}  # fmt: skip
"""Of drones and action cameras. Where a model is missing, the 35 mm equivalent serves, or a guess."""


def sensor_width(model: str) -> float | None:
    """In mm."""
    return WIDTHS.get(model.strip().upper())
