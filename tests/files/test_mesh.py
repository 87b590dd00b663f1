"""The mesh of a raster: every triangle where it belongs, none across an edge."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
import trimesh

from tests.files.rasters import raster_of as plain_raster
from torchrefrac.files.mesh import height_field_mesh, write_mesh


def raster_of(height, valid=None, cell_size=0.5):
    """A raster whose south-western corner is at (10, 20); colours are all different."""
    height = torch.as_tensor(height, dtype=torch.float64)
    valid = None if valid is None else torch.as_tensor(valid)
    plain = plain_raster(height, valid, x_west=10.0, y_north=20.0 + len(height) * cell_size, cell_size=cell_size)
    color = torch.arange(3 * height.numel()).remainder(251).to(torch.uint8)
    return replace(plain, colors=color.reshape(*height.shape, 3) * plain.valid[..., None])


def plane(rows, columns, cell_size=0.5):
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return cell_size * (0.4 * column - 0.3 * row)


def test_a_plane_is_covered_once_with_normals_up():
    mesh = height_field_mesh(raster_of(plane(5, 7)))

    assert (mesh.vertices.shape, mesh.faces.shape) == ((35, 3), (2 * 4 * 6, 3))
    up = np.array([-0.4, -0.3, 1.0]) / np.linalg.norm([-0.4, -0.3, 1.0])
    assert np.allclose(mesh.face_normals, up)
    assert mesh.area * up[2] == pytest.approx(2.0 * 3.0)
    assert np.allclose(mesh.bounds[:, :2], [[10.25, 20.25], [13.25, 22.25]])


def test_vertices_are_the_centres_of_cells_with_their_height_and_colour(draw):
    raster = raster_of(draw.uniform(-1.0, 0.0, 4, 3))

    mesh = height_field_mesh(raster)

    x, y = raster.x.repeat(4), raster.y.repeat_interleave(3)
    assert np.array_equal(mesh.vertices, torch.stack((x, y, raster.height.flatten()), dim=-1).numpy())
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], raster.colors.flatten(0, 1).numpy())


@pytest.mark.parametrize("missing", range(4))
def test_three_valid_corners_make_one_triangle_with_its_normal_up(missing):
    valid = torch.arange(4).ne(missing).view(2, 2)

    mesh = height_field_mesh(raster_of(plane(2, 2), valid))

    assert (mesh.vertices.shape, mesh.faces.shape) == ((3, 3), (1, 3))
    assert mesh.face_normals[0, 2] > 0.8


def test_two_valid_corners_make_none():
    mesh = height_field_mesh(raster_of(plane(2, 2), [[True, False], [False, True]]))

    assert (mesh.vertices.shape, mesh.faces.shape) == ((0, 3), (0, 3))


def test_the_diagonal_is_the_one_with_the_smaller_difference():
    mesh = height_field_mesh(raster_of([[0.0, 0.3], [0.0, 0.0]]))
    other = height_field_mesh(raster_of([[0.3, 0.0], [0.0, 0.0]]))

    assert {frozenset(face) for face in mesh.faces.tolist()} == {frozenset((0, 2, 3)), frozenset((0, 1, 3))}
    assert {frozenset(face) for face in other.faces.tolist()} == {frozenset((0, 1, 2)), frozenset((1, 2, 3))}


def test_nothing_spans_a_step_and_both_sides_stay():
    height = torch.zeros(6, 8)
    height[:, 5:] = -4.0

    mesh = height_field_mesh(raster_of(height))
    bridged = height_field_mesh(raster_of(height), max_slope_deg=89.0)

    assert len(mesh.faces) == 2 * 5 * (4 + 2)
    assert np.allclose(mesh.face_normals, [0.0, 0.0, 1.0])
    assert len(mesh.split(only_watertight=False)) == 2
    assert len(bridged.faces) == 2 * 5 * 7


@pytest.mark.parametrize(("slope_deg", "count"), [(79.9, 2), (80.1, 0)])
def test_the_threshold_is_the_slope_of_a_triangle(slope_deg, count):
    rise = 0.5 * np.tan(np.radians(slope_deg)) / np.sqrt(2.0)

    mesh = height_field_mesh(raster_of([[0.0, rise], [rise, 2.0 * rise]]))

    assert len(mesh.faces) == count


def test_the_triangles_are_those_of_a_loop_over_the_quads(draw):
    raster = raster_of(draw.normal(12, 9), draw.uniform(0.0, 1.0, 12, 9) < 0.8)

    mesh = height_field_mesh(raster, max_slope_deg=70.0)

    found = sorted(sorted(map(tuple, np.round(corners, 9).tolist())) for corners in mesh.triangles)
    assert found == sorted(_loop(raster, 70.0))
    assert (mesh.face_normals[:, 2] > 0.0).all()
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (1, 5), (5, 1)])
def test_a_raster_without_quads_has_no_triangles(tmp_path, shape):
    mesh = height_field_mesh(raster_of(torch.zeros(shape)))

    write_mesh(mesh, tmp_path / "mesh.ply")

    assert (mesh.vertices.shape, mesh.faces.shape) == ((0, 3), (0, 3))
    assert (tmp_path / "mesh.ply").read_bytes().startswith(b"ply\n")


@pytest.mark.parametrize("angle", [0.0, -10.0, 90.5, float("nan")])
def test_a_slope_that_is_no_slope_is_refused(angle):
    with pytest.raises(ValueError, match=r"max_slope_deg is .*, but must lie above 0 and be at most 90"):
        height_field_mesh(raster_of(plane(2, 2)), max_slope_deg=angle)


def test_a_mesh_survives_the_file_and_nothing_else_is_left(tmp_path, draw):
    mesh = height_field_mesh(raster_of(draw.uniform(-1.0, 0.0, 6, 5)))

    write_mesh(mesh, tmp_path / "deeper" / "mesh.ply")
    loaded = trimesh.load(tmp_path / "deeper" / "mesh.ply", process=False)

    assert [path.name for path in (tmp_path / "deeper").iterdir()] == ["mesh.ply"]
    assert np.array_equal(loaded.vertices, mesh.vertices.astype(np.float32))
    assert np.array_equal(loaded.faces, mesh.faces)
    assert np.array_equal(loaded.visual.vertex_colors, mesh.visual.vertex_colors)


@pytest.mark.parametrize(
    ("east", "sigma", "kind"), [(0.0, 0.03, "<f4"), (512345.0, 0.03, "<f8"), (512345.0, 9.0, "<f4")]
)
def test_vertices_keep_the_digits_that_are_known(tmp_path, draw, east, sigma, kind):
    raster = replace(raster_of(draw.uniform(-1.0, 0.0, 6, 5), cell_size=0.1), x_west=east)
    mesh = height_field_mesh(raster)

    write_mesh(mesh, tmp_path / "mesh.ply", torch.full((30,), sigma, dtype=torch.float64))
    loaded = trimesh.load(tmp_path / "mesh.ply", process=False)

    assert np.array_equal(loaded.vertices, mesh.vertices.astype(kind))
    assert np.array_equal(loaded.faces, mesh.faces)
    written = loaded.metadata["_ply_raw"]["vertex"]["properties"]
    assert [written[name] for name in "xyz"] == [kind] * 3


def test_a_mesh_without_colours_has_none_in_the_file(tmp_path):
    corners = [[0.0, 0.0, 1.0], [4e6, 0.0, 1.0], [4e6, 0.5, 1.0]]

    write_mesh(trimesh.Trimesh(corners, [[0, 1, 2]], process=False), tmp_path / "mesh.ply")
    loaded = trimesh.load(tmp_path / "mesh.ply", process=False)

    assert loaded.triangles.tolist() == [corners]
    assert list(loaded.metadata["_ply_raw"]["vertex"]["properties"]) == ["x", "y", "z"]


def _loop(raster, max_slope_deg):
    """The sorted, rounded corners of the triangles that belong into the mesh, quad by quad."""
    rows, columns = raster.height.shape
    x, y, z = raster.x.tolist(), raster.y.tolist(), raster.height.tolist()
    triangles = []
    for r in range(rows - 1):
        for c in range(columns - 1):
            cells = [(r + i, c + j) for i in (0, 1) for j in (0, 1) if raster.valid[r + i, c + j]]
            if len(cells) == 4:
                (nw, ne, sw, se) = (z[i][j] for i, j in cells)
                ends = (0, 3) if abs(nw - se) <= abs(ne - sw) else (1, 2)
                chosen = [group for group in combinations(range(4), 3) if set(ends) <= set(group)]
            else:
                chosen = list(combinations(range(len(cells)), 3))
            for group in chosen:
                corners = np.array([(x[cells[k][1]], y[cells[k][0]], z[cells[k][0]][cells[k][1]]) for k in group])
                normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
                if np.degrees(np.arctan2(np.hypot(*normal[:2]), abs(normal[2]))) <= max_slope_deg:
                    triangles.append(sorted(map(tuple, np.round(corners, 9).tolist())))
    return triangles
