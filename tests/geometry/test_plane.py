"""Oriented planes."""

import math

import pytest
import torch

from tests.tolerances import DTYPES, assert_matches
from torchrefrac.geometry import Plane, rotate, so3_exp

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def test_the_default_is_the_plane_of_height_zero(draw):
    points = draw.normal(5, 3)

    assert torch.equal(Plane().signed_distance(points), points[:, 2])


def test_the_normal_is_scaled_to_one_and_the_offset_is_along_it(draw):
    normal, points = draw.normal(20, 3), draw.normal(20, 3)

    plane = Plane(normal, 0.7)
    in_numbers = Plane(tuple(normal[0].tolist()), 0.7)

    assert_matches(plane.normal.norm(dim=-1), torch.ones(20, dtype=torch.float64))
    assert_matches(plane.signed_distance(points), (normal * points).sum(dim=-1) / normal.norm(dim=-1) - 0.7)
    assert_matches(in_numbers.normal_like(points), plane.normal[0])


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1e-12), (3e6, 4e6, 0.0)])
def test_any_length_of_the_normal_but_zero_will_do(normal):
    tensor = torch.tensor(normal, dtype=torch.float64)

    assert math.hypot(*Plane(normal).normal) == pytest.approx(1.0, abs=1e-15)
    assert_matches(Plane(tensor).normal, tensor / tensor.norm())


@pytest.mark.parametrize(
    "normal",
    [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (math.inf, 0.0, 1.0), torch.zeros(3), torch.tensor([0.0, math.nan, 1.0])],
)
def test_a_normal_that_is_zero_or_not_finite_is_refused(normal):
    with pytest.raises(ValueError, match=r"^length of normal is .* must be finite and above 0"):
        Plane(normal)


