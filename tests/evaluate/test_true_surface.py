"""What true cameras see, against rays traced one by one, and distances to meshes by brute force."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.evaluate.mesh_distance import MeshDistance
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth, load_truth_points
from torchrefrac.geometry import so3_exp
from torchrefrac.geometry.surfaces import Rectangle
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import CaptureError, Interfaces, Truth

DOUBLE = torch.float64
UP = torch.tensor((0.0, 0.0, 1.0), dtype=DOUBLE)


@pytest.fixture
def truth():
    return load_truth(embedded_scene("tank_small"))


@pytest.fixture
def make_views(truth, draw):
    """`make_views(count, index_ratio)`: random true cameras (count), and pixels of them."""

    def make(count, index_ratio=1.33):
        which = torch.arange(count) % len(truth.names)
        cameras = RefractiveCamera(
            truth.intrinsics, truth.rotation[which], truth.center[which], FlatInterface(index_ratio)
        )
        return cameras, draw.uniform(0.0, 1.0, count, 2) * torch.tensor((640.0, 480.0), dtype=DOUBLE)

    return make


def with_mesh(truth, *others):
    """The planes of the truth as a mesh, with further surfaces."""
    surfaces = [*map(Rectangle, truth.corner, truth.edge1, truth.edge2), *others]
    return replace(truth, surface=as_mesh(surfaces))


def as_mesh(surfaces):
    vertices, faces, count = [], [], 0
    for surface in surfaces:
        v, f = surface.triangles()
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return TriangleMesh(torch.cat(vertices), torch.cat(faces))


def traced(truth, camera, pixel, index_ratio):
    """One ray: Snell's law by the angles, and each rectangle by a linear system. Place and plane, or None."""
    lens = truth.intrinsics
    (x, y), (fx, fy), (cx, cy) = pixel.tolist(), lens.focal.tolist(), lens.principal_point.tolist()
    way = truth.rotation[camera].mT @ torch.tensor(((x - cx) / fx, (y - cy) / fy, 1.0), dtype=DOUBLE)
    center = truth.center[camera]
    across = math.hypot(way[0], way[1])
    incidence = math.atan2(across, -float(way[2]))
    refraction = math.asin(math.sin(incidence) / index_ratio)
    heading = math.atan2(way[1], way[0])
    entry = center - center[2] / way[2] * way
    below = torch.tensor(
        (math.sin(refraction) * math.cos(heading), math.sin(refraction) * math.sin(heading), -math.cos(refraction)),
        dtype=DOUBLE,
    )
    best = (math.inf, None, -1)
    for plane, (corner, e1, e2) in enumerate(zip(truth.corner, truth.edge1, truth.edge2, strict=True)):
        u, v, length = torch.linalg.solve(torch.stack((e1, e2, -below), dim=-1), entry - corner).tolist()
        if 0.0 <= u <= 1.0 and 0.0 <= v <= 1.0 and 0.0 < length < best[0]:
            best = (length, entry + length * below, plane)
    return best[1:]


def test_a_camera_sees_what_a_ray_traced_by_hand_meets(truth, make_views):
    cameras, pixels = make_views(300)

    seen = TrueSurface(truth).cast(cameras, pixels)

    expected = [traced(truth, i % 8, pixel, 1.33) for i, pixel in enumerate(pixels)]
    assert seen.valid.tolist() == [place is not None for place, _ in expected]
    assert seen.plane.tolist() == [plane for _, plane in expected]
    assert {0, 1, 2} <= set(seen.plane.tolist())
    places = torch.stack([place for place, _ in expected if place is not None])
    torch.testing.assert_close(seen.points[seen.valid], places, rtol=0.0, atol=1e-9)
    assert not seen.points[~seen.valid].any()


@pytest.mark.parametrize("index_ratio", [1.0, 1.5])
def test_what_is_seen_projects_to_where_it_was_seen(truth, make_views, index_ratio):
    cameras, pixels = make_views(500, index_ratio)

    seen = TrueSurface(truth).cast(cameras, pixels)

    found, valid = cameras.project(seen.points)
    assert seen.valid.sum() > 300
    assert valid[seen.valid].all()
    torch.testing.assert_close(found[seen.valid], pixels[seen.valid], rtol=0.0, atol=1e-8)


