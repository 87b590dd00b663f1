"""How well what was adjusted is determined, as a scene keeps it."""

from torchrefrac.bundle import BundleProblem, determinations, uncertainty
from torchrefrac.optim import SingularError
from torchrefrac.scene import Assessment, Scene, mean_deviation


def assess(problem: BundleProblem, scene: Scene, fixed: dict[str, str], num_points: int | None = None) -> Assessment:
    """At the minimum `scene`; fixed: what was not refined, and why; num_points: leave out the points after these.

    Where the data do not determine even the cameras nothing is said but what was fixed.
    """
    try:
        known = uncertainty(problem, scene)
        found = determinations(problem, scene, known.pixel_sigma) if scene.index_ratio > 1.0 else []
    except SingularError:
        return Assessment(fixed=fixed)
    centers = known.pose[:, 3:, 3:]
    return Assessment(
        pixel_sigma=known.pixel_sigma,
        point_sigma=known.point_sigma[:num_points],
        center_sigma=mean_deviation(centers),
        center_covariance=centers,
        index_ratio_sigma=float(known.index_ratio) if "index_ratio" in problem.layout.water else None,
        determined=tuple(d.sentence for d in found),
        fixed=fixed,
    )
