"""Dense clouds and depth maps on disk: read back as they were, and damage named."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
import trimesh

from torchrefrac.files.dense import DenseFile, load_dense, load_depth_map, write_dense, write_depth_map
from torchrefrac.files.ply import DenseFileError, read_vertices, write_vertices
from torchrefrac.scene.dense import DenseCloud, DepthMap


@pytest.fixture
def make_cloud(draw):
    def make(count):
        return DenseCloud(
            points=draw.normal(count, 3),
            normals=draw.directions(count),
            colors=torch.randint(256, (count, 3), generator=draw.generator).to(torch.uint8),
            sigma=draw.power_of_ten(-3.0, -1.0, count),
            score=draw.uniform(0.5, 1.0, count),
            views=torch.randint(3, 20, (count,), generator=draw.generator),
            reference=torch.randint(300, (count,), generator=draw.generator),
            relative_sigma=draw.power_of_ten(-3.0, -1.0, count),
            length_unit="m",
            axis_sigma=draw.power_of_ten(-3.0, -1.0, count, 3),
            common_sigma=draw.power_of_ten(-3.0, -1.0, count),
        )

    return make


@pytest.fixture
def depth_map(draw):
    valid = draw.uniform(0.0, 1.0, 4, 6) < 0.7
    return DepthMap(
        name="DJI_0001.JPG",
        step=4,
        points=draw.normal(4, 6, 3) * valid[..., None],
        depth=draw.uniform(1.0, 2.0, 4, 6) * valid,
        sigma=draw.uniform(0.01, 0.02, 4, 6) * valid,
        valid=valid,
        length_unit="µm",
    )


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_dense_cloud_survives_the_file_in_single_precision(tmp_path, make_cloud, count):
    cloud = make_cloud(count)

    write_dense(cloud, tmp_path / "dense.ply")
    loaded = load_dense(tmp_path / "dense.ply")

    for name in ("points", "normals", "sigma", "score", "relative_sigma", "axis_sigma", "common_sigma"):
        assert torch.equal(getattr(loaded, name), getattr(cloud, name).float().double())
    for name in ("colors", "views", "reference"):
        assert torch.equal(getattr(loaded, name), getattr(cloud, name))
    assert loaded.length_unit == "m"
    numbers = [field.name for field in fields(cloud) if field.name != "length_unit"]
    assert [getattr(loaded, name).dtype for name in numbers] == [getattr(cloud, name).dtype for name in numbers]


def test_the_properties_have_the_names_and_types_that_viewers_know(tmp_path, make_cloud):
    write_dense(make_cloud(3), tmp_path / "dense.ply")

    header = (tmp_path / "dense.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:4] == ["ply", "format binary_little_endian 1.0", "comment length_unit m", "element vertex 3"]
    assert header[4:] == [
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "property ushort views",
        "property float sigma",
        *(f"property float sigma_{of}" for of in ("relative", "x", "y", "z", "common")),
        "property float score",
        "property int reference",
    ]


@pytest.mark.parametrize("count", [1, 100])
@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_trimesh_reads_points_colours_and_the_other_properties(tmp_path, make_cloud, count, offset):
    cloud = make_cloud(count)
    cloud = replace(cloud, points=cloud.points + offset)

    write_dense(cloud, tmp_path / "dense.ply")
    read = trimesh.load(tmp_path / "dense.ply", process=False)

    assert torch.allclose(torch.from_numpy(np.array(read.vertices)), cloud.points, rtol=1e-7, atol=1e-7)
    assert np.array_equal(np.asarray(read.colors)[:, :3], cloud.colors.numpy())
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(raw["views"].ravel(), cloud.views.numpy())
    assert np.array_equal(raw["reference"].ravel(), cloud.reference.numpy())


def test_coordinates_far_from_the_origin_keep_what_sigma_can_tell_apart(tmp_path, make_cloud):
    cloud = make_cloud(100)
    far = replace(cloud, points=cloud.points + torch.tensor([5e5, 5e6, 0.0], dtype=torch.float64))

    write_dense(far, tmp_path / "dense.ply")

    assert torch.equal(load_dense(tmp_path / "dense.ply").points, far.points)


def test_more_views_than_the_file_can_count_are_the_most_it_can(tmp_path, make_cloud):
    cloud = replace(make_cloud(2), views=torch.tensor([70000, 3]))

    write_dense(cloud, tmp_path / "dense.ply")

    assert load_dense(tmp_path / "dense.ply").views.tolist() == [65535, 3]


def test_properties_may_stand_in_any_order_and_type_among_others(tmp_path, make_cloud):
    cloud = make_cloud(50)
    write_dense(cloud, tmp_path / "dense.ply")
    vertices, comments = read_vertices(tmp_path / "dense.ply")
    wider = [(name, "f8" if kind == "<f4" else "i4") for name, kind in vertices.dtype.descr]
    columns = [(name, kind, torch.from_numpy(vertices[name].astype(kind))) for name, kind in wider]

    write_vertices([*columns[::-1], ("label", "i2", torch.zeros(50))], tmp_path / "other.ply", comments)

    one, other = load_dense(tmp_path / "dense.ply"), load_dense(tmp_path / "other.ply")
    for field in fields(cloud):
        if field.name != "length_unit":
            assert torch.equal(getattr(one, field.name), getattr(other, field.name))


def test_of_a_cloud_that_stays_in_its_file_some_points_are_read(tmp_path, make_cloud):
    write_dense(make_cloud(50), tmp_path / "dense.ply")
    whole, file = load_dense(tmp_path / "dense.ply"), DenseFile(tmp_path / "dense.ply")
    rows = torch.tensor([3, 49, 0])

    assert (len(file), file.length_unit) == (50, "m")
    for field in fields(whole):
        assert field.name == "length_unit" or torch.equal(
            getattr(file[rows], field.name), getattr(whole[rows], field.name)
        )
    with pytest.raises(DenseFileError, match=r"none\.ply cannot be read"):
        DenseFile(tmp_path / "none.ply")


def test_a_cloud_without_sigmas_along_axes_takes_its_sigma(tmp_path, make_cloud):
    write_dense(make_cloud(5), tmp_path / "dense.ply")
    vertices, comments = read_vertices(tmp_path / "dense.ply")
    older = [name for name in vertices.dtype.names if name not in ("sigma_x", "sigma_y", "sigma_z", "sigma_common")]
    columns = [(name, vertices.dtype[name].str[1:], torch.from_numpy(vertices[name].copy())) for name in older]

    write_vertices(columns, tmp_path / "older.ply", comments)
    loaded = load_dense(tmp_path / "older.ply")

    assert torch.equal(loaded.axis_sigma, loaded.sigma[:, None].expand(-1, 3))
    assert torch.allclose(loaded.common_sigma.square(), (loaded.sigma**2 - loaded.relative_sigma**2).clamp(min=0.0))


def test_big_endian_files_and_windows_line_ends_are_read(tmp_path):
    header = "ply\r\nformat binary_big_endian 1.0\r\nelement vertex 2\r\nproperty float x\r\nproperty uint16 k\r\n"
    records = np.array([(1.5, 7), (-2.0, 300)], dtype=[("x", ">f4"), ("k", ">u2")])
    (tmp_path / "a.ply").write_bytes(f"{header}end_header\r\n".encode() + records.tobytes())

    vertices, comments = read_vertices(tmp_path / "a.ply")

    assert vertices["x"].tolist() == [1.5, -2.0]
    assert vertices["k"].tolist() == [7, 300]
    assert comments == ()


def test_elements_behind_the_vertices_are_passed_over(tmp_path):
    mesh = trimesh.creation.box()
    mesh.export(tmp_path / "box.ply")

    vertices, _ = read_vertices(tmp_path / "box.ply")

    assert np.allclose(np.stack([vertices[name] for name in "xyz"], axis=1), mesh.vertices)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda data: data[:-1], "damaged: it has 609 bytes behind its header, but 10 vertices take 610"),
        (lambda data: data + b"\0", "damaged: it has 611 bytes behind its header, but 10 vertices take 610"),
        (lambda data: data[:40], "not a PLY file"),
        (lambda data: b"", "not a PLY file"),
        (lambda data: b"solid" + data, "not a PLY file"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "not a binary PLY file"),
        (lambda data: data.replace(b"length_unit m", b"length_unit \xff"), "damaged: its header is not text"),
        (lambda data: data.replace(b"length_unit", b"unit"), "lacks the comment 'length_unit ...'"),
        (lambda data: data.replace(b"float sigma", b"float error"), "vertices lack sigma"),
        (lambda data: data.replace(b"float sigma", b"float score"), "properties of different names"),
        (lambda data: data.replace(b"float sigma", b"list uchar float sigma"), "'property list uchar float sigma' is"),
        (lambda data: data.replace(b"vertex 10", b"vertex ten"), "must begin with 'element vertex' and its number"),
        (lambda data: data.replace(b"element vertex 10\n", b""), "must begin with 'element vertex'"),
        (lambda data: data.replace(b"float x", b"half x"), "'property half x' is not a property of one number"),
        (lambda data: data[:-61] + b"\xff" * 61, "a coordinate that is not finite"),
    ],
)
def test_a_damaged_cloud_is_named_with_what_is_wrong(tmp_path, make_cloud, change, problem):
    path = tmp_path / "dense.ply"
    write_dense(make_cloud(10), path)
    path.write_bytes(change(path.read_bytes()))

    with pytest.raises(DenseFileError) as caught:
        load_dense(path)

    assert str(path) in str(caught.value)
    assert problem in str(caught.value)


def test_a_cloud_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DenseFileError, match=r"dense\.ply cannot be read: No such file"):
        load_dense(tmp_path / "dense.ply")


def test_a_comment_has_one_line(tmp_path, make_cloud):
    with pytest.raises(ValueError, match="line break"):
        write_dense(replace(make_cloud(1), length_unit="m\nend_header"), tmp_path / "dense.ply")

    assert not list(tmp_path.iterdir())


def test_a_depth_map_survives_the_file_in_single_precision(tmp_path, depth_map):
    write_depth_map(depth_map, tmp_path / "map")
    loaded = load_depth_map(tmp_path / "map")

    assert (loaded.name, loaded.step, loaded.length_unit) == ("DJI_0001.JPG", 4, "µm")
    assert torch.equal(loaded.valid, depth_map.valid)
    for name in ("points", "depth", "sigma"):
        assert torch.equal(getattr(loaded, name), getattr(depth_map, name).float().double())


def test_a_depth_map_far_from_the_origin_keeps_its_points(tmp_path, depth_map):
    far = replace(depth_map, points=depth_map.points + 5e6 * depth_map.valid[..., None])

    write_depth_map(far, tmp_path / "map.npz")

    assert torch.equal(load_depth_map(tmp_path / "map.npz").points, far.points)


def test_a_depth_map_that_sees_nothing_survives_the_file(tmp_path, depth_map):
    blind = replace(depth_map, valid=torch.zeros(4, 6, dtype=torch.bool))

    write_depth_map(blind, tmp_path / "map.npz")

    assert not load_depth_map(tmp_path / "map.npz").valid.any()


@pytest.mark.parametrize("end", [0, 100, 700, -30])
def test_a_truncated_depth_map_is_named(tmp_path, depth_map, end):
    path = tmp_path / "map.npz"
    write_depth_map(depth_map, path)
    path.write_bytes(path.read_bytes()[:end])

    with pytest.raises(DenseFileError, match=r"map\.npz is not a whole NumPy archive"):
        load_depth_map(path)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"format": np.array("other/1")}, "has the format 'other/1', but must have 'torchrefrac-depth-map/1'"),
        ({}, "has the format '', but must have"),
        ({"format": np.array("torchrefrac-depth-map/1"), "name": np.array("a")}, "lacks step, points, depth"),
    ],
)
def test_another_archive_is_no_depth_map(tmp_path, arrays, problem):
    np.savez(tmp_path / "map.npz", **arrays, some=np.zeros(1))

    with pytest.raises(DenseFileError, match=problem):
        load_depth_map(tmp_path / "map.npz")


def test_arrays_of_a_depth_map_must_fit_each_other(tmp_path, depth_map):
    write_depth_map(depth_map, tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as arrays:
        np.savez(tmp_path / "map.npz", **(dict(arrays) | {"depth": arrays["depth"][:3]}))

    with pytest.raises(DenseFileError, match=r"depth is float32 \(3, 6\), but must be numbers \(4, 6\)"):
        load_depth_map(tmp_path / "map.npz")
