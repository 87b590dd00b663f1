"""Surfaces that rays meet: against scalar formulas, triangle by triangle, and against each other."""

import math

import pytest
import torch

from torchrefrac.geometry.surfaces import Cylinder, Rectangle, nearest
from torchrefrac.geometry.triangle_mesh import TriangleMesh


def vector(*components):
    return torch.tensor(components, dtype=torch.float64)


@pytest.fixture
def rays():
    """Origins above the scene and directions that mostly go down."""
    generator = torch.Generator().manual_seed(4)
    origins = torch.randn(400, 3, dtype=torch.float64, generator=generator) + vector(0.0, 0.0, 6.0)
    directions = 0.4 * torch.randn(400, 3, dtype=torch.float64, generator=generator) - vector(0.0, 0.0, 1.0)
    return origins, torch.nn.functional.normalize(directions, dim=-1)


@pytest.fixture
def rectangle():
    return Rectangle(vector(-2.0, -1.0, 0.5), vector(3.0, 0.5, 0.2), vector(-0.3, 2.0, 0.7))


@pytest.fixture
def cylinder():
    return Cylinder(vector(0.5, 0.0, -1.0), vector(0.8, -0.4, 2.5), 0.9)


def meets_triangle(origin, direction, a, b, c):
    """Möller and Trumbore's solution by Cramer's rule, for one ray and one triangle; infinite for a miss."""
    matrix = torch.stack((-direction, b - a, c - a), dim=-1)
    if abs(float(torch.linalg.det(matrix))) < 1e-14:
        return math.inf
    length, v, w = torch.linalg.solve(matrix, origin - a).tolist()
    return length if v >= 0.0 and w >= 0.0 and v + w <= 1.0 and length > 0.0 else math.inf


def first_triangle(surface, origins, directions):
    """Length to the nearest of a surface's triangles for each ray, one after another."""
    vertices, faces = surface.triangles()
    corners = vertices[faces]
    return torch.tensor([
        min(meets_triangle(o, d, *triangle) for triangle in corners) for o, d in zip(origins, directions, strict=True)
    ], dtype=torch.float64)  # fmt: skip


def test_a_rectangle_is_met_where_its_triangles_are(rectangle, rays):
    met = rectangle.intersect(*rays)

    oracle = first_triangle(rectangle, *rays)
    assert 20 < int(oracle.isfinite().sum()) < 380
    assert torch.equal(met.length.isfinite(), oracle.isfinite())
    assert torch.allclose(met.length[oracle.isfinite()], oracle[oracle.isfinite()], atol=1e-12)


def test_texture_coordinates_of_a_rectangle_lead_back_to_the_point(rectangle, rays):
    origins, directions = rays

    met = rectangle.intersect(origins, directions)

    hit = met.length.isfinite()
    points = (origins + met.length[:, None] * directions)[hit]
    u, v = met.uv[hit].unbind(dim=-1)
    assert torch.allclose(rectangle.corner + u[:, None] * rectangle.edge1 + v[:, None] * rectangle.edge2, points)


def test_points_where_a_cylinder_is_met_lie_on_its_side_or_an_end(cylinder, rays):
    origins, directions = rays

    met = cylinder.intersect(origins, directions)

    hit = met.length.isfinite()
    offset = (origins + met.length[:, None] * directions)[hit] - cylinder.base
    length = cylinder.axis.norm()
    along = offset @ (cylinder.axis / length)
    across = (offset - along[:, None] * cylinder.axis / length).norm(dim=-1)
    on_side = ((across - cylinder.radius).abs() < 1e-9) & (along >= -1e-9) & (along <= length + 1e-9)
    on_end = (across <= cylinder.radius + 1e-9) & ((along.abs() < 1e-9) | ((along - length).abs() < 1e-9))
    assert int(on_side.sum()) > 10
    assert int(on_end.sum()) > 10
    assert bool((on_side | on_end).all())