def test_the_tank_is_seen_as_an_independent_ray_tracer_saw_it(shared_data):
    folder = shared_data("tank")
    truth = load_truth(folder)
    table = load_truth_points(folder, truth.names)
    cameras = RefractiveCamera(truth.intrinsics, truth.rotation, truth.center, FlatInterface(truth.index_ratio))
    which = torch.arange(len(table.names))[:, None, None].expand(table.valid.shape)[table.valid][::7]
    pixels = table.pixels().expand(*table.valid.shape, 2)[table.valid][::7]
    points, plane = table.points[table.valid][::7], table.plane[table.valid][::7]

    seen = TrueSurface(truth).cast(cameras[which], pixels)

    error = (seen.points - points).norm(dim=-1)
    same = seen.valid & (seen.plane == plane)
    assert (~same).sum() < 1e-3 * len(same)  # pixels on an edge
    assert error[same].max() < 1e-3
    assert len(same) > 50_000


def test_a_mesh_is_seen_as_the_planes_it_is_made_of(truth, make_views):
    cameras, pixels = make_views(2000)

    of_planes = TrueSurface(truth).cast(cameras, pixels)
    of_mesh = TrueSurface(with_mesh(truth)).cast(cameras, pixels)

    both = of_planes.valid & of_mesh.valid
    assert (of_planes.valid != of_mesh.valid).sum() <= 2
    torch.testing.assert_close(of_mesh.points[both], of_planes.points[both], rtol=0.0, atol=1e-9)
    assert (of_mesh.plane[both] != of_planes.plane[both]).sum() <= 2


def test_what_lies_on_no_plane_belongs_to_none(truth, make_views):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=25.0)
    vertices = torch.tensor(ball.vertices, dtype=DOUBLE) - 60.0 * UP
    mesh = TriangleMesh(vertices, torch.tensor(ball.faces))
    cameras, pixels = make_views(2000)

    seen = TrueSurface(with_mesh(truth, mesh)).cast(cameras, pixels)

    off = (seen.points + 60.0 * UP).norm(dim=-1)
    on_ball = seen.valid & (off < 25.0 + 1e-9)
    assert on_ball.sum() > 100
    assert (seen.plane[on_ball] == -1).all()
    assert off[on_ball].min() > 24.5
    assert (seen.plane[seen.valid & ~on_ball] >= 0).all()


def test_a_mesh_that_rounds_its_planes_as_a_file_does_keeps_them(truth, make_views):
    turned = so3_exp(torch.tensor((0.1, 0.2, 0.3), dtype=DOUBLE))
    moved = replace(truth, **{name: getattr(truth, name) @ turned.mT for name in ("corner", "edge1", "edge2")})
    cameras, pixels = make_views(2000)
    mesh = with_mesh(moved).surface
    rounded = TriangleMesh(mesh.vertices.float().double(), mesh.faces)

    exact = TrueSurface(moved).cast(cameras, pixels)
    found = TrueSurface(replace(moved, surface=rounded)).cast(cameras, pixels)

    both = exact.valid & found.valid
    assert both.sum() > 1000
    assert (found.plane[both] != exact.plane[both]).sum() <= 2


@pytest.mark.parametrize("as_a_mesh", [False, True])
def test_what_is_above_the_water_is_seen_straight_and_hides_what_is_below(draw, as_a_mesh):
    def table(*rows):
        return torch.tensor(rows, dtype=DOUBLE)

    down = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=DOUBLE))
    truth = Truth(
        names=("a",),
        rotation=down[None],
        center=table((0.0, 0.0, 40.0)),
        corner=table((-500.0, -500.0, -30.0), (0.0, -500.0, 10.0)),  # the bottom; a board over half of it
        edge1=table((1000.0, 0.0, 0.0), (500.0, 0.0, 0.0)),
        edge2=table((0.0, 1000.0, 0.0), (0.0, 1000.0, 0.0)),
        length_unit="cm",
        interfaces=Interfaces.level(1.33),
        intrinsics=Intrinsics.create(640, 480, 400.0),
    )
    camera = RefractiveCamera(truth.intrinsics, down, truth.center[0], FlatInterface(1.33))
    pixels = draw.uniform(0.0, 1.0, 200, 2) * torch.tensor((640.0, 480.0), dtype=DOUBLE)

    seen = TrueSurface(with_mesh(truth) if as_a_mesh else truth).cast(camera, pixels)

    right = pixels[:, 0] > 320.0
    assert seen.valid.all()
    assert torch.equal(seen.plane, right.long())
    straight = torch.stack(((pixels[:, 0] - 320.0) / 400.0, -(pixels[:, 1] - 240.0) / 400.0), dim=-1) * 30.0
    torch.testing.assert_close(seen.points[right, :2], straight[right], rtol=0.0, atol=1e-9)
    assert (seen.points[~right, 2] + 30.0).abs().max() < 1e-9


