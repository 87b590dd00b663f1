"""How a bundle adjustment is done."""

from dataclasses import dataclass, field
from typing import Literal

from torchrefrac.bundle.terms import Expectations
from torchrefrac.checks import Range, require_ranges
from torchrefrac.optim import IterativeOptions, LevenbergMarquardtOptions, LossName, ReducedSolver

Unknown = Literal[
    "focal",
    "principal_point",
    "radial",
    "distortion",
    "index_ratio",
    "layer_index",
    "layer_thickness",
    "plane_tilt",
    "plane_height",
]


@dataclass(frozen=True)
class BundleOptions:
    """How a bundle adjustment is done.

    loss: of loss_scale pixels. pixel_sigma: expected noise of a keypoint, pixels; weighs it against what else was
    measured.

    refine: what varies besides poses and points: of the intrinsics focal (both focal lengths by the same factor),
    principal_point, radial (k1 and k2), distortion (all five); of the water index_ratio, plane_tilt, plane_height;
    of the one layer before it, if there is one, layer_index and layer_thickness.
    expected: what is known of them beforehand. refine_unseen: vary even what the data do not determine.
    jacobian: exact, or with the refrax ratio frozen as in the paper. reduced_solver: see `optim.Linearized`. compiled:
    hand the derivatives to torch.compile, which takes a minute once and a C++ compiler.

    Raises ValueError for values that cannot be right, and where refine names radial and distortion.
    """

    loss: LossName = "huber"
    loss_scale: float = 0.25
    pixel_sigma: float = 0.3
    refine: tuple[Unknown, ...] = ()
    expected: Expectations = field(default_factory=Expectations)
    refine_unseen: bool = False
    jacobian: Literal["exact", "frozen_ratio"] = "exact"
    reduced_solver: ReducedSolver = "auto"
    iterative: IterativeOptions = field(default_factory=IterativeOptions)
    compiled: bool = False
    solver: LevenbergMarquardtOptions = field(default_factory=LevenbergMarquardtOptions)

    def __post_init__(self) -> None:
        require_ranges(self, dict.fromkeys(("loss_scale", "pixel_sigma"), Range(above=0.0, at_most=1e6)))
        if {"radial", "distortion"} <= set(self.refine):
            raise ValueError("refine has radial and distortion, but the first is part of the second; name one of them")
