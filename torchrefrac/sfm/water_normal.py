"""Which way the water's normal points in the frame of a reconstruction, where nobody has measured it."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.bundle import UnadjustableError
from torchrefrac.geometry import Similarity, nearest_rotation
from torchrefrac.numerics import components, thin
from torchrefrac.recorder import Recorder, SilentRecorder
from torchrefrac.scene import Interfaces, Scene, Survey
from torchrefrac.sfm.frame import moved
from torchrefrac.sfm.outcome import Outcome
from torchrefrac.sfm.rules import ReadjustOptions
from torchrefrac.sfm.vertical import angle_between
from torchrefrac.sfm.water_level import AS_GOOD, candidate_offsets, misfit, short_adjustment

POINTS, OF_EACH = 200, 10
"""That the search looks at, for all images together, or for each where that is more."""
TILTS_DEG, AZIMUTHS = (20.0, 40.0), 6
"""Of the normals that are tried, about that which cameras and points ask for."""
LEVELS = 2
"""That are tried with each, the highest: from a plane near the cameras the search goes farthest."""
APART_DEG = 5.0
"""Between two normals that are not the same."""
REMEDY = "give plane.normal, or down_in_cam of some images or positions of three in a survey"


def with_found_normal(
    scene: Scene, survey: Survey, options: ReadjustOptions, recorder: Recorder | None = None
) -> tuple[Scene, Outcome]:
    """The scene with its one surface at the normal, of those tried, from which a short adjustment of some points fits
    the images best, after that adjustment and one of all points; and how the latter ended.

    Tilt and height of the plane must be among what `options` refine. Tried are the normals of planes through cameras
    and points, the mean optical axis, and others about it. It is a start for an adjustment in which both vary. Raises
    UnadjustableError where nothing refracts, no plane separates the cameras from most points, normals that differ fit
    as well, or the tilt is not determined.
    """
    recorder = recorder or SilentRecorder()
    if not scene.interfaces.stand_in_world:
        raise UnadjustableError(f"the normal of the water cannot be seen at an index ratio of 1; {REMEDY}")
    some = _some_points(scene)
    if not len(some.points):
        raise UnadjustableError("the reconstruction has no points, which could show how the water lies")
    tried = [
        _with_plane(some, normal, offset)
        for normal in candidate_normals(some)
        for offset in candidate_offsets(_with_plane(some, normal))[-LEVELS:]
    ]
    found = []
    for candidate in recorder.track(tried, len(tried), "water normal", "plane"):
        after, _ = short_adjustment(candidate, survey, options)
        found.append((misfit(after, options.max_error), _in_frame_of(scene, after)))
    least, best = min(found, key=lambda one: one[0])
    good = torch.stack([surfaces.normal[0] for cost, surfaces in found if cost <= AS_GOOD * least])
    spread = float(angle_between(good, best.normal).max().rad2deg())
    if spread > APART_DEG:
        raise UnadjustableError(
            f"normals of the water that are {spread:.0f} degrees apart fit the images as well; {REMEDY}"
        )
    after, outcome = short_adjustment(replace(scene, interfaces=best), survey, options)
    if outcome.report is not None and "plane_tilt" in outcome.report.fixed:
        raise UnadjustableError(f"{outcome.report.fixed['plane_tilt']}; {REMEDY}")
    return replace(scene, interfaces=_in_frame_of(scene, after)), outcome


def candidate_normals(scene: Scene) -> Float[Tensor, "k 3"]:
    """Unit vectors that point from most points to all cameras. Raises UnadjustableError where there are none."""
    center, axis = scene.views.center, -scene.views.rotation[:, 2].mean(dim=0)
    flat = torch.stack([_thinnest(of) for of in (center, scene.points)])
    first, second = torch.linalg.svd(axis[None])[2][1:]
    turn = torch.linspace(0.0, 2.0 * torch.pi, AZIMUTHS + 1).to(axis)[:-1, None]
    around = turn.cos() * first + turn.sin() * second
    up = torch.nn.functional.normalize(axis, dim=0)
    tilts = torch.deg2rad(axis.new_tensor(TILTS_DEG))[:, None, None]
    normals = torch.cat((up[None], flat, (tilts.cos() * up + tilts.sin() * around).reshape(-1, 3)))
    towards = center.mean(dim=0) - scene.points.median(dim=0).values
    normals = torch.where((normals @ towards)[:, None] < 0.0, -normals, normals)
    parts = (scene.points @ normals.T).median(dim=0).values < (center @ normals.T).amin(dim=0)
    if not bool(parts.any()):
        raise UnadjustableError(
            f"no plane separates the cameras from most points, so that no water lies between; {REMEDY}"
        )
    return normals[parts]


def _in_frame_of(given: Scene, adjusted: Scene) -> Interfaces:
    """The surfaces of an adjusted scene to the cameras as they were given: nothing fixes where all of them go."""
    before, after = given.views, adjusted.views
    turn = nearest_rotation((before.rotation.mT @ after.rotation).mean(dim=0))
    middle, goal = after.center.mean(dim=0), before.center.mean(dim=0)
    a, b = (after.center - middle) @ turn.mT, before.center - goal
    scale = (a * b).sum() / a.square().sum()
    return moved(adjusted, Similarity(scale, turn, goal - scale * (turn @ middle))).interfaces


def _thinnest(points: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """The axis along which points differ least."""
    return torch.linalg.svd(points - points.mean(dim=0), full_matrices=False)[2][-1]


def _with_plane(scene: Scene, normal: Float[Tensor, "3"], offset: Float[Tensor, ""] | None = None) -> Scene:
    surfaces = scene.interfaces
    at = torch.zeros_like(surfaces.offset) if offset is None else offset[None]
    return replace(scene, interfaces=replace(surfaces, normal=normal[None], offset=at))


def _some_points(scene: Scene) -> Scene:
    """With few of the points, if these connect all images."""
    chosen = torch.zeros_like(scene.placed)
    chosen[thin(torch.arange(len(chosen)), max(POINTS, OF_EACH * len(scene.views)))] = True
    part = replace(scene, accepted=chosen[scene.observations.point]).trimmed()
    seen, m = part.observations, len(part.views)
    label = components(seen.view, seen.point + m, m + len(part.points))
    return part if int(label.max()) == 0 else scene