def test_a_camera_that_looks_at_the_sky_may_see_a_mountain_and_else_nothing():
    level = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=DOUBLE)
    wall = torch.tensor([[-5.0, 100.0, 30.0]], dtype=DOUBLE)
    truth = Truth(
        names=("a",),
        rotation=level[None],
        center=10.0 * UP[None],
        corner=wall,
        edge1=torch.tensor([[10.0, 0.0, 0.0]], dtype=DOUBLE),
        edge2=torch.tensor([[0.0, 0.0, 10.0]], dtype=DOUBLE),
        length_unit="m",
    )
    camera = RefractiveCamera(Intrinsics.create(640, 480, 400.0), level, 10.0 * UP, FlatInterface(1.33))

    seen = TrueSurface(truth).cast(camera, torch.tensor([[320.0, 140.0], [320.0, 20.0]], dtype=DOUBLE))

    assert seen.valid.tolist() == [True, False]
    torch.testing.assert_close(seen.points[0], torch.tensor((0.0, 100.0, 35.0), dtype=DOUBLE))
    assert seen.plane.tolist() == [0, -1]


def test_a_truth_without_a_surface_shows_nothing(truth, make_views):
    none = TrueSurface(replace(truth, corner=truth.corner[:0], edge1=truth.edge1[:0], edge2=truth.edge2[:0]))

    assert not none.is_known
    assert not none.cast(*make_views(10)).valid.any()
    with pytest.raises(ValueError, match="truth has neither planes nor a surface"):
        none.distance(torch.zeros(1, 3, dtype=DOUBLE))


