"""A camera as a module of a learning project: what it looks through, and where it stands, can be learnt."""

from collections.abc import Collection
from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchrefrac.camera.refractive import Points, RefractiveCamera
from torchrefrac.checks import at_least_single
from torchrefrac.geometry import rotate, so3_exp

LEARNABLE = ("index_ratio", "plane_tilt", "plane_height", "rotation", "center")


class LearnableCamera(nn.Module):
    """A `RefractiveCamera` whose index ratio, plane and poses are parameters; the intrinsics stay as they are.

    Parameters are changes from the camera given, all zero at the start: `index_ratio`, log of the factor of index ratio
    - 1; `plane_tilt`, radians, and `plane_height`, the unit of the scene, as in `Plane.moved`; `rotation`, left
    perturbation in radians, and `center` for each camera. Those named in `learn` are trained. The index ratio never
    falls below 1. Learn from points that lie inside the images: outside them distortion may lead astray.

    Height and centre have the unit of the scene, the others none: give them learning rates of their own where that
    unit is far from the size of the scene. Raises ValueError for a name that is not known, and for an index ratio to
    learn that is 1 or belongs to more than two media.
    """

    index_ratio: Float[Tensor, ""]
    plane_tilt: Float[Tensor, " 2"]
    plane_height: Float[Tensor, ""]
    rotation: Float[Tensor, "*batch 3"]
    center: Float[Tensor, "*batch 3"]

    def __init__(self, camera: RefractiveCamera, learn: Collection[str] = ("index_ratio", "plane_height")) -> None:
        super().__init__()
        learn = (learn,) if isinstance(learn, str) else learn
        unknown = sorted(set(learn) - set(LEARNABLE))
        if unknown:
            raise ValueError(f"learn names {', '.join(unknown)}, but must be some of {', '.join(LEARNABLE)}")
        interface = camera.interface
        if "index_ratio" in learn and interface.layers is not None:
            raise ValueError("interface has layers, but must be of two media for its index ratio to be learnt")
        center = camera.center_in_world
        start = interface.index_like(center)
        if "index_ratio" in learn and not bool((start > 1.0).all()):
            raise ValueError("index_ratio is 1, but must be above 1 to be learnt: start from a guess")
        each = (*camera.shape, 3)
        for name, size in zip(LEARNABLE, ((), (2,), (), each, each), strict=True):
            self.register_parameter(name, nn.Parameter(center.new_zeros(size), requires_grad=name in learn))
        self._start = camera

    @property
    def camera(self) -> RefractiveCamera:
        """The camera as learnt so far, differentiable in the parameters."""
        shift, turn, tilt, height, growth = (
            at_least_single(p)
            for p in (self.center, self.rotation, self.plane_tilt, self.plane_height, self.index_ratio)
        )
        start = self._start.to(dtype=shift.dtype, device=shift.device)
        interface = replace(start.interface, plane=start.interface.plane.moved(tilt, height), check=False)
        if interface.layers is None:
            interface = interface.with_index_ratio(1.0 + (interface.index_like(shift) - 1.0) * growth.exp())
        columns = rotate(so3_exp(turn)[..., None, :, :], start.cam_from_world_rotation.mT)
        return RefractiveCamera(start.intrinsics, columns.mT, start.center_in_world + shift, interface, check=False)

    def forward(self, points_in_world: Points) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """`RefractiveCamera.project`."""
        return self.camera.project(points_in_world)
