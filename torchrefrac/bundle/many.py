"""The adjustment of many small problems at once, differentiable: a layer that a network can be trained through.

Each problem has as many views m and points n as the others, and knows nothing of them: it has its own damping, accepts
and rejects its own steps. Every view may see every point; a weight of zero says that it does not. With 9 unknowns to an
observation, of a pose and a point, the normal equations of a problem are

    | U_i   W_ij |        U_i (6, 6) of view i,  V_j (3, 3) of point j,  W_ij (6, 3),
    | W_ij'  V_j |        S = U - sum_j W_j V_j^-1 W_j'

which are solved through the (6m, 6m) matrix S (Triggs et al., "Bundle adjustment - a modern synthesis", 2000, section
6.1). The derivative of a minimum follows from the implicit function theorem (see `adjust_differentiably`), with
the exact second derivatives of the cost in the place of those of Gauss and Newton: nine products with the gradients of
all observations say what these are, observation by observation.

It fails where a problem has another minimum near its start, and where views or points are not determined by what they
see: such a problem does not converge, and directions in which nothing changes the cost, as those of the gauge, have a
derivative of zero.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.bundle.rows import IMPOSSIBLE_PX
from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry import skew, so3_exp
from torchrefrac.numerics import detached
from torchrefrac.optim import LossName, minimize_each, robust

MAX_DAMPING = 1e8
NULL = 1e-11
"""Of the largest eigenvalue of S: a direction that bends the cost by less is one of the null space."""


@dataclass(frozen=True, eq=False)
class BundleBatch:
    """B problems of m views that see n points, and what was measured.

    cameras: a batch (B, m), where their poses are guessed; points: world points, guessed; pixels; weights: of
    observations, zero where a view does not see a point; down_in_cam: measured direction of gravity in each camera,
    unit vectors, by default unknown, and down_sigma, radians, its standard deviation. Raises ValueError for shapes that
    do not fit.
    """

    cameras: RefractiveCamera
    points: Float[Tensor, "b n 3"]
    pixels: Float[Tensor, "b m n 2"]
    weights: Float[Tensor, "b m n"]
    down_in_cam: Float[Tensor, "b m 3"] | None = None
    down_sigma: float = 0.01

    def __post_init__(self) -> None:
        given = problems, views, count = tuple(self.weights.shape)
        shapes = {"points": (problems, count, 3), "pixels": (problems, views, count, 2)}
        if self.down_in_cam is not None:
            shapes["down_in_cam"] = (problems, views, 3)
        for name, shape in shapes.items():
            if (found := tuple(getattr(self, name).shape)) != shape:
                raise ValueError(f"{name} has shape {found}, but must have {shape} where weights have {given}")
        if self.cameras.shape != (problems, views):
            raise ValueError(f"cameras have batch shape {tuple(self.cameras.shape)}, but must have {(problems, views)}")


class BatchReport(NamedTuple):
    """What problems were adjusted to: their cameras (b, m) and points, half the sums of their losses, square pixels,
    and whether they have converged."""

    cameras: RefractiveCamera
    points: Float[Tensor, "b n 3"]
    cost: Float[Tensor, " b"]
    converged: Bool[Tensor, " b"]


def adjust_each(
    problems: BundleBatch,
    *,
    loss: LossName = "huber",
    loss_scale: float = 1.0,
    pixel_sigma: float = 1.0,
    fixed: Bool[Tensor, "m 6"] | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-12,
) -> BatchReport:
    """Adjust the poses and points of many small problems, with gradients of the results in whatever tensors require
    them: pixels, weights, gravity, and the intrinsics and the interface of the cameras, which are not adjusted.

    Where the search starts has no gradient, and does not matter where it ends in the same minimum. Costs are in square
    pixels: gravity weighs (pixel_sigma / down_sigma)^2. fixed: of each view's rotation (3) and centre (3), in every
    problem, what stays; by default nothing does, and what no measurement determines (where a scene lies, its heading
    and its scale) stays near its start. A problem has converged when its cost would fall by no more than `tolerance` of
    itself. First derivatives only, meaningful where `converged`. In the dtype given: double precision, if results are
    to be exact.
    """
    rule = _Rule(loss, loss_scale, pixel_sigma, fixed)
    with torch.no_grad():
        given = detached(problems)
        search = _Search(given, rule)
        found = minimize_each(search, _State.of(given).packed(), max_iterations, tolerance, max_damping=MAX_DAMPING)
        state = search.state(found.states)
    forces = _Forces.of(problems, state, _Seen.of_state(problems, state, rule), rule)
    pose, point = _Solve.apply(forces.by_view, forces.by_point, _Minimum(given, state, rule))
    anchored = state.moved(-pose, -point)
    cameras = replace(
        problems.cameras, cam_from_world_rotation=anchored.rotation, center_in_world=anchored.center, check=False
    )
    return BatchReport(cameras, anchored.points, found.quadratic.cost, found.converged)


class _Rule(NamedTuple):
    """How observations are weighed, and what of each view stays."""

    loss: LossName
    scale: float
    pixel_sigma: float
    fixed: Bool[Tensor, "m 6"] | None

    def stiffness(self, problems: BundleBatch) -> float:
        """What the squared error of gravity weighs, in square pixels."""
        return (self.pixel_sigma / problems.down_sigma) ** 2

    def free(self, pose: Float[Tensor, "*b m 6"]) -> Float[Tensor, "*b m 6"]:
        """Zero where something stays."""
        return pose if self.fixed is None else torch.where(self.fixed, 0.0, pose)


class _State(NamedTuple):
    """Unknowns, by problem."""

    rotation: Float[Tensor, "b m 3 3"]
    center: Float[Tensor, "b m 3"]
    points: Float[Tensor, "b n 3"]

    @classmethod
    def of(cls, problems: BundleBatch) -> "_State":
        each = problems.weights.shape[:2]
        cameras = problems.cameras
        return cls(
            cameras.cam_from_world_rotation.expand(*each, 3, 3),
            cameras.center_in_world.expand(*each, 3),
            problems.points,
        )

    def packed(self) -> Float[Tensor, "b e"]:
        return torch.cat([part.flatten(1) for part in self], dim=1)

    def moved(self, pose: Float[Tensor, "b m 6"], point: Float[Tensor, "b n 3"]) -> "_State":
        """By left perturbations of rotations, radians, and by shifts."""
        return _State(so3_exp(pose[..., :3]) @ self.rotation, self.center + pose[..., 3:], self.points + point)


class _Seen(NamedTuple):
    """Every point in every view: derivatives of its pixel in the pose and in the point, what its error is weighed by,
    zero where it is not seen or cannot be, and half its loss."""

    by: Float[Tensor, "b m n 2 9"]
    error: Float[Tensor, "b m n 2"]
    weight: Float[Tensor, "b m n"]
    cost: Float[Tensor, "b m n"]

    @classmethod
    def of(
        cls,
        problems: BundleBatch,
        rotation: Float[Tensor, "b m #n 3 3"],
        center: Float[Tensor, "b m #n 3"],
        points: Float[Tensor, "b #m n 3"],
        rule: _Rule,
    ) -> "_Seen":
        cameras = problems.cameras[..., None]
        placed = replace(cameras, cam_from_world_rotation=rotation, center_in_world=center, check=False)
        pixels, jacobians, possible = placed.project_with_jacobians(points)
        by = torch.cat((jacobians.rotation, jacobians.center, jacobians.point), dim=-1)
        error = pixels - problems.pixels
        square = error.square().sum(dim=-1)
        rho, weight = robust(square, rule.loss, rule.scale)
        impossible, _ = robust(square.new_tensor(IMPOSSIBLE_PX**2), rule.loss, rule.scale)
        given = problems.weights
        cost = 0.5 * given * torch.where(possible, rho, impossible)
        return cls(by, error, torch.where(possible, given * weight, 0.0), cost)

    @classmethod
    def of_state(cls, problems: BundleBatch, state: _State, rule: _Rule) -> "_Seen":
        return cls.of(problems, state.rotation[:, :, None], state.center[:, :, None], state.points[:, None], rule)

    @property
    def force(self) -> Float[Tensor, "b m n 9"]:
        """Of each observation: the gradient of half its loss in the pose and in the point."""
        return (self.by * (self.weight[..., None] * self.error)[..., None]).sum(dim=-2)


class _Forces(NamedTuple):
    """Gradients of costs in all poses and points, and the costs."""

    by_view: Float[Tensor, "b m 6"]
    by_point: Float[Tensor, "b n 3"]
    cost: Float[Tensor, " b"]

    @classmethod
    def of(cls, problems: BundleBatch, state: _State, seen: _Seen, rule: _Rule) -> "_Forces":
        """Zero where something stays."""
        force, (pull, of_gravity) = seen.force, _gravity(problems, state.rotation, rule)
        by_view = force[..., :6].sum(dim=2) + torch.nn.functional.pad(pull, (0, 3))
        cost = seen.cost.sum(dim=(1, 2)) + of_gravity.sum(dim=1)
        return cls(rule.free(by_view), force[..., 6:].sum(dim=1), cost)


def _gravity(
    problems: BundleBatch, rotation: Float[Tensor, "b m 3 3"], rule: _Rule
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m"]]:
    """Gradients in the rotations of what measured gravity costs, and that cost: half the squared length of the
    difference of both unit vectors. With a = R down, a turn w changes a by w x a."""
    if problems.down_in_cam is None:
        return rotation.new_zeros(rotation.shape[:-1]), rotation.new_zeros(rotation.shape[:-2])
    stiffness, down = rule.stiffness(problems), -rotation[..., 2]
    off = down - problems.down_in_cam
    return stiffness * torch.linalg.cross(down, off, dim=-1), 0.5 * stiffness * off.square().sum(dim=-1)


class _Blocks(NamedTuple):
    """Second derivatives: of views, of points, and of pairs of them."""

    views: Float[Tensor, "b m 6 6"]
    points: Float[Tensor, "b n 3 3"]
    cross: Float[Tensor, "b m n 6 3"]

    @classmethod
    def of(
        cls, second: Float[Tensor, "b m n 9 9"], of_gravity: Float[Tensor, "b m 3 3"] | None, rule: _Rule
    ) -> "_Blocks":
        """Of each observation, and what gravity adds to those of rotations; zero for all that stays."""
        views, cross = second[..., :6, :6].sum(dim=2), second[..., :6, 6:]
        if of_gravity is not None:
            views = views + torch.nn.functional.pad(of_gravity, (0, 3, 0, 3))
        if rule.fixed is not None:
            free = (~rule.fixed).to(views)
            views = views * free[..., :, None] * free[..., None, :]
            cross = cross * free[:, None, :, None]
        return cls(views, second[..., 6:, 6:].sum(dim=1), cross)


class _System(NamedTuple):
    """Costs, gradients and second derivatives."""

    cost: Float[Tensor, " b"]
    gradient: Float[Tensor, "b d"]
    views: Float[Tensor, "b m 6 6"]
    points: Float[Tensor, "b n 3 3"]
    cross: Float[Tensor, "b m n 6 3"]

    @property
    def blocks(self) -> _Blocks:
        return _Blocks(self.views, self.points, self.cross)


class _Search(NamedTuple):
    """Problems as `minimize_each` wants them."""

    problems: BundleBatch
    rule: _Rule

    def state(self, states: Float[Tensor, "b e"]) -> _State:
        _, views, count = self.problems.weights.shape
        rotation, center, points = states.split((9 * views, 3 * views, 3 * count), dim=1)
        return _State(
            rotation.unflatten(1, (views, 3, 3)), center.unflatten(1, (views, 3)), points.unflatten(1, (count, 3))
        )

    def moved(self, states: Float[Tensor, "b e"], step: Float[Tensor, "b d"]) -> Float[Tensor, "b e"]:
        pose, point = _parted(step, self.problems)
        return self.state(states).moved(pose, point).packed()

    def linearize(self, states: Float[Tensor, "b e"]) -> _System:
        """By Gauss and Newton."""
        state, rule, problems = self.state(states), self.rule, self.problems
        seen = _Seen.of_state(problems, state, rule)
        forces = _Forces.of(problems, state, seen, rule)
        arm = skew(-state.rotation[..., 2])
        of_gravity = None if problems.down_in_cam is None else rule.stiffness(problems) * (arm.mT @ arm)
        second = (seen.by * seen.weight[..., None, None]).mT @ seen.by
        gradient = torch.cat((forces.by_view.flatten(1), forces.by_point.flatten(1)), dim=1)
        return _System(forces.cost, gradient, *_Blocks.of(second, of_gravity, rule))

    def solve(self, model: _System, damping: Float[Tensor, " b"]) -> Float[Tensor, "b d"]:
        """Of (H + damping diag H) step = -gradient; zero where that is not positive definite."""
        reduced = _Reduced.of(model.blocks, damping)
        pose, point = (part.flatten(1) for part in _parted(-model.gradient, self.problems))
        scale = reduced.matrix.diagonal(dim1=1, dim2=2).clamp(min=torch.finfo(pose.dtype).tiny).rsqrt()
        factor, info = torch.linalg.cholesky_ex(reduced.matrix * scale[:, :, None] * scale[:, None, :])
        right = scale * reduced.right(pose, point)
        found = scale * torch.cholesky_solve(right[..., None], factor)[..., 0]
        step = reduced.with_points(found, point)
        return torch.where((info == 0)[:, None] & step.isfinite(), step, 0.0)


class _Reduced(NamedTuple):
    """The system of the poses, and what leads to that of the points."""

    matrix: Float[Tensor, "b poses poses"]
    cross: Float[Tensor, "b poses n3"]
    inverse: Float[Tensor, "b n 3 3"]

    @classmethod
    def of(cls, blocks: _Blocks, damping: Float[Tensor, " b"] | None = None) -> "_Reduced":
        """Points that nothing determines stand still, and so do poses."""
        views, points = (_standing(_damped(block, damping)) for block in (blocks.views, blocks.points))
        _, m, n, _, _ = blocks.cross.shape
        cross = blocks.cross.permute(0, 1, 3, 2, 4).reshape(-1, 6 * m, 3 * n)
        inverse = torch.linalg.inv_ex(points)[0]
        matrix = -(_by_points(cross, inverse) @ cross.mT)
        matrix.unflatten(2, (m, 6)).unflatten(1, (m, 6)).diagonal(dim1=1, dim2=3).add_(views.permute(0, 2, 3, 1))
        return cls(matrix, cross, inverse)

    def right(self, pose: Float[Tensor, "b poses"], point: Float[Tensor, "b n3"]) -> Float[Tensor, "b poses"]:
        """Of the system of the poses, for a right side of all."""
        return pose - (self.cross @ self._point(point)[..., None])[..., 0]

    def with_points(self, pose: Float[Tensor, "b poses"], point: Float[Tensor, "b n3"]) -> Float[Tensor, "b d"]:
        """The solution of all, by that of the poses and the right side of the points."""
        rest = point - (self.cross.mT @ pose[..., None])[..., 0]
        return torch.cat((pose, self._point(rest)), dim=1)

    def _point(self, right: Float[Tensor, "b n3"]) -> Float[Tensor, "b n3"]:
        return (self.inverse @ right.unflatten(1, (-1, 3, 1))).flatten(1)


class _Minimum(NamedTuple):
    """Where problems have been adjusted to."""

    problems: BundleBatch
    state: _State
    rule: _Rule

    def solve(
        self, pose: Float[Tensor, "b m 6"], point: Float[Tensor, "b n 3"]
    ) -> tuple[Float[Tensor, "b m 6"], Float[Tensor, "b n 3"]]:
        """H^-1 times a vector, with the exact second derivatives H; nothing in the directions that H does not bend."""
        reduced = _Reduced.of(self.second_derivatives())
        values, vectors = torch.linalg.eigh(reduced.matrix)
        bent = values.abs() > NULL * values.abs().amax(dim=1, keepdim=True)
        inverse = torch.where(bent, values.where(bent, torch.ones_like(values)).reciprocal(), 0.0)
        right = reduced.right(self.rule.free(pose).flatten(1), point.flatten(1))
        found = (vectors @ (inverse[..., None] * (vectors.mT @ right[..., None])))[..., 0]
        solved = reduced.with_points(found, point.flatten(1))
        pose, point = _parted(solved, self.problems)
        return self.rule.free(pose), point

    @torch.enable_grad()
    def second_derivatives(self) -> _Blocks:
        """Observation by observation: row k of the second derivatives of all is the gradient of the sum of their k-th
        forces, as each has a pose and a point of its own."""
        problems, state, rule = self
        each = problems.weights
        pose = each.new_zeros(*each.shape, 6, requires_grad=True)
        point = each.new_zeros(*each.shape, 3, requires_grad=True)
        rotation = so3_exp(pose[..., :3]) @ state.rotation[:, :, None]
        seen = _Seen.of(
            problems, rotation, state.center[:, :, None] + pose[..., 3:], state.points[:, None] + point, rule
        )
        total = seen.force.flatten(0, 2).sum(dim=0)
        rows = [torch.cat(torch.autograd.grad(force, (pose, point), retain_graph=True), dim=-1) for force in total]
        second, of_gravity = torch.stack(rows, dim=-2), None
        if problems.down_in_cam is not None:
            bend = skew(problems.down_in_cam) @ skew(-state.rotation[..., 2])
            of_gravity = -0.5 * rule.stiffness(problems) * (bend + bend.mT)
        return _Blocks.of(0.5 * (second + second.mT), of_gravity, rule)


class _Solve(torch.autograd.Function):
    """x = H^-1 g of gradients g that vanish, which knows how x depends on g."""

    @staticmethod
    def forward(
        ctx: Any, by_view: Float[Tensor, "b m 6"], by_point: Float[Tensor, "b n 3"], minimum: _Minimum
    ) -> tuple[Float[Tensor, "b m 6"], Float[Tensor, "b n 3"]]:
        ctx.minimum = minimum
        return torch.zeros_like(by_view), torch.zeros_like(by_point)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - the decorator hides the names
        ctx: Any, *gradients: Float[Tensor, "b k c"]
    ) -> tuple[Float[Tensor, "b m 6"], Float[Tensor, "b n 3"], None]:
        return *ctx.minimum.solve(*gradients), None


def _parted(
    vector: Float[Tensor, "b d"], problems: BundleBatch
) -> tuple[Float[Tensor, "b m 6"], Float[Tensor, "b n 3"]]:
    _, m, n = problems.weights.shape
    pose, point = vector.split((6 * m, 3 * n), dim=1)
    return pose.unflatten(1, (m, 6)), point.unflatten(1, (n, 3))


def _by_points(cross: Float[Tensor, "b poses n3"], inverse: Float[Tensor, "b n 3 3"]) -> Float[Tensor, "b poses n3"]:
    """Times a block for each point."""
    return torch.einsum("bpni, bnij -> bpnj", cross.unflatten(2, (-1, 3)), inverse).flatten(2)


def _damped(blocks: Float[Tensor, "b k s s"], damping: Float[Tensor, " b"] | None) -> Float[Tensor, "b k s s"]:
    if damping is None:
        return blocks
    return blocks + torch.diag_embed(damping[:, None, None] * blocks.diagonal(dim1=-2, dim2=-1))


def _standing(blocks: Float[Tensor, "b k s s"]) -> Float[Tensor, "b k s s"]:
    """With ones for the zeros in diagonals, of unknowns that nothing depends on."""
    diagonal = blocks.diagonal(dim1=-2, dim2=-1)
    return blocks + torch.diag_embed((diagonal == 0.0).to(blocks))