def brute_force(points, vertices, faces):
    """Distance of each point to every triangle: to its plane where the foot lies inside, and to its three edges."""
    a, b, c = vertices[faces].unbind(dim=1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    p = points[:, None]
    height = ((p - a) * normal).sum(dim=-1)
    foot = p - height[..., None] * normal
    inside = torch.ones_like(height, dtype=torch.bool)
    best = torch.full_like(height, math.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        inside &= (torch.linalg.cross(edge.expand_as(foot), foot - start) * normal).sum(dim=-1) >= 0.0
        share = (((p - start) * edge).sum(dim=-1) / edge.square().sum(dim=-1)).clamp(0.0, 1.0)
        best = torch.minimum(best, (p - start - share[..., None] * edge).norm(dim=-1))
    return torch.where(inside, height.abs(), best).amin(dim=-1)


@pytest.fixture
def mixed_mesh(draw):
    """A hilly ground of small triangles, a large board, slivers of a can, and a triangle without an area."""
    side = torch.linspace(-20.0, 20.0, 21, dtype=DOUBLE)
    x, y = torch.meshgrid(side, side, indexing="xy")
    ground = torch.stack((x, y, 3.0 * (0.4 * x).sin() * (0.3 * y).cos()), dim=-1).view(-1, 3)
    i = (torch.arange(20)[:, None] * 21 + torch.arange(20)).flatten()
    faces = torch.cat((torch.stack((i, i + 1, i + 22), dim=-1), torch.stack((i, i + 22, i + 21), dim=-1)))
    board = Rectangle(-30.0 * UP - 100.0, torch.tensor((300.0, 10.0, 0.0), dtype=DOUBLE), 150.0 * (UP - UP.roll(1)))
    can = trimesh.creation.cylinder(radius=2.0, height=30.0, sections=48)
    can = TriangleMesh(torch.tensor(can.vertices, dtype=DOUBLE) + 15.0 * UP, torch.tensor(can.faces))
    nothing = TriangleMesh(torch.zeros(3, 3, dtype=DOUBLE) + 5.0, torch.tensor([[0, 1, 2]]))
    return as_mesh([TriangleMesh(ground, faces), board, can, nothing])


@pytest.mark.parametrize("reach", [0.01, 3.0, 100.0])
def test_the_distance_to_a_mesh_is_that_of_a_search_over_all_its_triangles(mixed_mesh, draw, reach):
    faces = mixed_mesh.faces[:-1]
    corners = mixed_mesh.vertices[faces[torch.randint(len(faces), (400,), generator=draw.generator)]]
    weights = torch.nn.functional.normalize(draw.uniform(0.0, 1.0, 400, 3), p=1.0, dim=-1)
    points = (weights[..., None] * corners).sum(dim=1) + reach * draw.normal(400, 3)

    found = MeshDistance.of(mixed_mesh.vertices, mixed_mesh.faces).distance(points)

    torch.testing.assert_close(found, brute_force(points, mixed_mesh.vertices, faces), rtol=1e-9, atol=1e-9)


def test_points_of_a_mesh_are_at_no_distance(truth):
    surface = TrueSurface(with_mesh(truth))
    s = torch.linspace(0.0, 1.0, 40, dtype=DOUBLE)
    grid = torch.cartesian_prod(s, s)
    points = (truth.corner[:, None] + grid[:, :1] * truth.edge1[:, None] + grid[:, 1:] * truth.edge2[:, None]).flatten(
        0, 1
    )

    assert surface.distance(points).max() < 1e-9
    assert surface.distance(points[:0]).shape == (0,)


def test_a_single_triangle_has_distances_too():
    corners = torch.eye(3, dtype=DOUBLE)

    found = MeshDistance.of(corners, torch.tensor([[0, 1, 2]])).distance(
        torch.stack((torch.zeros(3), torch.tensor((3.0, 0.0, 0.0))))
    )

    assert found.tolist() == pytest.approx([3.0**-0.5, 2.0])


def test_triangles_without_an_area_have_no_distance():
    with pytest.raises(ValueError, match="faces has no triangle with an area"):
        MeshDistance.of(torch.zeros(3, 3, dtype=DOUBLE), torch.tensor([[0, 1, 2]]))


@pytest.fixture
def folder(tmp_path):
    """A copy of the embedded scene's truth.json and capture.json, with a mesh beside them, and what changes it."""
    for name in ("truth.json", "capture.json"):
        shutil.copy(embedded_scene("tank_small") / name, tmp_path / name)
    trimesh.creation.box().export(tmp_path / "box.ply")

    def change(name="truth.json", **fields):
        content = json.loads((tmp_path / name).read_text())
        content.update(fields)
        (tmp_path / name).write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
        return tmp_path

    return change


def test_water_and_lens_come_from_the_capture_unless_the_truth_says_more(folder):
    plain = load_truth(folder())
    told = load_truth(folder(index_ratio=1.45))
    alone = folder()
    (alone / "capture.json").unlink()
    without_capture = load_truth(alone)
    without_ratio = load_truth(folder(index_ratio=None))

    assert plain.index_ratio == 1.33
    assert plain.intrinsics.principal_point.tolist() == [320.0, 240.0]
    assert plain.surface is None
    assert told.index_ratio == 1.45
    assert (without_capture.index_ratio, without_capture.intrinsics) == (1.45, None)
    assert without_ratio.index_ratio is None


def test_a_mesh_is_read_as_it_stands(folder):
    path = folder(surface="corners.ply")
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    trimesh.Trimesh(vertices, [[0, 1, 2], [3, 4, 5]], process=False).export(path / "corners.ply")

    surface = load_truth(path).surface

    assert surface.vertices.tolist() == vertices.tolist()
    assert surface.faces.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_what_is_wrong_with_a_mesh_is_said(folder):
    path = folder(surface="missing.ply")
    with pytest.raises(CaptureError, match=r"surface is 'missing.ply', but must name a file of triangles beside"):
        load_truth(path)
    (path / "missing.ply").write_bytes(b"ply\nrubbish\n")
    with pytest.raises(CaptureError, match=r"surface is 'missing.ply', which cannot be read"):
        load_truth(path)
    whole = (path / "box.ply").read_bytes()
    (path / "missing.ply").write_bytes(whole[: len(whole) - 40])
    with pytest.raises(CaptureError, match=r"surface is 'missing.ply', which"):
        load_truth(path)
    trimesh.PointCloud(np.eye(3)).export(path / "missing.ply")
    with pytest.raises(CaptureError, match=r"surface is 'missing.ply', which holds no triangles"):
        load_truth(path)
    with pytest.raises(CaptureError, match=r"surface is '\.\./box.ply', but must name a file of triangles beside"):
        load_truth(folder(surface="../box.ply"))
    with pytest.raises(CaptureError, match=r"index_ratio is 0\.5"):
        load_truth(folder(surface=None, index_ratio=0.5))
