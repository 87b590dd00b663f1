"""How well what was adjusted is determined, as a reconstruction keeps it."""

from torchrefrac.bundle import BundleProblem, BundleState, determinations, uncertainty
from torchrefrac.optim import SingularError
from torchrefrac.scene import Assessment
from torchrefrac.scene.reconstruction import mean_deviation


def assess(
    problem: BundleProblem, state: BundleState, held: dict[str, str], num_points: int | None = None
) -> Assessment:
    """At the minimum `state`; held: what was not refined, and why; num_points: leave out the points after these.

    Where the data do not determine even the cameras nothing is said but what was held.
    """
    try:
        known = uncertainty(problem, state)
        told = determinations(problem, state, known.pixel_sigma) if float(state.index_ratio) > 1.0 else []
    except SingularError:
        return Assessment(held=held)
    centers = known.pose[:, 3:, 3:]
    return Assessment(
        pixel_sigma=known.pixel_sigma,
        point_sigma=known.point_sigma[:num_points],
        center_sigma=mean_deviation(centers),
        center_covariance=centers,
        index_ratio_sigma=float(known.index_ratio) if "index_ratio" in problem.layout.water else None,
        determined=tuple(d.sentence for d in told),
        held=held,
    )
