"""Rigid motions against plain formulas with rotation and translation."""

import pytest
import torch

from torchrefrac.geometry import Rigid


@pytest.fixture
def motion(draw):
    """`motion(*batch)`: at random."""
    return lambda *batch: Rigid(draw.rotations(*batch), draw.normal(*batch, 3))


def translation(motion):
    """t of x_in_b = R x_in_a + t."""
    return -torch.einsum("...ij,...j->...i", motion.rotation, motion.center)


def test_points_are_turned_and_shifted(motion, draw):
    b_from_a, points = motion(5), draw.normal(5, 3)

    expected = torch.einsum("bij,bj->bi", b_from_a.rotation, points) + translation(b_from_a)
    torch.testing.assert_close(b_from_a.apply(points), expected, rtol=0.0, atol=1e-14)


def test_one_motion_applies_to_many_points_and_many_to_one(motion, draw):
    one, many, point, points = motion(), motion(4), draw.normal(3), draw.normal(4, 3)

    for i in range(4):
        torch.testing.assert_close(one.apply(points)[i], one.apply(points[i]), rtol=0.0, atol=1e-15)
        torch.testing.assert_close(many.apply(point)[i], many[i].apply(point), rtol=0.0, atol=1e-15)


def test_the_centre_is_what_comes_to_the_origin(motion):
    b_from_a = motion(4)

    assert torch.equal(b_from_a.apply(b_from_a.center), torch.zeros(4, 3, dtype=torch.float64))


def test_motions_compose_where_names_touch(motion, draw):
    c_from_b, b_from_a, points = motion(5), motion(5), draw.normal(5, 3)

    c_from_a = c_from_b @ b_from_a

    torch.testing.assert_close(c_from_a.apply(points), c_from_b.apply(b_from_a.apply(points)), rtol=0.0, atol=1e-14)
    torch.testing.assert_close(c_from_a.rotation, c_from_b.rotation @ b_from_a.rotation, rtol=0.0, atol=1e-15)
    expected = torch.einsum("bij,bj->bi", c_from_b.rotation, translation(b_from_a)) + translation(c_from_b)
    torch.testing.assert_close(translation(c_from_a), expected, rtol=0.0, atol=1e-14)


def test_composition_is_associative(motion):
    d_from_c, c_from_b, b_from_a = motion(3), motion(3), motion(3)

    one, two = (d_from_c @ c_from_b) @ b_from_a, d_from_c @ (c_from_b @ b_from_a)

    torch.testing.assert_close(one.rotation, two.rotation, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(one.center, two.center, rtol=0.0, atol=1e-14)


def test_one_motion_goes_before_and_after_many(motion):
    rig_from_world, cameras = motion(), motion(4)

    after, before = cameras @ rig_from_world, rig_from_world @ cameras

    for i in range(4):
        for found, expected in ((after[i], cameras[i] @ rig_from_world), (before[i], rig_from_world @ cameras[i])):
            torch.testing.assert_close(found.rotation, expected.rotation, rtol=0.0, atol=1e-15)
            torch.testing.assert_close(found.center, expected.center, rtol=0.0, atol=1e-15)


def test_the_inverse_undoes_a_motion(motion, draw):
    b_from_a, points = motion(5), draw.normal(5, 3)

    a_from_b = b_from_a.inverse

    torch.testing.assert_close(a_from_b.apply(b_from_a.apply(points)), points, rtol=0.0, atol=1e-14)
    torch.testing.assert_close(a_from_b.inverse.center, b_from_a.center, rtol=0.0, atol=1e-14)
    for both in (a_from_b @ b_from_a, b_from_a @ a_from_b):
        same = Rigid.identity(5)
        torch.testing.assert_close(both.rotation, same.rotation, rtol=0.0, atol=1e-14)
        torch.testing.assert_close(both.center, same.center, rtol=0.0, atol=1e-14)


def test_the_identity_leaves_points_where_they_are(draw):
    points = draw.normal(2, 4, 3)

    assert torch.equal(Rigid.identity(2, 4).apply(points), points)
    assert torch.equal(Rigid.identity().apply(points), points)
    assert Rigid.identity(3, dtype=torch.float32).center.dtype == torch.float32
    assert Rigid.identity(2, 4).rotation.shape == (2, 4, 3, 3)


def test_some_of_a_batch_are_taken_as_of_a_tensor(motion):
    many = motion(6)

    for index in (2, slice(1, 4), torch.tensor([5, 0]), torch.arange(6) > 3):
        assert torch.equal(many[index].rotation, many.rotation[index])
        assert torch.equal(many[index].center, many.center[index])
    assert len(many) == 6


def test_motions_are_differentiable(motion, draw):
    given, points = motion(3), draw.normal(3, 3)
    center = given.center.clone().requires_grad_()

    assert torch.autograd.gradcheck(
        lambda value: (Rigid(given.rotation, value).inverse @ Rigid(given.rotation, value)).apply(points), center
    )
    (gradient,) = torch.autograd.grad(Rigid(given.rotation, center).apply(points).sum(), center)
    torch.testing.assert_close(gradient, -given.rotation.sum(dim=-2))
