"""What images and measurements say about water, lens and scale - before anybody believes what they were refined to."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.bundle.gauge import SCALE, similarity_motions
from torchrefrac.bundle.layout import WATER_WIDTH, Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.state import BundleState
from torchrefrac.bundle.terms import GlobalPrior, HeightPrior
from torchrefrac.optim import Covariance, SingularError

UNNOTICED = 1e-6
WORDS = {
    "index_ratio": "index ratio",
    "plane_tilt": "tilt of the water to the cameras",
    "plane_height": "height of cameras above the water, relative",
    "scale": "scale, relative",
    "focal": "focal length, relative",
    "principal_point": "principal point",
    "radial": "radial distortion",
    "distortion": "distortion",
}
UNITS = {"plane_tilt": " degrees", "principal_point": " px"}
USEFUL = {  # a standard deviation beyond which refining tells nothing that was not known better
    "index_ratio": 0.05,
    "plane_tilt": 5.0,
    "plane_height": 0.25,
    "focal": 0.1,
    "principal_point": 200.0,
    "radial": 0.5,
    "distortion": 0.5,
}
VAGUE = {  # what stands in for no knowledge: far beyond that, and yet no rounding error of what images say
    name: 10.0 * USEFUL[name] for name in ("focal", "principal_point", "radial", "distortion", "index_ratio")
}


@dataclass(frozen=True)
class Determination:
    """How well one quantity is known: as a standard deviation, after the adjustment (inf: not at all) and before it
    (None: not at all). Tilts are in degrees, heights relative to the mean height of the cameras."""

    name: str
    posterior: float
    prior: float | None = None

    @property
    def useful(self) -> bool:
        """Whether the data, or what was known before, determine it well enough to refine it."""
        return self.prior is not None or self.posterior <= USEFUL.get(self.name, math.inf)

    @property
    def sentence(self) -> str:
        """For people."""
        unit = UNITS.get(self.name, "")
        if math.isinf(self.posterior):
            return f"{WORDS[self.name]}: not determined"
        told = f"{WORDS[self.name]}: determined to {self.posterior:.2g}{unit}"
        if self.prior is None:
            return told
        if self.posterior > 0.9 * self.prior:
            return f"{told}, which is what was known before"
        return f"{told} (known to {self.prior:.2g}{unit} before)"


def determinations(problem: BundleProblem, state: BundleState, pixel_sigma: float) -> list[Determination]:
    """How well index ratio, plane, scale and what is refined of the lens are determined at `state`.

    Asked of the adjustment in which all of them vary, whether or not they do in `problem`. Plane and heights are
    relative to the cameras. Raises SingularError where not even the cameras are determined.
    """
    layout = replace(problem.layout, water=tuple(WATER_WIDTH))
    names = (*layout.lens, "index_ratio")
    vague = [GlobalPrior(name, state, VAGUE[name]) for name in names]
    expected = problem.options.expected
    known = [
        GlobalPrior(name, state, sigma)
        for name in WATER_WIDTH
        if name not in problem.layout.water and (sigma := expected.sigma_of(name)) is not None
    ]
    options = replace(problem.options, loss="squared", pixel_sigma=pixel_sigma)
    asked = problem.with_layout(state, layout, options, [*problem.terms, *vague, *known])
    system = asked.linearize(state).system
    found = Covariance.of(system)
    dead = torch.nn.functional.pad(system.dead, (0, 1), value=True)
    gauge = system.null_space
    motions, held = similarity_motions(state, layout)
    height = _mean_height(problem, state)
    weights = _camera_weights(layout, height, torch.cat((motions, held)))

    def deviation(column: int, functional: Tensor | None = None) -> float:
        if bool(dead[column]):
            return math.inf
        if functional is None:
            functional = motions.new_zeros(layout.size)
            functional[column] = 1.0
        return pixel_sigma * _deviation(found.reduced, _against_cameras(functional, motions, held, weights))

    result = []
    for name in layout.lens:
        columns = layout.lens_columns(name, torch.arange(layout.num_lenses)).flatten().tolist()
        result.append(_judged(name, max(deviation(c) for c in columns), 1.0, expected.sigma_of(name)))
    result.append(_judged("index_ratio", deviation(layout.index_column()), 1.0, expected.index_ratio))
    planes = layout.plane_columns(torch.arange(layout.num_planes)).tolist()
    tilt = max(deviation(column) for plane in planes for column in plane[:2])
    result.append(_judged("plane_tilt", tilt, 180.0 / math.pi, expected.sigma_of("plane_tilt")))
    above = max(deviation(plane[2], by) for plane, by in zip(planes, _by_heights(state, layout), strict=True))
    result.append(_judged("plane_height", above, 1.0 / height, expected.plane_height))
    result.append(Determination("scale", _scale_deviation(found.reduced, motions, held, weights, gauge) * pixel_sigma))
    return result


def _judged(name: str, sigma: float, unit: float, prior: float | None) -> Determination:
    beyond = name in VAGUE and sigma > 0.5 * VAGUE[name]
    return Determination(name, math.inf if beyond else sigma * unit, None if prior is None else prior * unit)


def _by_heights(state: BundleState, layout: Layout) -> Tensor:
    """Derivatives (E, size) of the mean heights of the cameras above each plane, in the planes."""
    plane, ones = layout.links.plane, torch.ones_like(state.center[:, 0])
    _, jacobian, columns = HeightPrior(torch.arange(len(plane), device=plane.device), ones, ones).residuals(
        state, layout
    )
    share = ones / torch.bincount(plane, minlength=layout.num_planes)[plane]
    total = ones.new_zeros(layout.num_planes, layout.size + 1)
    total.index_put_((plane[:, None], columns[:, 3:]), jacobian[:, 0, 3:] * share[:, None], accumulate=True)
    return total[:, :-1]


def _camera_weights(layout: Layout, height: float, motions: Tensor) -> Tensor:
    """Of turns and shifts of the cameras (size + k, 1), as large as what they do in an image; zero for the rest. The
    last k are held, poses first."""
    pose = motions.new_tensor((1.0, 1.0, 1.0, *3 * (1.0 / height,))).expand(layout.num_cameras, 6)
    weights = motions.new_zeros(len(motions), 1)
    weights[: pose.numel(), 0] = pose.flatten()
    if layout.held is not None:
        weights[layout.size : layout.size + pose.numel(), 0] = pose.flatten()
    return weights


def _against_cameras(functional: Tensor, motions: Tensor, held: Tensor, weights: Tensor) -> Tensor:
    """`functional` (size) of a scene that is moved so that its cameras, as a whole, stay where they are: Baarda's
    S-transformation. Similarities (size, 7), and of what is held (k, 7), do not change what it gives."""
    basis = torch.linalg.qr(torch.cat((motions, held))).Q
    cameras = weights.square() * basis
    moved = torch.linalg.lstsq(basis.T @ cameras, (basis[: len(functional)].T @ functional)[:, None]).solution
    return functional - (cameras @ moved)[: len(functional), 0]


def _scale_deviation(kept: Tensor, motions: Tensor, held: Tensor, weights: Tensor, gauge: Tensor | None) -> float:
    """Of the scale of all cameras, wherever they are and however turned; inf where the gauge is free to change it."""
    cameras = weights * torch.cat((motions, held))
    shape = torch.linalg.qr(cameras).Q[:, SCALE]  # scale comes last: what shifts and turns cannot do
    functional = (weights[:, 0] * shape)[: len(motions)]
    if gauge is not None and float((functional @ gauge).norm()) > UNNOTICED * float(functional.norm()):
        return math.inf
    return _deviation(kept, functional) / abs(float(shape @ cameras[:, SCALE]))


def _deviation(kept: Tensor, functional: Tensor) -> float:
    return math.sqrt(max(float(functional @ kept @ functional), 0.0))


def _mean_height(problem: BundleProblem, state: BundleState) -> float:
    normal, offset = (value[problem.layout.links.plane] for value in state.planes)
    return float(((normal * state.center).sum(dim=-1) - offset).abs().mean())


def unseen(problem: BundleProblem, state: BundleState, pixel_sigma: float) -> dict[str, str]:
    """What `problem` refines of lens and water although nothing determines it, and a sentence about each."""
    refined = (*problem.layout.lens, *problem.layout.water)
    if not refined:
        return {}
    try:
        found = determinations(problem, state, pixel_sigma)
    except SingularError:
        return {}
    return {d.name: d.sentence for d in found if d.name in refined and not d.useful}
