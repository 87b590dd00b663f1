"""How well images and measurements determine water, intrinsics and scale, before refined values are trusted."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle.gauge import SCALE, similarity_motions
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.problem import BundleProblem
from torchrefrac.bundle.rows import INTRINSICS, OF_LAYERS, water_unknowns
from torchrefrac.bundle.terms import GlobalPrior, HeightPrior, prior_sigmas
from torchrefrac.optim import GaussNewtonInverse, SingularError
from torchrefrac.scene import Cameras, Scene

UNNOTICED = 1e-6
WORDS = {
    "index_ratio": "index ratio",
    "layer_index": "index of the glass",
    "layer_thickness": "thickness of the glass, relative",
    "plane_tilt": "tilt of the water to the cameras",
    "plane_height": "height of cameras above the water, relative",
    "scale": "scale, relative",
    "focal": "focal length, relative",
    "principal_point": "principal point",
    "radial": "radial distortion",
    "distortion": "distortion",
}
UNITS = {"plane_tilt": " degrees", "principal_point": " px"}
USEFUL = {  # a standard deviation beyond which refining adds nothing to what was known
    "index_ratio": 0.05,
    "layer_index": 0.05,
    "layer_thickness": 0.25,
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
    (None: not at all). Tilts are in degrees, heights relative to the mean height of the cameras. of: whose it is, where
    there are several cameras (see `Cameras.label`)."""

    name: str
    posterior: float
    prior: float | None = None
    of: str = ""

    @property
    def useful(self) -> bool:
        """Whether the data, or what was known before, determine it well enough to refine it."""
        return self.prior is not None or self.posterior <= USEFUL.get(self.name, math.inf)

    @property
    def sentence(self) -> str:
        """The same in words, with units; and how well it would have to be known where it is not known well enough."""
        unit, (what, *relative) = UNITS.get(self.name, ""), WORDS[self.name].split(", ")
        what = ", ".join((f"{what}{self.of}", *relative))
        if math.isinf(self.posterior):
            return f"{what}: not determined"
        text = f"{what}: determined to {self.posterior:.2g}{unit}"
        if not self.useful:
            return f"{text}, but must be to {USEFUL[self.name]:g}{unit} to be refined"
        if self.prior is None:
            return text
        if self.posterior > 0.9 * self.prior:
            return f"{text}, which is what was known before"
        return f"{text} (known to {self.prior:.2g}{unit} before)"


def determinations(problem: BundleProblem, scene: Scene, pixel_sigma: float) -> list[Determination]:
    """How well index ratio, plane, scale and what is refined of the intrinsics are determined at `scene`.

    pixel_sigma: noise of a keypoint, pixels. Asked of the adjustment in which all of them vary, whether or not they do
    in `problem`. Plane and heights are relative to the cameras. Raises SingularError where not even the cameras are
    determined.
    """
    water = water_unknowns(scene.interfaces)
    layout = replace(problem.layout, water=water)
    names = (*layout.intrinsics, "index_ratio")
    vague = [GlobalPrior(name, scene, VAGUE[name]) for name in names]
    expected = problem.options.expected
    known = [
        GlobalPrior(name, scene, sigma)
        for name in water
        if name not in problem.layout.water and (sigma := expected.sigma_of(name)) is not None
    ]
    options = replace(problem.options, loss="squared", pixel_sigma=pixel_sigma)
    asked = problem.with_layout(scene, layout, options, [*problem.terms, *vague, *known])
    system = asked.linearize(scene).system
    found = GaussNewtonInverse.of(system)
    dead = torch.nn.functional.pad(system.dead, (0, 1), value=True)
    gauge = system.null_space
    motions, fixed = similarity_motions(scene, layout)
    height = _mean_height(problem, scene)
    weights = _camera_weights(layout, height, torch.cat((motions, fixed)))

    def deviation(column: int, functional: Float[Tensor, " size"] | None = None) -> float:
        if bool(dead[column]):
            return math.inf
        if functional is None:
            functional = motions.new_zeros(layout.size)
            functional[column] = 1.0
        return pixel_sigma * _deviation(found, _against_cameras(functional, motions, fixed, weights))

    result = []
    for name in layout.intrinsics:
        priors = prior_sigmas(scene.cameras, name, expected).tolist()
        for camera in layout.camera.unique().tolist():
            columns = layout.intrinsics_columns(name, layout.cameras[camera : camera + 1]).flatten().tolist()
            varying = [deviation(column) for column in columns if column < layout.size]
            if varying:
                prior = priors[camera] if math.isfinite(priors[camera]) else None
                result.append(_judged(name, max(varying), 1.0, prior, scene.cameras.label(camera)))
    result.append(_judged("index_ratio", deviation(layout.medium_column("index_ratio")), 1.0, expected.index_ratio))
    if set(OF_LAYERS) <= set(water):
        relative = 1.0 / float(scene.interfaces.thickness.max().clamp(min=torch.finfo(torch.float64).tiny))
        for name, by in zip(OF_LAYERS, (1.0, relative), strict=True):
            result.append(_judged(name, deviation(layout.medium_column(name)), by, expected.sigma_of(name)))
    planes = layout.plane_columns(layout.interfaces).tolist()
    tilt = max(deviation(column) for plane in planes for column in plane[:2])
    result.append(_judged("plane_tilt", tilt, 180.0 / math.pi, expected.sigma_of("plane_tilt")))
    above = max(deviation(plane[2], by) for plane, by in zip(planes, _by_heights(scene, layout), strict=True))
    result.append(_judged("plane_height", above, 1.0 / height, expected.plane_height))
    result.append(Determination("scale", _scale_deviation(found, motions, fixed, weights, gauge) * pixel_sigma))
    return result


