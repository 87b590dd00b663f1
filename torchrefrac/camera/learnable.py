"""A camera as a module of a learning project: its lens, what it looks through, and where it stands, can be learnt."""

from collections.abc import Collection
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchrefrac.camera.intrinsics import Intrinsics
from torchrefrac.camera.refractive import Points, RefractiveCamera
from torchrefrac.checks import at_least_single
from torchrefrac.geometry import rotate, so3_exp
from torchrefrac.refraction import FlatInterface

LEARNABLE = (
    "index_ratio", "layer_index", "layer_thickness", "plane_tilt", "plane_height",
    "focal", "principal_point", "distortion", "rotation", "center",
)  # fmt: skip


class LearnableCamera(nn.Module):
    """A `RefractiveCamera` whose water, glass, lens and poses are parameters.

    Parameters are changes from the camera given, all zero at the start, so that `state_dict` holds what is learned:
    `index_ratio`, log of the factor of index ratio - 1; `layer_index`, the same of the index of each layer between the
    first medium and the last, and `layer_thickness`, log of the factor of its thickness; `plane_tilt`, radians, and
    `plane_height`, the unit of the scene, as in `Plane.moved`; `focal`, log of the factor of both focal lengths,
    `principal_point`, pixels, and `distortion`, in its own coefficients, of each lens; `rotation`, left perturbation in
    radians, and `center`, the unit of the scene, of each camera. Those named in `learn` are trained. Indices never fall
    below 1, thicknesses not below 0. Learn from points that lie inside the images: outside them distortion may lead
    astray.

    Give parameters learning rates of their own where their units differ. Raises ValueError for a name that is not
    known, and for what is not there to be learnt: layers where two media touch, coefficients of distortion where the
    lens has none, an index of 1.
    """

    index_ratio: Float[Tensor, ""]
    layer_index: Float[Tensor, " inner"]
    layer_thickness: Float[Tensor, " inner"]
    plane_tilt: Float[Tensor, " 2"]
    plane_height: Float[Tensor, ""]
    focal: Float[Tensor, "*lens"]
    principal_point: Float[Tensor, "*lens 2"]
    distortion: Float[Tensor, "*lens k"]
    rotation: Float[Tensor, "*batch 3"]
    center: Float[Tensor, "*batch 3"]

    def __init__(self, camera: RefractiveCamera, learn: Collection[str] = ("index_ratio", "plane_height")) -> None:
        super().__init__()
        learn = (learn,) if isinstance(learn, str) else learn
        unknown = sorted(set(learn) - set(LEARNABLE))
        if unknown:
            raise ValueError(f"learn names {', '.join(unknown)}, but must be some of {', '.join(LEARNABLE)}")
        _require_there(camera, learn)
        inner, lens = len(camera.interface.thickness), camera.intrinsics
        sizes = {
            "layer_index": (inner,),
            "layer_thickness": (inner,),
            "plane_tilt": (2,),
            "focal": lens.shape,
            "principal_point": (*lens.shape, 2),
            "distortion": (*lens.shape, lens.distortion.shape[-1]),
            "rotation": (*camera.shape, 3),
            "center": (*camera.shape, 3),
        }
        for name in LEARNABLE:
            start = camera.center_in_world.new_zeros(sizes.get(name, ()))
            self.register_parameter(name, nn.Parameter(start, requires_grad=name in learn))
        self._start = camera

    @property
    def camera(self) -> RefractiveCamera:
        """The camera as learnt so far, differentiable in the parameters."""
        shift, turn, tilt, height = (
            at_least_single(p) for p in (self.center, self.rotation, self.plane_tilt, self.plane_height)
        )
        start = self._start.to(dtype=shift.dtype, device=shift.device)
        plane = start.interface.plane.moved(tilt, height)
        columns = rotate(so3_exp(turn)[..., None, :, :], start.cam_from_world_rotation.mT)
        interface = replace(self._media(start.interface, shift), plane=plane, check=False)
        return RefractiveCamera(
            self._lens(start.intrinsics), columns.mT, start.center_in_world + shift, interface, check=False
        )

    def forward(self, points_in_world: Points) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """`RefractiveCamera.project`."""
        return self.camera.project(points_in_world)

    def _lens(self, start: Intrinsics) -> Intrinsics:
        growth, shift, bend = (at_least_single(p) for p in (self.focal, self.principal_point, self.distortion))
        return replace(
            start,
            focal=start.focal * growth.exp()[..., None],
            principal_point=start.principal_point + shift,
            distortion=start.distortion + bend,
            check=False,
        )

    def _media(self, start: FlatInterface, like: Float[Tensor, "..."]) -> FlatInterface:
        growth, of_layers, of_thickness = (
            at_least_single(p) for p in (self.index_ratio, self.layer_index, self.layer_thickness)
        )
        ratio = 1.0 + (start.index_like(like) - 1.0) * growth.exp()
        if start.layers is None:
            return start.with_index_ratio(ratio)
        first, *inner, _ = start.indices
        layers = (first, *(1.0 + (n - 1.0) * of_layers[i].exp() for i, n in enumerate(inner)), ratio * first)
        thickness = tuple(d * of_thickness[i].exp() for i, d in enumerate(start.thickness))
        return replace(start, index_ratio=ratio, layers=layers, thickness=thickness, check=False)


def _require_there(camera: RefractiveCamera, learn: Collection[str]) -> None:
    """Raise ValueError for what is not there to be learnt."""
    interface, center = camera.interface, camera.center_in_world
    if not interface.thickness and {"layer_index", "layer_thickness"} & set(learn):
        raise ValueError("interface has no layer between its first medium and its last, but must have one to learn it")
    if "distortion" in learn and not camera.intrinsics.distortion.shape[-1]:
        raise ValueError("intrinsics have no coefficients of distortion, but must have some to learn them: give zeros")
    indices = {"index_ratio": (interface.index_like(center),), "layer_index": interface.indices[1:-1]}
    for name in indices.keys() & set(learn):
        if not all(bool((torch.as_tensor(index) > 1.0).all()) for index in indices[name]):
            raise ValueError(f"{name} is 1 or less, but must be above 1 to be learnt: start from a guess")
