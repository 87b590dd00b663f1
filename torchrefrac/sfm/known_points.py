"""Cameras and interfaces from points whose places are known, as the corners of a board: a calibration through water."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.bundle import (
    BundleOptions,
    BundleReport,
    Determination,
    Uncertainty,
    adjust,
    determinations,
    uncertainty,
)
from torchrefrac.checks import TorchrefracError
from torchrefrac.geometry import Rigid
from torchrefrac.optim import SingularError
from torchrefrac.scene import Scene, Views
from torchrefrac.sfm.pinhole import pose_of_points
from torchrefrac.sfm.ports import ApparentPinholes
from torchrefrac.sfm.pose import Pose

ROUGH = 25.0
"""Pixels that a pose without refraction may miss points by; it starts the adjustment alone."""
OUTLYING = 4.0
"""Standard deviations of an error beyond which an observation is left out."""
ROUNDS = 4


class CalibrationError(TorchrefracError, ValueError):
    """Known points do not carry a calibration; the message says what is missing."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """scene: with all poses, and intrinsics and interfaces as adjusted. report: of the last adjustment. known: how well
    everything is determined; None: it is not. determined: the same of water and intrinsics, as judgements."""

    scene: Scene
    report: BundleReport
    known: Uncertainty | None
    determined: tuple[Determination, ...]

    @property
    def rms(self) -> float:
        """Root mean square of the reprojection errors of what was not left out, pixels."""
        return float(self.scene.errors()[self.scene.accepted].square().mean().sqrt())


def calibrate_by_points(scene: Scene, options: BundleOptions | None = None) -> Calibration:
    """The poses of all views of `scene`, whose points count as known, and what its cameras and interfaces state to be
    uncertain, or `options` want refined.

    Poses that the scene has are not looked at: each begins with a pinhole's, behind a port with that which fits the
    rays in the water best. A plane in the world must be stated in the frame of the points; what it is off may be some
    degrees and tenths of a height. Errors beyond 4 standard deviations are left out. Raises CalibrationError for views
    that see fewer than six points, or from which none is found.
    """
    options = options or BundleOptions()
    scene = replace(scene, views=_posed(scene), accepted=torch.ones_like(scene.accepted))
    scene = replace(scene, placed=torch.ones_like(scene.placed))
    report = _adjusted(scene, replace(options, loss="huber", loss_scale=2.0, refine=()))
    for i in range(ROUNDS):
        scene = _as_adjusted(scene, report)
        fits = _fitting(scene, options.pixel_sigma)
        if i and torch.equal(fits, scene.accepted):
            break
        scene = replace(scene, accepted=fits)
        report = _adjusted(scene, options)
    return Calibration(_as_adjusted(scene, report), report, *_how_well(report))


def _as_adjusted(scene: Scene, report: BundleReport) -> Scene:
    found = report.scene
    return replace(scene, views=found.views, cameras=found.cameras, interfaces=found.interfaces)


def _posed(scene: Scene) -> Views:
    """The views by poses of pinholes."""
    views, seen, ports = scene.views, scene.observations, None
    if scene.interfaces.move_with_camera:
        ports = ApparentPinholes(scene.cameras, scene.interfaces, views.camera, views.interface)
    found: list[Pose] = []
    for view, name in enumerate(views.names):
        mine = seen[(seen.view == view).nonzero()[:, 0]]
        pixels = mine.pixels if ports is None else ports.pixels(view, mine.pixels)
        intrinsics = (scene.cameras if ports is None else ports.cameras).of_views(views.camera[view])
        pose = pose_of_points(intrinsics, pixels, scene.points[mine.point], ROUGH)
        if pose is None:
            raise CalibrationError(
                f"{name} sees {len(mine)} known points, from which no pose was found; give six or more that are spread "
                "over the image, and check their order"
            )
        found.append(pose)
    rotation, center = (torch.stack([getattr(pose, name) for pose in found]) for name in ("rotation", "center"))
    if ports is not None:
        center = ports.centers(tuple(range(len(found))), rotation, center)
    return replace(views, pose=Rigid(rotation, center), registered=torch.ones_like(views.registered))


def _adjusted(scene: Scene, options: BundleOptions) -> BundleReport:
    used = scene.observations[scene.accepted.nonzero()[:, 0]]
    return adjust(
        replace(scene, observations=used, accepted=torch.ones_like(used.point, dtype=torch.bool)),
        options,
        fix_points=True,
    )


def _fitting(scene: Scene, pixel_sigma: float) -> Bool[Tensor, " k"]:
    """Which observations are not far off, by their own scatter."""
    error = scene.errors()
    typical = 1.4826 * error.median() / 1.1774  # of a coordinate: the median length is 1.1774 of it
    return error <= OUTLYING * torch.maximum(typical, error.new_tensor(0.1 * pixel_sigma)) * 1.5


def _how_well(report: BundleReport) -> tuple[Uncertainty | None, tuple[Determination, ...]]:
    try:
        known = uncertainty(report.problem, report.scene)
        found = determinations(report.problem, report.scene, known.pixel_sigma)
    except SingularError:
        return None, ()
    return known, tuple(found)