def coefficients_as_stated(layout: Layout, cameras: Cameras) -> dict[str, str]:
    """What does not vary of distortions that do, and a sentence about it of each camera that has it."""
    if "distortion" not in layout.intrinsics:
        return {}
    varies = (layout.intrinsics_columns("distortion", layout.cameras) < layout.size).any(dim=-1)
    beyond = (cameras.distortion[:, INTRINSICS["distortion"].width :] != 0.0).any(dim=-1)
    labels = [cameras.label(camera) for camera in layout.camera.unique().tolist() if bool((varies & beyond)[camera])]
    return {f"k4_to_k6{label}": f"k4 to k6{label}: as stated, for nothing tells them from k1 to k3" for label in labels}


def _judged(name: str, sigma: float, unit: float, prior: float | None, of: str = "") -> Determination:
    beyond = name in VAGUE and sigma > 0.5 * VAGUE[name]
    return Determination(name, math.inf if beyond else sigma * unit, None if prior is None else prior * unit, of)


def _by_heights(scene: Scene, layout: Layout) -> Float[Tensor, "e size"]:
    """Derivatives of the mean heights of the cameras above each plane, in the planes."""
    plane, ones = layout.interface, torch.ones_like(scene.views.center[:, 0])
    every = torch.arange(len(plane), device=plane.device)
    _, jacobian, columns = HeightPrior(every, ones, ones).residuals(scene, layout)
    share = ones / torch.bincount(plane, minlength=layout.num_interfaces)[plane]
    total = ones.new_zeros(layout.num_interfaces, layout.size + 1)
    total.index_put_((plane[:, None], columns[:, 3:]), jacobian[:, 0, 3:] * share[:, None], accumulate=True)
    return total[:, :-1]


def _camera_weights(layout: Layout, height: float, motions: Float[Tensor, "every 7"]) -> Float[Tensor, "every 1"]:
    """Of turns and shifts of the cameras, as large as what they do in an image; zero for the rest. What is fixed comes
    last, poses first."""
    pose = motions.new_tensor((1.0, 1.0, 1.0, *3 * (1.0 / height,))).expand(layout.num_views, 6)
    weights = motions.new_zeros(len(motions), 1)
    weights[: pose.numel(), 0] = pose.flatten()
    if layout.fixed is not None:
        weights[layout.size : layout.size + pose.numel(), 0] = pose.flatten()
    return weights


def _against_cameras(
    functional: Float[Tensor, " size"],
    motions: Float[Tensor, "size 7"],
    fixed: Float[Tensor, "k 7"],
    weights: Float[Tensor, "every 1"],
) -> Float[Tensor, " size"]:
    """`functional` of a scene that is moved so that its cameras, as a whole, stay where they are: Baarda's
    S-transformation. Similarities, and those of what is fixed, do not change what it gives."""
    basis = torch.linalg.qr(torch.cat((motions, fixed))).Q
    cameras = weights.square() * basis
    moved = torch.linalg.lstsq(basis.T @ cameras, (basis[: len(functional)].T @ functional)[:, None]).solution
    return functional - (cameras @ moved)[: len(functional), 0]


def _scale_deviation(
    inverse: GaussNewtonInverse,
    motions: Float[Tensor, "size 7"],
    fixed: Float[Tensor, "k 7"],
    weights: Float[Tensor, "every 1"],
    gauge: Float[Tensor, "size directions"] | None,
) -> float:
    """Of the scale of all cameras, wherever they are and however turned; inf where the gauge is free to change it."""
    cameras = weights * torch.cat((motions, fixed))
    shape = torch.linalg.qr(cameras).Q[:, SCALE]  # scale comes last: what shifts and turns cannot do
    functional = (weights[:, 0] * shape)[: len(motions)]
    if gauge is not None and float((functional @ gauge).norm()) > UNNOTICED * float(functional.norm()):
        return math.inf
    return _deviation(inverse, functional) / abs(float(shape @ cameras[:, SCALE]))


def _deviation(inverse: GaussNewtonInverse, functional: Float[Tensor, " size"]) -> float:
    return float(inverse.deviations(functional[:, None])[0])


def _mean_height(problem: BundleProblem, scene: Scene) -> float:
    return float(scene.camera_heights().abs().mean())


def undetermined(problem: BundleProblem, scene: Scene, pixel_sigma: float) -> dict[str, str]:
    """What `problem` refines of intrinsics and water although nothing determines it, and a sentence about each."""
    refined = (*problem.layout.intrinsics, *problem.layout.water)
    if not refined:
        return {}
    try:
        found = determinations(problem, scene, pixel_sigma)
    except SingularError:
        return {}
    return {d.name: d.sentence for d in found if d.name in refined and not d.useful}
