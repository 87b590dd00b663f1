"""The scene: cameras, views, interfaces, points and observations, from the first pair of views to the last file."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.checks import TorchrefracError
from torchrefrac.geometry import Rigid, levelling, rotate
from torchrefrac.numerics import detached
from torchrefrac.scene.capture import Capture
from torchrefrac.scene.findings import Finding
from torchrefrac.scene.georeference import Georeference
from torchrefrac.scene.interfaces import Interfaces
from torchrefrac.scene.survey import Surveyed, vertical
from torchrefrac.scene.tables import Cameras, Observations, Views


class SceneError(TorchrefracError, ValueError):
    """The parts of a scene do not fit together, or something takes only scenes of a simpler kind."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """How well a scene is determined, as standard deviations; None: not known.

    pixel_sigma: of a keypoint's coordinate, pixels, as estimated from the residuals. point_covariance: of the points in
    world axes, length_unit squared, with what is not known of cameras and water; relative_covariance: without, as if
    these were known. center_sigma of registered views: of a coordinate, in length_unit; center_covariance: of the
    centres. All are relative to the cameras as a whole. surface_slope: root mean square slope of the water surface that
    the residuals show, radians, zero where they show none; surface_moves: whether it differs from image to image.
    common_tilt: how far such errors make verticals of registered views uncertain, radians; growth: by how much they
    make standard deviations larger. index_ratio_sigma: None where it was given. layer_sigma: of "layer_index" and
    "layer_thickness", where they were refined. intrinsics_sigma: by name of what was refined of them ("focal",
    relative, "principal_point", "radial", "distortion"), of each camera; zero where it was not.
    determined: sentences about water, intrinsics and scale; fixed: what was to be refined, but is not determined, and
    why. wished: by how much "index_ratio", "layer_thickness" (of glass before the water) and the logarithm of the
    "focal" length (of each camera, see `Cameras.label`), which were given, would change if the images had a say, and
    the standard deviations of these changes; of a grossly wrong focal length, that alone.
    disputed: how many tracks are seen straight, as their observations say, though they lie within the stated extent of
    the water, and how many through water, though beyond.
    levels: by how much the water stands higher for some views than for the others, for which it is 0; None where one
    level does for all.
    stopped_after: iterations of the last adjustment, where it stopped before it converged.
    lowered_by: how much lower than the positions that the capture or the survey states the scene stands, in whose frame
    it is otherwise: by the height of the water there; None: it is in a frame of its own. up: the vertical of that
    frame, a unit vector in the scene's, in which it is not z where the water slopes.
    tilt_sigma: of the tilt of the water to the cameras, radians, where it was refined; None: it was not.
    level_covariance: of the heights of the interfaces in the frame of the positions, of those that may slope at the
    middle of the cameras; None: it is not known. plane_covariance: of the height of each at x = y = 0, and of its
    slopes along x and y; None: these did not vary.
    surveyed: what became of the survey that the scene was adjusted with; None: there was none.
    water_stated: index ratio of water that was stated, but that the images do not show; None: there is none such.
    in_air_and_water: of a scene without refraction, what its typical reprojection error is and would be under water.
    """

    pixel_sigma: float | None = None
    point_covariance: Float[Tensor, "n 3 3"] | None = None
    relative_covariance: Float[Tensor, "n 3 3"] | None = None
    center_sigma: Float[Tensor, " r"] | None = None
    center_covariance: Float[Tensor, "r 3 3"] | None = None
    index_ratio_sigma: float | None = None
    layer_sigma: Mapping[str, float] = field(default_factory=dict)
    intrinsics_sigma: Mapping[str, Float[Tensor, "g _"]] = field(default_factory=dict)
    determined: tuple[str, ...] = ()
    fixed: Mapping[str, str] = field(default_factory=dict)
    wished: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    surface_slope: float = 0.0
    surface_moves: bool = False
    common_tilt: Float[Tensor, " r"] | None = None
    growth: float = 1.0
    disputed: tuple[int, int] = (0, 0)
    levels: Float[Tensor, " m"] | None = None
    stopped_after: int | None = None
    lowered_by: float | None = None
    up: Float[Tensor, "3"] = field(default_factory=vertical)
    level_covariance: Float[Tensor, "e e"] | None = None
    plane_covariance: Float[Tensor, "e 3 3"] | None = None
    surveyed: Surveyed | None = None
    tilt_sigma: float | None = None
    water_stated: float | None = None
    in_air_and_water: tuple[float, float] | None = None

    def of_points(self, points: Int[Tensor, " p"]) -> "Assessment":
        """Of some of the points."""
        full, relative = self.point_covariance, self.relative_covariance
        return replace(
            self,
            point_covariance=None if full is None else full[points],
            relative_covariance=None if relative is None else relative[points],
        )

    def spread_over(self, placed: Bool[Tensor, " n"]) -> "Assessment":
        """Of all points, where it is of those that are `placed`; of the others nothing is known: infinite."""

        def spread(known: Float[Tensor, "p 3 3"] | None) -> Float[Tensor, "n 3 3"] | None:
            if known is None:
                return None
            return known.new_full((len(placed), 3, 3), torch.inf).index_put((placed,), known)

        return replace(
            self,
            point_covariance=spread(self.point_covariance),
            relative_covariance=spread(self.relative_covariance),
        )

    @property
    def level_sigma(self) -> Float[Tensor, " e"] | None:
        """Standard deviations of the heights of the interfaces."""
        return None if self.level_covariance is None else self.level_covariance.diagonal().clamp(min=0.0).sqrt()

    @property
    def water_level_sigma(self) -> float | None:
        """That of the height of the first interface."""
        return None if self.level_sigma is None else float(self.level_sigma[0])

    def level_variance(
        self, surface: Int[Tensor, " k"], first: Float[Tensor, "k 2"], second: Float[Tensor, "k 2"]
    ) -> Float[Tensor, " k"]:
        """Covariances of the heights of interfaces at two places each."""
        if self.plane_covariance is None:
            assert self.level_covariance is not None
            return self.level_covariance.diagonal().clamp(min=0.0)[surface]
        one = torch.ones_like(first[:, :1])
        first, second = torch.cat((one, first), dim=1), torch.cat((one, second), dim=1)
        return (first[:, None] @ self.plane_covariance[surface] @ second[..., None])[:, 0, 0]

    @property
    def level_from_world(self) -> Float[Tensor, "3 3"]:
        """Rotation into the frame that is level."""
        return levelling(-self.up)

    @property
    def slope(self) -> tuple[float, float]:
        """By how much the plane z = 0 rises to the east and to the north, per unit of length."""
        east, north = (self.up[:2] / self.up[2]).tolist()
        return east, north

    @property
    def point_sigma(self) -> Float[Tensor, " n"] | None:
        """Standard deviation of each point, in length_unit, along the axis in which it is known worst."""
        return None if self.point_covariance is None else largest_deviation(self.point_covariance)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is known of a scene, at any stage; every step makes a new one.

    World: z up, the (first) interface at z = 0 unless a file says otherwise; lengths in length_unit. Points have a
    position where `placed`, and colours (RGB); those that are `dry` are seen straight even below the surface, as there
    is no water before them (None: no point is known to be so). Observations ascend by point; `accepted` are those that
    support a placed point in a registered view. failures: why a view is not registered, by name. findings: what the
    images say against what was stated. capture: the photographs of the views, in their order, where they are at hand.
    georeference: where the scene's own frame stands on Earth, its origin in the water's surface, where that is known.
    further: reconstructions of views that are not registered here, as nothing joins them with those that are, each in a
    frame of its own.

    Raises SceneError where shapes do not fit together, an index is out of range or observations do not ascend.
    """

    cameras: Cameras
    views: Views
    interfaces: Interfaces
    points: Float[Tensor, "n 3"]
    colors: UInt8[Tensor, "n 3"]
    placed: Bool[Tensor, " n"]
    observations: Observations
    accepted: Bool[Tensor, " k"]
    dry: Bool[Tensor, " n"] | None = None
    length_unit: str = "unit"
    failures: Mapping[str, str] = field(default_factory=dict)
    assessment: Assessment = field(default_factory=Assessment)
    findings: tuple[Finding, ...] = ()
    capture: Capture | None = None
    georeference: Georeference | None = None
    further: tuple["Scene", ...] = ()

    @classmethod
    def of_capture(
        cls, capture: Capture, observations: Observations, colors: UInt8[Tensor, "n 3"], index_ratio: float
    ) -> "Scene":
        """Before anything is known: views without poses, points (the tracks of `observations`) without positions,
        behind interfaces of this index ratio; dry where most photographs in which the water's extent is drawn show
        them outside."""
        m, n, interfaces = len(capture), len(colors), capture.interfaces
        extent = capture.water_extent if index_ratio > 1.0 else None
        posed = torch.zeros(m, dtype=torch.bool)
        return cls(
            cameras=capture.cameras,
            views=Views(capture.names, Rigid.identity(m), capture.camera, capture.interface, posed),
            interfaces=interfaces.with_index_ratio(index_ratio),
            points=torch.zeros(n, 3, dtype=torch.float64),
            colors=colors,
            placed=torch.zeros(n, dtype=torch.bool),
            observations=observations,
            accepted=torch.zeros(len(observations), dtype=torch.bool),
            dry=extent.all_votes(observations, n) > 0 if extent is not None and extent.is_drawn else None,
            length_unit=capture.length_unit,
            capture=capture,
        )

    @classmethod
    def create(
        cls,
        pose: Rigid,
        intrinsics: Intrinsics | Sequence[Intrinsics] | Cameras,
        interfaces: Interfaces,
        points: Float[Tensor, "n 3"],
        observations: Observations,
        *,
        names: Sequence[str] | None = None,
        camera: Int[Tensor, " m"] | None = None,
        interface: Int[Tensor, " m"] | None = None,
        colors: UInt8[Tensor, "n 3"] | None = None,
        length_unit: str = "unit",
    ) -> "Scene":
        """A scene in which every view is registered, every point placed and every observation accepted, checked.

        By default views have the first camera and the first interface, and points are white.
        """
        device, count = points.device, len(points)
        white = torch.full((count, 3), 255, dtype=torch.uint8, device=device)
        scene = cls(
            cameras=_table(intrinsics),
            views=Views.posed(pose, names, camera, interface),
            interfaces=interfaces,
            points=points,
            colors=white if colors is None else colors,
            placed=torch.ones(count, dtype=torch.bool, device=device),
            observations=observations,
            accepted=torch.ones(len(observations), dtype=torch.bool, device=device),
            length_unit=length_unit,
        )
        scene.check()
        return scene

    def check(self) -> None:
        """Raise SceneError where the tables do not fit together."""
        m, n, k, e = len(self.views), len(self.points), len(self.observations), len(self.interfaces)
        shapes = {
            "camera": (self.views.camera, (m,)),
            "interface": (self.views.interface, (m,)),
            "rotation": (self.views.rotation, (m, 3, 3)),
            "center": (self.views.center, (m, 3)),
            "points": (self.points, (n, 3)),
            "colors": (self.colors, (n, 3)),
            "view": (self.observations.view, (k,)),
            "point": (self.observations.point, (k,)),
            "pixels": (self.observations.pixels, (k, 2)),
            "normal": (self.interfaces.normal, (e, 3)),
            "index_ratio": (self.interfaces.index_ratio, (e,)),
            "layers": (self.interfaces.layers, (e, self.interfaces.layers.shape[-1])),
            "thickness": (self.interfaces.thickness, (e, self.interfaces.layers.shape[-1])),
        }
        if self.dry is not None:
            shapes["dry"] = (self.dry, (n,))
        for name, (value, wanted) in shapes.items():
            if tuple(value.shape) != wanted:
                raise SceneError(
                    f"{name} has shape {tuple(value.shape)}, but must have {wanted} with {m} views, {n} points, {k} "
                    f"observations and {e} interfaces"
                )
        if problem := self.interfaces.problem():
            raise SceneError(problem)
        indices = (("camera", len(self.cameras)), ("interface", len(self.interfaces)), ("view", m), ("point", n))
        for name, count in indices:
            require_index(shapes[name][0], name, count)
        if bool((self.observations.point.diff() < 0).any()):
            raise SceneError("point does not ascend; sort the observations by point")

    @property
    def intrinsics(self) -> Intrinsics:
        """Those of the one camera. Raises SceneError where there are several."""
        if len(self.cameras) != 1:
            raise SceneError(f"the scene has {len(self.cameras)} cameras, but only one can be used here")
        return self.cameras[0]

    @property
    def index_ratio(self) -> float:
        """Index ratio n_water / n_air of all interfaces. Raises SceneError where they differ."""
        ratio = self.interfaces.index_ratio
        if bool((ratio != ratio[0]).any()):
            raise SceneError(f"the interfaces have index ratios {ratio.tolist()}, but only one can be used here")
        return float(ratio[0])

    def camera_of(self, view: Any = slice(None), point: Int[Tensor, "*batch"] | None = None) -> RefractiveCamera:
        """The cameras of views (*B) as a batch (*B), by default of all; of views that are not registered they mean
        nothing. point (*B): what each looks at, without water before it where the point is dry; by default through
        water."""
        views = self.views
        intrinsics = self.cameras.of_views(views.camera[view])
        dry = None if self.dry is None or point is None else self.dry[point]
        interface = self.interfaces.of_views(views.interface[view], dry)
        return RefractiveCamera(intrinsics, views.rotation[view], views.center[view], interface, check=False)

    def cameras_of(self, seen: Observations) -> RefractiveCamera:
        """The camera of each observation (k) as a batch (k), looking at the point that is observed."""
        return self.camera_of(seen.view, seen.point)

    def errors(self) -> Float[Tensor, " k"]:
        """Reprojection errors in pixels; inf where there is no pose, no position or no projection."""
        seen = self.observations
        usable = self.views.registered[seen.view] & self.placed[seen.point]
        result = torch.full_like(seen.pixels[:, 0], torch.inf)
        seen = seen[rows := usable.nonzero()[:, 0]]
        result[rows] = reprojection_errors(self.cameras_of(seen), self.points[seen.point], seen.pixels)
        return result

    def camera_heights(self) -> Float[Tensor, " m"]:
        """Of the centres of all views before the first surface that each looks through, negative beyond it."""
        interfaces, of = self.interfaces, self.views.interface
        normal, offset = interfaces.normal[of], interfaces.offset[of]
        return -offset if interfaces.move_with_camera else (normal * self.views.center).sum(dim=-1) - offset

    @property
    def middle(self) -> Float[Tensor, "3"]:
        """Of the centres of registered views; zero where there are none."""
        center = self.views.center[self.views.registered]
        return center.sum(dim=0) / max(len(center), 1)

    @property
    def down_in_cam(self) -> Float[Tensor, "m 3"]:
        """Which way is down in each view, unit vectors."""
        return -rotate(self.views.rotation, self.assessment.up.to(self.views.rotation))

    def support(self) -> Int[Tensor, " m"]:
        """How many accepted observations each view has."""
        return torch.bincount(self.observations.view[self.accepted], minlength=len(self.views))

    def seen_by(self, wanted: Bool[Tensor, " m"]) -> Bool[Tensor, " n"]:
        """Points that any of the `wanted` views observes, accepted or not."""
        seen = self.observations.point[wanted[self.observations.view]]
        return torch.zeros_like(self.placed).index_fill(0, seen, True)

    def supported_by(self, wanted: Bool[Tensor, " m"]) -> Bool[Tensor, " n"]:
        """Points of which an observation in any of the `wanted` views is accepted."""
        seen = self.observations
        return torch.zeros_like(self.placed).index_fill(0, seen.point[self.accepted & wanted[seen.view]], True)

    def sightings(self) -> Int[Tensor, " n"]:
        """How many registered views observe each point, accepted or not."""
        seen = self.observations
        return torch.bincount(seen.point[self.views.registered[seen.view]], minlength=len(self.points))

    def above_water(self) -> Bool[Tensor, " n"]:
        """Points above the surface that the first view with an observation of them looks through, or the first."""
        seen, interfaces = self.observations, self.interfaces
        if len(interfaces) == 1 or not len(seen):
            return interfaces.heights(self.points, 0) > 0.0
        first = torch.searchsorted(seen.point, torch.arange(len(self.points))).clamp(max=len(seen) - 1)
        interface = self.views.interface[seen.view[first]]
        return interfaces.heights(self.points, interface) > 0.0

    def outside_water(self) -> Bool[Tensor, " n"]:
        """Placed points that lie below the surface, but not under water."""
        if self.dry is None:
            return torch.zeros_like(self.placed)
        return self.placed & self.dry & ~self.above_water()

    def detached(self) -> "Scene":
        """The same without a graph."""
        return detached(self)

    def part(self, min_observations: int = 1, of: Bool[Tensor, " n"] | None = None) -> "Part":
        """Registered views, the points with so many accepted observations, and these observations. of: of these points
        alone, and the views that observe them."""
        rows = self.accepted & self.placed[self.observations.point]
        if min_observations > 1:
            count = torch.bincount(self.observations.point[rows], minlength=len(self.points))
            rows = rows & (count >= min_observations)[self.observations.point]
        if of is not None:
            rows = rows & of[self.observations.point]
        seen, wanted = self.observations[rows.nonzero()[:, 0]], self.views.registered
        if of is not None:
            wanted = torch.zeros_like(wanted).index_fill(0, seen.view, True)
        view = wanted.nonzero()[:, 0]
        ids, point = torch.unique_consecutive(seen.point, return_inverse=True)
        slot = wanted.long().cumsum(dim=0) - 1
        scene = replace(
            self,
            capture=self.capture and self.capture.of_views(view.tolist()),
            views=self.views[view],
            points=self.points[ids],
            colors=self.colors[ids],
            placed=self.placed[ids],
            dry=self._dry_of(ids),
            assessment=self.assessment.of_points(ids),
            observations=replace(seen, view=slot[seen.view], point=point),
            accepted=torch.ones_like(seen.point, dtype=torch.bool),
        )
        return Part(scene, view, ids)

    def with_part(self, part: "Part", changed: "Scene") -> "Scene":
        """With the poses and points of a part, and with all cameras and interfaces, as they are in `changed`."""
        return replace(
            self,
            cameras=changed.cameras,
            interfaces=changed.interfaces,
            views=self.views.at(changed.views.rotation, changed.views.center, part.view),
            points=self.points.index_copy(0, part.point, changed.points),
        )

    def with_points(
        self, points: Float[Tensor, "n 3"], colors: UInt8[Tensor, "n 3"], observations: Observations | None = None
    ) -> "Scene":
        """With these points, all of them placed, and these observations of them, all of them accepted; none by
        default."""
        seen = Observations.none() if observations is None else observations
        return replace(
            self,
            points=points,
            colors=colors,
            placed=torch.ones(len(points), dtype=torch.bool, device=points.device),
            dry=None,
            assessment=replace(self.assessment, point_covariance=None, relative_covariance=None),
            observations=seen,
            accepted=torch.ones_like(seen.point, dtype=torch.bool),
        )

    def of_views(self, wanted: Bool[Tensor, " m"]) -> "Scene":
        """Only those views and their observations; all points and cameras stay."""
        observed, rows = wanted[self.observations.view], wanted.nonzero()[:, 0]
        seen = self.observations[observed]
        return replace(
            self,
            capture=self.capture and self.capture.of_views(rows.tolist()),
            views=self.views[rows],
            observations=replace(seen, view=(wanted.cumsum(dim=0) - 1)[seen.view]),
            accepted=self.accepted[observed],
        )

    def trimmed(self) -> "Scene":
        """Only accepted observations and points that have some; all views stay."""
        seen = self.observations[self.accepted]
        ids, point = torch.unique_consecutive(seen.point, return_inverse=True)
        return replace(
            self,
            points=self.points[ids],
            colors=self.colors[ids],
            placed=self.placed[ids],
            dry=self._dry_of(ids),
            assessment=self.assessment.of_points(ids),
            observations=replace(seen, point=point),
            accepted=self.accepted[self.accepted],
        )

    def cleaned(self) -> "Scene":
        """Without repeated observations of a point in one view, of which the first stays, and then without the points
        that have fewer than two."""
        seen, n = self.observations, len(self.points)
        order = (seen.point * len(self.views) + seen.view).argsort(stable=True)
        repeats = (seen.point[order].diff() == 0) & (seen.view[order].diff() == 0)
        first = torch.ones_like(self.accepted)
        first[order[1:][repeats]] = False
        several = torch.bincount(seen.point[first], minlength=n) >= 2
        return replace(self, accepted=first & several[seen.point]).trimmed()

    def _dry_of(self, points: Int[Tensor, " p"]) -> Bool[Tensor, " p"] | None:
        return None if self.dry is None else self.dry[points]


