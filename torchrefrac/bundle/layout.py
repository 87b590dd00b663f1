"""Where every unknown of a bundle adjustment is found, and how a step changes the state.

Points are eliminated by the solver, but for those that a measurement of their own concerns (a mark with known
coordinates, an end of a scale bar, a point on the waterline): these are kept, as unknowns like the cameras.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchrefrac.bundle.rows import LENS, WATER_WIDTH
from torchrefrac.bundle.state import BundleState, Links
from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.optim import Family, Step

POSE_SIZE = 6


@dataclass(frozen=True)
class Layout:
    """lens and water: what varies of them (keys of `rows.LENS` and of WATER_WIDTH). held (m, 6): unknowns of the poses
    (rotation, centre) that do not vary; hold_points: none of the points do. kept (n): which points are kept.
    refractive: whether the index ratio is above 1, so that images tell of the plane."""

    links: Links
    num_lenses: int
    num_planes: int
    num_points: int
    lens: tuple[str, ...] = ()
    water: tuple[str, ...] = ()
    held: Tensor | None = None
    hold_points: bool = False
    kept: Tensor | None = None
    refractive: bool = True

    @classmethod
    def create(
        cls,
        state: BundleState,
        links: Links,
        refine: tuple[str, ...] = (),
        held: Tensor | None = None,
        hold_points: bool = False,
        kept: Tensor | None = None,
    ) -> "Layout":
        """For `state`, with what `refine` names varying besides poses and points. Raises ValueError for other names."""
        known = (*LENS, *WATER_WIDTH)
        unknown = [name for name in refine if name not in known]
        if unknown:
            raise ValueError(f"refine has {unknown[0]!r}, but knows {', '.join(known)}")
        if "radial" in refine and "distortion" in refine:
            raise ValueError("refine has radial and distortion, but the first is part of the second")
        return cls(
            links=links,
            num_lenses=state.lens.shape[0] if state.lens.shape else 1,
            num_planes=len(state.planes[0]),
            num_points=len(state.points),
            lens=tuple(name for name in LENS if name in refine),
            water=tuple(name for name in WATER_WIDTH if name in refine),
            held=held if held is not None and bool(held.any()) else None,
            hold_points=hold_points,
            kept=kept if kept is not None and bool(kept.any()) else None,
            refractive=float(state.index_ratio) > 1.0,
        )

    @property
    def num_cameras(self) -> int:
        return len(self.links.lens)

    @cached_property
    def families(self) -> tuple[Family, ...]:
        """In the order of the rows: the lens, the index ratio, the plane."""
        families = []
        if self.lens:
            families.append(Family(self._lens_size, self.links.lens, self.num_lenses))
        if "index_ratio" in self.water:
            families.append(Family(1, torch.zeros_like(self.links.plane), 1))
        if self._plane_size:
            families.append(Family(self._plane_size, self.links.plane, self.num_planes))
        return tuple(families)

    @property
    def size(self) -> int:
        """Of the reduced system; also the column that stands for whatever is held."""
        return self.first_kept + 3 * self.num_kept

    @property
    def num_kept(self) -> int:
        return len(self.kept_points)

    @cached_property
    def kept_points(self) -> Tensor:
        """Ids of the points that are kept."""
        return self.links.lens[:0] if self.kept is None else self.kept.nonzero()[:, 0]

    @cached_property
    def free_points(self) -> Tensor:
        """Ids of the points that are not."""
        every = torch.arange(self.num_points, device=self.links.lens.device)
        return every if self.kept is None else (~self.kept).nonzero()[:, 0]

    @property
    def first_kept(self) -> int:
        return POSE_SIZE * self.num_cameras + sum(family.size * family.count for family in self.families)

    def pose_columns(self, image: Tensor) -> Tensor:
        """Of rotation and centre of images (k): (k, 6)."""
        columns = POSE_SIZE * image[:, None] + torch.arange(POSE_SIZE, device=image.device)
        return columns if self.held is None else torch.where(self.held[image], self.size, columns)

    def lens_columns(self, name: str, lens: Tensor) -> Tensor:
        """Of one kind of unknown of lenses (k): (k, its width)."""
        before = sum(LENS[other].width for other in self.lens[: self.lens.index(name)])
        first = POSE_SIZE * self.num_cameras + self._lens_size * lens + before
        return first[:, None] + torch.arange(LENS[name].width, device=lens.device)

    def index_column(self) -> int:
        """Of the index ratio."""
        if "index_ratio" not in self.water:
            return self.size
        return POSE_SIZE * self.num_cameras + self._lens_size * self.num_lenses

    def plane_columns(self, plane: Tensor) -> Tensor:
        """Of the two tilts and the height of planes (k): (k, 3)."""
        first = POSE_SIZE * self.num_cameras + self._lens_size * self.num_lenses + ("index_ratio" in self.water)
        columns = torch.full((len(plane), 3), self.size, device=plane.device)
        start = first + self._plane_size * plane[:, None]
        tilts = 2 if "plane_tilt" in self.water else 0
        columns[:, :tilts] = start + torch.arange(tilts, device=plane.device)
        if "plane_height" in self.water:
            columns[:, 2:] = start + tilts
        return columns

    def point_columns(self, point: Tensor) -> Tensor:
        """Of points (k) that are kept: (k, 3)."""
        assert self.kept is not None
        slot = torch.cumsum(self.kept.long(), dim=0) - 1
        return self.first_kept + 3 * slot[point][:, None] + torch.arange(3, device=point.device)

    def retract(self, state: BundleState, step: Step) -> BundleState:
        """The state after a step; step.point (n - kept, 3) moves the points that are not kept."""
        m = self.num_cameras
        blocks = step.kept[: POSE_SIZE * m].view(m, POSE_SIZE)
        points = state.points
        if self.kept is not None:
            points = points.index_add(0, self.kept_points, step.kept[self.first_kept :].view(-1, 3))
            points = points.index_add(0, self.free_points, step.point)
        elif not self.hold_points:
            points = points + step.point
        moved = replace(
            state,
            rotation=so3_exp(blocks[:, :3]) @ state.rotation,
            center=state.center + blocks[:, 3:],
            points=points,
        )
        if self.lens:
            moved = replace(moved, lens=self._moved_lens(state, step.kept))
        return self._moved_water(moved, step.kept) if self.water else moved

    def _moved_lens(self, state: BundleState, kept: Tensor):
        lens, shape = state.lens, state.lens.shape
        every = torch.arange(self.num_lenses, device=kept.device)
        change = {name: kept[self.lens_columns(name, every)].view(*shape, -1) for name in self.lens}
        focal, middle, distortion = lens.focal, lens.principal_point, lens.distortion
        if "focal" in change:
            focal = focal * change["focal"].exp()
        if "principal_point" in change:
            middle = middle + change["principal_point"]
        for name in ("radial", "distortion"):
            if name in change:
                distortion = distortion + torch.nn.functional.pad(change[name], (0, 5 - change[name].shape[-1]))
        return replace(lens, focal=focal, principal_point=middle, distortion=distortion, check=False)

    def _moved_water(self, state: BundleState, kept: Tensor) -> BundleState:
        index_ratio = state.index_ratio
        if "index_ratio" in self.water:
            index_ratio = index_ratio + kept[self.index_column()]
        normal, offset = state.planes
        if self._plane_size:
            padded = torch.nn.functional.pad(kept, (0, 1))
            change = padded[self.plane_columns(torch.arange(self.num_planes, device=kept.device))]
            plane = Plane(normal, offset, check=False).moved(change[:, :2], change[:, 2])
            normal, offset = plane.normal_like(normal), plane.offset
        return replace(state, index_ratio=index_ratio, normal=normal, offset=offset)

    @property
    def _lens_size(self) -> int:
        return sum(LENS[name].width for name in self.lens)

    @property
    def _plane_size(self) -> int:
        return sum(WATER_WIDTH[name] for name in self.water if name != "index_ratio")