def test_a_cylinder_is_met_where_its_facets_are_but_for_their_flatness(cylinder, rays):
    mesh = TriangleMesh(*cylinder.triangles())

    smooth, flat = cylinder.intersect(*rays), mesh.intersect(*rays)

    both = smooth.length.isfinite() & flat.length.isfinite()
    assert int((smooth.length.isfinite() != flat.length.isfinite()).sum()) <= 2
    assert float((smooth.length - flat.length)[both].abs().median()) < 1e-3
    assert float((smooth.normal * flat.normal).sum(dim=-1)[both].abs().min()) > 0.99


def test_the_facets_of_a_cylinder_close_up_and_face_outwards(cylinder):
    trimesh = pytest.importorskip("trimesh")
    vertices, faces = cylinder.triangles()

    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)

    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(math.pi * cylinder.radius**2 * float(cylinder.axis.norm()), rel=2e-4)


def test_a_mesh_is_met_where_the_nearest_of_its_triangles_is_to_double_precision(rays):
    generator = torch.Generator().manual_seed(9)
    vertices = 3.0 * torch.randn(60, 3, dtype=torch.float64, generator=generator)
    mesh = TriangleMesh(vertices, torch.randperm(60, generator=generator).reshape(20, 3))
    origins, directions = (table[:80] for table in rays)

    met = mesh.intersect(origins, directions)

    oracle = first_triangle(mesh, origins, directions)
    hit = oracle.isfinite()
    assert int(hit.sum()) > 20
    assert torch.equal(met.length.isfinite(), hit)
    assert torch.allclose(met.length[hit], oracle[hit], rtol=0.0, atol=1e-12)


def test_texture_coordinates_of_a_mesh_are_x_and_y_unless_given(rays):
    origins, directions = rays
    vertices = vector(-9.0, -9.0, 0.0, 9.0, -9.0, 1.0, 0.0, 9.0, -1.0).reshape(3, 3)
    faces = torch.tensor([[0, 1, 2]])
    given = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)

    plain, painted = TriangleMesh(vertices, faces), TriangleMesh(vertices, faces, given)

    met, colored = plain.intersect(origins, directions), painted.intersect(origins, directions)
    hit = met.length.isfinite()
    points = (origins + met.length[:, None] * directions)[hit]
    assert torch.allclose(met.uv[hit], points[:, :2])
    v, w = colored.uv[hit].unbind(dim=-1)
    assert torch.allclose(
        (1 - v - w)[:, None] * vertices[0] + v[:, None] * vertices[1] + w[:, None] * vertices[2], points
    )


def test_the_nearest_surface_hides_those_behind_it(rectangle, cylinder, rays):
    found = nearest((cylinder, rectangle), *rays)

    lengths = torch.stack([surface.intersect(*rays).length for surface in (cylinder, rectangle)])
    shortest, index = lengths.min(dim=0)
    assert torch.equal(found.length, shortest)
    assert torch.equal(found.surface, torch.where(shortest.isfinite(), index, -1))
    assert torch.allclose(found.normal[found.surface >= 0].norm(dim=-1), torch.ones(1, dtype=torch.float64))


def test_a_ray_that_starts_on_a_surface_does_not_meet_it_there(rectangle):
    start = (rectangle.corner + 0.5 * rectangle.edge1 + 0.5 * rectangle.edge2)[None]

    met = rectangle.intersect(start, vector(0.0, 0.0, 1.0)[None])

    assert met.length.isinf().all()


def test_a_ray_along_a_rectangle_does_not_meet_it():
    level = Rectangle(vector(0.0, 0.0, -1.0), vector(2.0, 0.0, 0.0), vector(0.0, 3.0, 0.0))

    met = level.intersect(vector(-1.0, 1.0, -1.0)[None], vector(1.0, 0.0, 0.0)[None])

    assert met.length.isinf().all()