def test_one_zero_normal_in_a_batch_is_refused():
    with pytest.raises(ValueError, match="length of normal is 0 somewhere"):
        Plane(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("normal", [(0.0, 1.0), (0.0, 0.0, 0.0, 1.0)])
def test_a_normal_without_three_components_is_refused(normal):
    with pytest.raises(ValueError, match=rf"normal has {len(normal)} components, but must have 3"):
        Plane(normal)
    with pytest.raises(ValueError, match=r"normal has shape .* but must end in \(3,\)"):
        Plane(torch.tensor(normal))


@pytest.mark.parametrize("offset", [math.nan, math.inf, torch.tensor([0.0, math.nan])])
def test_an_offset_that_is_not_finite_is_refused(offset):
    with pytest.raises(ValueError, match=r"^offset is (nan|inf)"):
        Plane(offset=offset)


def test_the_plane_through_a_point_holds_it(draw):
    point, normal = (0.3, -1.2, 2.5), (1.0, 2.0, -0.5)

    plane = Plane.through(point, normal)

    assert float(plane.signed_distance(torch.tensor(point, dtype=torch.float64))) == pytest.approx(0.0, abs=1e-15)
    assert plane.normal == pytest.approx(tuple(n / math.hypot(*normal) for n in normal))


def test_the_tangents_of_the_horizontal_plane_are_x_and_y():
    first, second = Plane().tangents_like(UP)

    assert torch.equal(first, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert torch.equal(second, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_tangents_are_unit_vectors_in_the_plane_and_right_handed_whatever_its_direction(draw, dtype):
    tiny = torch.tensor([[1e-9, 0.0, -1.0], [0.0, -1e-20, -1.0], [1.0, 0.0, 1e-300], [1.0, 0.0, -1e-300]])
    axes = torch.cat((torch.eye(3), -torch.eye(3), tiny)).to(torch.float64)
    plane = Plane(torch.cat((axes, draw.directions(500))).to(dtype))

    first, second = plane.tangents_like(plane.normal)

    frame = torch.stack((first, second, plane.normal), dim=-1)
    assert frame.isfinite().all()
    assert_matches(frame.mT @ frame, torch.eye(3, dtype=dtype).expand_as(frame))
    assert_matches(torch.linalg.det(frame), torch.ones(len(frame), dtype=dtype))


def test_the_gradient_through_the_tangents_is_finite_in_every_direction():
    normal = torch.cat((torch.eye(3), -torch.eye(3))).double().requires_grad_()

    first, second = Plane(normal).tangents_like(normal)
    (first.sum() + second.sum()).backward()

    assert normal.grad.isfinite().all()


def test_a_plane_that_does_not_move_stays(draw):
    plane = Plane(draw.normal(5, 3), draw.normal(5))

    moved = plane.moved(torch.zeros(5, 2, dtype=torch.float64))

    assert_matches(moved.normal, plane.normal)
    assert_matches(moved.offset, plane.offset)


def test_a_tilt_turns_the_normal_about_the_tangents(draw):
    plane, tilt = Plane(draw.normal(5, 3), draw.normal(5)), draw.normal(5, 2)

    moved = plane.moved(tilt, height=0.3)

    first, second = plane.tangents_like(tilt)
    turn = so3_exp(tilt[:, :1] * first + tilt[:, 1:] * second)
    assert_matches(moved.normal, rotate(turn, plane.normal))
    assert_matches(moved.offset, plane.offset + 0.3)


def test_the_first_tilt_moves_the_normal_against_the_second_tangent_and_the_second_along_the_first(draw):
    plane, tilt = Plane(draw.normal(3), 0.2), torch.zeros(2, dtype=torch.float64)
    first, second = plane.tangents_like(tilt)

    by_tilt = torch.autograd.functional.jacobian(lambda x: plane.moved(x).normal, tilt)
    by_height = torch.autograd.functional.jacobian(lambda x: plane.moved(tilt, x).offset, torch.tensor(0.0).double())

    assert_matches(by_tilt, torch.stack((-second, first), dim=-1))
    assert by_height == 1.0


def test_distances_do_not_depend_on_the_frame(draw):
    plane, points = Plane(draw.normal(5, 3), draw.normal(5)), draw.normal(5, 3)
    turn, origin = draw.rotations(5), draw.normal(5, 3)

    moved = plane.in_frame(turn, origin)

    assert_matches(moved.signed_distance(rotate(turn, points - origin)), plane.signed_distance(points), slack=10.0)
    assert_matches(moved.normal, rotate(turn, plane.normal))


def test_the_shape_is_what_normal_and_offset_broadcast_to():
    assert Plane().shape == ()
    assert Plane(torch.ones(4, 1, 3)).shape == (4, 1)
    assert Plane(torch.ones(4, 1, 3), torch.zeros(2)).shape == (4, 2)
    with pytest.raises(ValueError, match=r"normal \(4,\), offset \(3,\)"):
        _ = Plane(torch.ones(4, 3), torch.zeros(3)).shape


@pytest.mark.parametrize("dtype", DTYPES)
def test_numbers_take_the_dtype_of_what_they_meet(dtype):
    points = torch.zeros(2, 3, dtype=dtype)
    plane = Plane((0.0, 3.0, 4.0), -0.1)

    assert plane.normal_like(points).dtype == dtype
    assert plane.signed_distance(points).dtype == dtype
    assert_matches(plane.signed_distance(points), torch.full((2,), 0.1, dtype=dtype))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_raised_to_single(dtype):
    assert Plane(torch.ones(3, dtype=dtype)).normal.dtype == torch.float32


def test_some_of_a_batch_are_those_that_indexing_gives(draw):
    plane = Plane(draw.normal(4, 1, 3), draw.normal(2))

    some = plane.indexed((slice(1, 3), 1), (4, 2))

    assert_matches(some.normal, plane.normal[1:3, 0])
    assert torch.equal(some.offset, plane.offset[1].expand(2))


def test_another_dtype_is_taken_by_tensors_and_left_by_numbers(draw):
    plane = Plane(draw.normal(4, 3), draw.normal(4)).to(dtype=torch.float32)

    assert plane.normal.dtype == plane.offset.dtype == torch.float32
    assert Plane((0.0, 0.0, 2.0), 0.5).to(dtype=torch.float32).offset == 0.5


def test_the_gradient_reaches_normal_and_offset(draw):
    normal, offset, points = draw.normal(3), torch.tensor(0.2, dtype=torch.float64), draw.normal(4, 3)
    inputs = [normal.requires_grad_(), offset.requires_grad_()]

    assert torch.autograd.gradcheck(lambda n, o: Plane(n, o).signed_distance(points), inputs, check_forward_ad=True)
