"""Where every unknown of a bundle adjustment is found, and how a step changes the scene.

Points are eliminated by the solver, but for those that a measurement of their own concerns (a ground control point, an
end of a scale bar, a point on the waterline): these are reduced unknowns like the poses.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.bundle.rows import INTRINSICS, MEDIA, WATER, coefficients_of, water_unknowns
from torchrefrac.geometry import so3_exp
from torchrefrac.optim import REDUCED_SIZE, Family, Step
from torchrefrac.scene import Cameras, Interfaces, Scene

FISHEYE_COEFFICIENTS = 4
STATED = ("focal", "principal_point", "distortion")
"""Those of which cameras state errors."""


@dataclass(frozen=True)
class Layout:
    """camera and interface: those of each view. intrinsics and water: what varies of them (keys of `rows.INTRINSICS`
    and of WATER); fixed_intrinsics: by name of the intrinsics, which numbers of which cameras do not, where some
    do. fixed: unknowns of the poses (rotation, centre) that do not vary; fix_points: none of the points do. reduced:
    which points are reduced unknowns. refractive: whether the index ratio is above 1, so that images depend on the
    plane. moves_with_camera: whether the interfaces are ports."""

    camera: Int[Tensor, " m"]
    interface: Int[Tensor, " m"]
    num_cameras: int
    num_interfaces: int
    num_points: int
    intrinsics: tuple[str, ...] = ()
    water: tuple[str, ...] = ()
    fixed_intrinsics: Mapping[str, Bool[Tensor, "g width"]] = field(default_factory=dict)
    fixed: Bool[Tensor, "m 6"] | None = None
    fix_points: bool = False
    reduced: Bool[Tensor, " n"] | None = None
    refractive: bool = True
    moves_with_camera: bool = False

    @classmethod
    def create(
        cls,
        scene: Scene,
        refine: tuple[str, ...] = (),
        fixed: Bool[Tensor, "m 6"] | None = None,
        fix_points: bool = False,
        reduced: Bool[Tensor, " n"] | None = None,
    ) -> "Layout":
        """For `scene`, with what `refine` names varying besides poses and points, and of each camera what is stated to
        be uncertain. Raises ValueError for other names."""
        known = (*INTRINSICS, *water_unknowns(scene.interfaces))
        unknown = [name for name in refine if name not in known]
        if unknown:
            raise ValueError(f"refine has {unknown[0]!r}, but knows {', '.join(known)}")
        if "radial" in refine and "distortion" in refine:
            raise ValueError("refine has radial and distortion, but the first is part of the second")
        intrinsics, fixed_intrinsics = _varying(scene.cameras, refine)
        uncertain = scene.interfaces.sigmas if scene.interfaces.refract() else {}
        return cls(
            camera=scene.views.camera,
            interface=scene.views.interface,
            num_cameras=len(scene.cameras),
            num_interfaces=len(scene.interfaces),
            num_points=len(scene.points),
            intrinsics=intrinsics,
            water=tuple(name for name in water_unknowns(scene.interfaces) if name in refine or name in uncertain),
            fixed_intrinsics=fixed_intrinsics,
            fixed=fixed if fixed is not None and bool(fixed.any()) else None,
            fix_points=fix_points,
            reduced=reduced if reduced is not None and bool(reduced.any()) else None,
            refractive=scene.interfaces.refract(),
            moves_with_camera=scene.interfaces.move_with_camera,
        )

    @property
    def num_views(self) -> int:
        return len(self.camera)

    @property
    def cameras(self) -> Int[Tensor, " g"]:
        """All their ids."""
        return torch.arange(self.num_cameras, device=self.camera.device)

    @property
    def interfaces(self) -> Int[Tensor, " e"]:
        """All their ids."""
        return torch.arange(self.num_interfaces, device=self.camera.device)

    @cached_property
    def families(self) -> tuple[Family, ...]:
        """In the order of the rows: the intrinsics, the media, the plane."""
        families = []
        if self.intrinsics:
            families.append(Family(self._intrinsics_size, self.camera, self.num_cameras))
        if self._media:
            families.append(Family(len(self._media), torch.zeros_like(self.interface), 1))
        if self._plane_size:
            families.append(Family(self._plane_size, self.interface, self.num_interfaces))
        return tuple(families)

    @property
    def size(self) -> int:
        """How many reduced unknowns there are; also the column that stands for whatever is fixed."""
        return self.first_point + 3 * len(self.reduced_points)

    @cached_property
    def reduced_points(self) -> Int[Tensor, " r"]:
        """Ids of the points that are reduced unknowns."""
        return self.camera[:0] if self.reduced is None else self.reduced.nonzero()[:, 0]

    @cached_property
    def eliminated_points(self) -> Int[Tensor, " p"]:
        """Ids of the points that are not."""
        every = torch.arange(self.num_points, device=self.camera.device)
        return every if self.reduced is None else (~self.reduced).nonzero()[:, 0]

    @property
    def first_point(self) -> int:
        """The column where reduced points begin."""
        return REDUCED_SIZE * self.num_views + sum(family.size * family.count for family in self.families)

    def pose_columns(self, view: Int[Tensor, " k"]) -> Int[Tensor, "k 6"]:
        """Of rotation and centre of views."""
        columns = REDUCED_SIZE * view[:, None] + torch.arange(REDUCED_SIZE, device=view.device)
        return columns if self.fixed is None else torch.where(self.fixed[view], self.size, columns)

    def intrinsics_columns(self, name: str, camera: Int[Tensor, " k"]) -> Int[Tensor, "k width"]:
        """Of one kind of unknown of cameras."""
        before = sum(INTRINSICS[other].width for other in self.intrinsics[: self.intrinsics.index(name)])
        first = REDUCED_SIZE * self.num_views + self._intrinsics_size * camera + before
        columns = first[:, None] + torch.arange(INTRINSICS[name].width, device=camera.device)
        fixed = self.fixed_intrinsics.get(name)
        return columns if fixed is None else torch.where(fixed[camera], self.size, columns)

    @cached_property
    def constant(self) -> Bool[Tensor, "m width"] | None:
        """Which of the reduced unknowns that the observations of each view depend on do not vary; None: all do."""
        if self.fixed is None and not self.fixed_intrinsics:
            return None
        nothing = torch.zeros(self.num_views, 0, dtype=torch.bool, device=self.camera.device)
        poses = self.fixed if self.fixed is not None else nothing.new_zeros(self.num_views, REDUCED_SIZE)
        widths = {name: INTRINSICS[name].width for name in self.intrinsics}
        none = {name: nothing.new_zeros(self.num_cameras, width) for name, width in widths.items()}
        own = [self.fixed_intrinsics.get(name, none[name]) for name in self.intrinsics]
        water = nothing.new_zeros(self.num_views, sum(WATER[name].width for name in self.water))
        return torch.cat((poses, *(fixed[self.camera] for fixed in own), water), dim=1)

    def medium_column(self, name: str) -> int:
        """Of one of MEDIA."""
        return self._first_water + self._media.index(name) if name in self._media else self.size

    def plane_columns(self, interface: Int[Tensor, " k"]) -> Int[Tensor, "k 3"]:
        """Of the two tilts and the height of interfaces."""
        columns = torch.full((len(interface), 3), self.size, device=interface.device)
        start = self._first_water + len(self._media) + self._plane_size * interface[:, None]
        tilts = 2 if "plane_tilt" in self.water else 0
        columns[:, :tilts] = start + torch.arange(tilts, device=interface.device)
        if "plane_height" in self.water:
            columns[:, 2:] = start + tilts
        return columns

    def point_columns(self, point: Int[Tensor, " k"]) -> Int[Tensor, "k 3"]:
        """Of points that are reduced unknowns."""
        assert self.reduced is not None
        slot = torch.cumsum(self.reduced.long(), dim=0) - 1
        return self.first_point + 3 * slot[point][:, None] + torch.arange(3, device=point.device)

    def retract(self, scene: Scene, step: Step) -> Scene:
        """The scene after a step."""
        m, points = self.num_views, scene.points
        poses = step.reduced[: REDUCED_SIZE * m].view(m, REDUCED_SIZE)
        if self.reduced is not None:
            points = points.index_add(0, self.reduced_points, step.reduced[self.first_point :].view(-1, 3))
            points = points.index_add(0, self.eliminated_points, step.eliminated)
        elif not self.fix_points:
            points = points + step.eliminated
        views = scene.views.at(so3_exp(poses[:, :3]) @ scene.views.rotation, scene.views.center + poses[:, 3:])
        cameras = self._moved_cameras(scene.cameras, step.reduced) if self.intrinsics else scene.cameras
        interfaces = self._moved_interfaces(scene.interfaces, step.reduced) if self.water else scene.interfaces
        return replace(scene, cameras=cameras, views=views, interfaces=interfaces, points=points)

    def _moved_cameras(self, cameras: Cameras, reduced: Float[Tensor, " size"]) -> Cameras:
        reduced = torch.nn.functional.pad(reduced, (0, 1))
        change = {name: reduced[self.intrinsics_columns(name, self.cameras)] for name in self.intrinsics}
        focal, middle, distortion = cameras.focal, cameras.principal_point, cameras.distortion
        if "focal" in change:
            focal = focal * change["focal"].exp()
        if "principal_point" in change:
            middle = middle + change["principal_point"]
        for name in ("radial", "distortion"):
            if name in change:
                width = change[name].shape[-1]
                distortion = distortion + torch.nn.functional.pad(change[name], (0, distortion.shape[-1] - width))
        return cameras.moved(focal, middle, distortion, coefficients_of(self.intrinsics))

    def _moved_interfaces(self, interfaces: Interfaces, reduced: Float[Tensor, " size"]) -> Interfaces:
        index_ratio, normal, offset = interfaces.index_ratio, interfaces.normal, interfaces.offset
        layers, thickness = interfaces.layers, interfaces.thickness
        if "index_ratio" in self.water:
            index_ratio = index_ratio + reduced[self.medium_column("index_ratio")]
        if "layer_index" in self.water:
            layers = layers + reduced[self.medium_column("layer_index")]
        if "layer_thickness" in self.water:
            thickness = torch.where(thickness > 0.0, thickness + reduced[self.medium_column("layer_thickness")], 0.0)
        if self._plane_size:
            change = torch.nn.functional.pad(reduced, (0, 1))[self.plane_columns(self.interfaces)]
            plane = interfaces.planes.moved(change[:, :2], change[:, 2])
            normal, offset = plane.normal_like(normal), plane.offset
        return interfaces.moved(
            normal=normal,
            offset=torch.as_tensor(offset),
            index_ratio=index_ratio,
            layers=layers,
            thickness=thickness,
        )

    @property
    def _first_water(self) -> int:
        return REDUCED_SIZE * self.num_views + self._intrinsics_size * self.num_cameras

    @property
    def _intrinsics_size(self) -> int:
        return sum(INTRINSICS[name].width for name in self.intrinsics)

    @property
    def _media(self) -> tuple[str, ...]:
        return tuple(name for name in self.water if name in MEDIA)

    @property
    def _plane_size(self) -> int:
        return sum(WATER[name].width for name in self.water if name not in MEDIA)


def _varying(cameras: Cameras, refine: tuple[str, ...]) -> tuple[tuple[str, ...], dict[str, Bool[Tensor, "g width"]]]:
    """What varies of the intrinsics of any camera, and which numbers of which cameras do not: those that are neither to
    be refined nor stated to be uncertain, and those that a model has not."""
    uncertain = {name: cameras.sigma_of(name) > 0.0 for name in STATED}
    names = {*refine, *(name for name, of in uncertain.items() if bool(of.any()))}
    if "distortion" in names:
        names.discard("radial")  # it is part of it
    varying, fixed_intrinsics = tuple(name for name in INTRINSICS if name in names), {}
    for name in varying:
        which = torch.ones_like(cameras.fisheye) if name in refine else uncertain[name]
        of = which[:, None].repeat(1, INTRINSICS[name].width)
        if name == "distortion":
            of[:, : INTRINSICS["radial"].width] |= "radial" in refine
            of[cameras.fisheye, FISHEYE_COEFFICIENTS:] = False
        if not bool(of.all()):
            fixed_intrinsics[name] = ~of
    return varying, fixed_intrinsics