class Part(NamedTuple):
    """Those views and points of a scene that take part in something, renumbered: view and point say what they were."""

    scene: Scene
    view: Int[Tensor, " k"]
    point: Int[Tensor, " p"]


def _table(intrinsics: Intrinsics | Sequence[Intrinsics] | Cameras) -> Cameras:
    if isinstance(intrinsics, Cameras):
        return intrinsics
    return Cameras.of((intrinsics,) if isinstance(intrinsics, Intrinsics) else intrinsics)


def reprojection_errors(
    cameras: RefractiveCamera, points: Float[Tensor, "*#batch 3"], pixels: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch"]:
    """Distances in the image between projected points and pixels; inf where a point cannot be seen."""
    projected, valid = cameras.project(points)
    return torch.where(valid, (projected - pixels).norm(dim=-1), torch.inf)


def mean_deviation(covariance: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Standard deviation of a coordinate: the root of the mean variance along an axis."""
    return covariance.diagonal(dim1=-2, dim2=-1).mean(dim=-1).clamp(min=0.0).sqrt()


def largest_deviation(covariance: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Standard deviation along the axis in which it is largest; infinite where the covariance is not finite."""
    known = covariance.isfinite().all(dim=(-2, -1))
    variance = torch.linalg.eigvalsh(torch.where(known[..., None, None], covariance, 0.0))[..., -1]
    return torch.where(known, variance.clamp(min=0.0).sqrt(), torch.inf)


def require_index(index: Shaped[Tensor, " k"], name: str, count: int) -> None:
    """Refuse what does not count from 0 to `count` - 1."""
    if index.dtype != torch.long:
        raise SceneError(f"{name} has dtype {index.dtype}, but must be torch.long")
    if len(index) and not 0 <= int(index.min()) <= int(index.max()) < count:
        raise SceneError(f"{name} runs from {int(index.min())} to {int(index.max())}, but must lie in 0 to {count - 1}")
