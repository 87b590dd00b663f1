"""Clouds of every format are changed point by point, and keep all else that they hold."""

import struct

import numpy as np
import pytest
import torch

from torchrefrac.files.clouds import Changed, CloudError, open_cloud
from torchrefrac.files.clouds import las as las_files
from torchrefrac.files.clouds import ply as ply_files
from torchrefrac.files.clouds import table as table_files

COUNT = 25
FIELDS = {"depth": "below the water (m)", "views": "cameras"}
COLORS = np.arange(COUNT, dtype=np.uint8)


@pytest.fixture
def coordinates():
    """On a map, whole millimetres."""
    numbers = np.random.default_rng(5).integers(-20_000, 20_000, (COUNT, 3))
    return np.array((512_345.0, 5_123_456.0, 400.0)) + 0.001 * numbers


@pytest.fixture
def rewritten(tmp_path):
    """`rewritten(path)`: the cloud, with every third point 0.25 lower, and fields, in another folder."""

    def run(path):
        target, done = tmp_path / "out" / path.name, []

        def change(points):
            row = len(torch.cat(done)) if done else 0
            done.append(points)
            moved = torch.arange(row, row + len(points)) % 3 == 0
            depth = torch.where(moved, torch.arange(row, row + len(points)) + 0.5, torch.nan)
            lower = points - torch.tensor((0.0, 0.0, 0.25))
            return Changed(lower, moved, {"depth": depth.double(), "views": moved.double()})

        open_cloud(path).rewrite(target, change, FIELDS)
        assert [file.name for file in target.parent.iterdir()] == [target.name]
        return target, torch.cat(done).numpy()

    return run


@pytest.fixture(params=[1_000_000, 10])
def chunks(request, monkeypatch):
    """The whole at once, and in three parts."""
    for module in (las_files, ply_files, table_files):
        monkeypatch.setattr(module, "CHUNK", request.param)


MOVED = np.arange(COUNT) % 3 == 0
DEPTH = np.where(MOVED, np.arange(COUNT) + 0.5, np.nan).astype(np.float32)


def lowered(coordinates):
    return coordinates - np.where(MOVED, 0.25, 0.0)[:, None] * np.array((0.0, 0.0, 1.0))


@pytest.mark.usefixtures("chunks")
@pytest.mark.parametrize("name", ["dense.las", "dense.laz"])
@pytest.mark.parametrize("kind", [("1.2", 3), ("1.4", 7)])
def test_las_keeps_colours_classes_extra_bytes_and_the_bits_of_what_did_not_move(
    tmp_path, coordinates, rewritten, name, kind
):
    laspy = pytest.importorskip("laspy")
    from laspy.vlrs.vlrlist import VLRList  # noqa: PLC0415
    from pyproj import CRS  # noqa: PLC0415

    header = laspy.LasHeader(version=kind[0], point_format=kind[1])
    header.scales, header.offsets = np.full(3, 0.001), np.floor(coordinates.min(axis=0))
    header.add_crs(CRS.from_epsg(32633))
    header.add_extra_dims([laspy.ExtraBytesParams("views", "u1"), laspy.ExtraBytesParams("score", "f4")])
    given = laspy.LasData(header)
    given.x, given.y, given.z = coordinates.T
    given.red, given.classification, given.gps_time = COLORS.astype(np.uint16), COLORS, np.linspace(0.0, 1.0, COUNT)
    given["views"], given["score"] = COLORS, COLORS / 7.0
    given.vlrs.append(laspy.VLR("someone", 7, "note", b"content"))
    given.vlrs.append(laspy.VLR("copc", 1, "where points lie", b"no longer there"))
    if kind[0] == "1.4":
        given.evlrs = VLRList([laspy.VLR("someone", 8, "more", b"appended"), laspy.VLR("copc", 1000, "", b"tree")])
    given.write(tmp_path / name)

    target, seen = rewritten(tmp_path / name)

    cloud = open_cloud(tmp_path / name)
    assert (cloud.count, CRS.from_user_input(cloud.crs).to_epsg()) == (COUNT, 32633)
    found = laspy.read(target)
    assert (str(found.header.version), found.point_format.id) == kind
    assert found.header.parse_crs().to_epsg() == 32633
    np.testing.assert_allclose(seen, coordinates, atol=1e-9)
    assert np.array_equal(found.X, given.X)
    assert np.array_equal(found.Z, given.Z - np.where(MOVED, 250, 0))
    for dimension in ("red", "classification", "gps_time", "views", "score"):
        assert np.array_equal(found[dimension], given[dimension])
    assert np.array_equal(found["depth"], DEPTH, equal_nan=True)
    assert np.array_equal(found["corrected_views"], MOVED.astype(np.float32))
    assert [
        (record.record_id, record.record_data) for record in found.vlrs if record.user_id in ("someone", "copc")
    ] == [(7, b"content")]
    assert [record.record_data for record in found.evlrs or ()] == ([b"appended"] if kind[0] == "1.4" else [])
    described = {dimension.name: dimension.description for dimension in found.point_format.extra_dimensions}
    assert described["depth"] == "below the water (m)"
    np.testing.assert_allclose(found.header.mins, lowered(coordinates).min(axis=0), atol=0.6e-3)


@pytest.mark.usefixtures("chunks")
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_binary_ply_keeps_colours_faces_and_the_order_of_its_bytes(tmp_path, coordinates, rewritten, order, kind):
    near = coordinates - np.array((512_345.0, 5_123_456.0, 400.0))
    word = {"f4": "float", "f8": "double"}[kind]
    record = np.dtype([("x", order + kind), ("y", order + kind), ("red", "u1"), ("z", order + kind)])
    vertices = np.zeros(COUNT, record)
    vertices["x"], vertices["y"], vertices["z"] = near.T
    vertices["red"] = COLORS
    size = {"<": "little", ">": "big"}[order]
    head = (
        f"ply\nformat binary_{size}_endian 1.0\ncomment of a test\nelement vertex {COUNT}\nproperty {word} x\n"
        f"property {word} y\nproperty uchar red\nproperty {word} z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    face = struct.pack(f"{order}B3i", 3, 0, 1, 2)
    (tmp_path / "mesh.ply").write_bytes(head.encode() + vertices.tobytes() + face)

    target, seen = rewritten(tmp_path / "mesh.ply")

    np.testing.assert_array_equal(seen, np.stack([vertices[axis] for axis in "xyz"], axis=-1))
    start, _, rest = target.read_bytes().partition(b"end_header\n")
    assert start.decode() == head.replace(
        "element face", "property float depth\nproperty float views\nelement face"
    ).removesuffix("end_header\n")
    found = np.frombuffer(rest, [*record.descr, ("depth", order + "f4"), ("views", order + "f4")], COUNT)
    assert rest.endswith(face)
    assert len(rest) == found.nbytes + len(face)
    np.testing.assert_array_equal(found["red"], COLORS)
    np.testing.assert_array_equal(found["z"][~MOVED], vertices["z"][~MOVED])
    np.testing.assert_allclose(found["z"], lowered(near)[:, 2], atol=1e-5)
    np.testing.assert_array_equal(found["depth"], DEPTH)


@pytest.mark.usefixtures("chunks")
def test_text_ply_keeps_the_characters_of_what_did_not_move(tmp_path, coordinates, rewritten):
    head = f"ply\nformat ascii 1.0\nelement vertex {COUNT}\nproperty float x\nproperty float y\nproperty float z\n"
    lines = [f"{x:.3f} {y:.3f} {z:.3f} {color}" for (x, y, z), color in zip(coordinates, COLORS, strict=True)]
    end = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    text = head + "property uchar red\n" + end + "\n".join(lines) + "\n3 0 1 2\n"
    (tmp_path / "cloud.ply").write_text(text)

    target, seen = rewritten(tmp_path / "cloud.ply")

    np.testing.assert_allclose(seen, coordinates, atol=1e-9)
    written = target.read_text().splitlines()
    assert written[-1] == "3 0 1 2"
    rows = written[-1 - COUNT : -1]
    assert [row for row, moved in zip(rows, MOVED, strict=True) if not moved] == [
        f"{line} nan 0" for line, moved in zip(lines, MOVED, strict=True) if not moved
    ]
    np.testing.assert_allclose(
        [[float(part) for part in row.split()[:3]] for row in rows], lowered(coordinates), atol=1e-5
    )
    assert written[-1 - COUNT - 6 : -1 - COUNT - 3] == [
        "property uchar red",
        "property float depth",
        "property float views",
    ]


@pytest.mark.usefixtures("chunks")
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_keeps_texts_and_the_characters_of_what_did_not_move(tmp_path, coordinates, rewritten, separator):
    titles = ("id", "Easting", "Northing", "Elevation", "note", "Depth")
    rows = [(f"p{i}", f"{x:.3f}", f"{y:.3f}", f"{z:.3f}", f'"a{separator} é"', "7") for i, (x, y, z) in
            enumerate(coordinates)]  # fmt: skip
    text = "\n".join(separator.join(row) for row in (titles, *rows)) + "\n"
    (tmp_path / "cloud.csv").write_text("\ufeff" + text, encoding="utf-8")
    cloud = open_cloud(tmp_path / "cloud.csv")

    target, seen = rewritten(tmp_path / "cloud.csv")

    assert cloud.count == COUNT
    np.testing.assert_allclose(seen, coordinates, atol=1e-9)
    head, *written = target.read_text(encoding="utf-8").splitlines()
    assert head == separator.join((*titles, "corrected_depth", "views"))
    for line, row, moved, depth in zip(written, rows, MOVED, DEPTH, strict=True):
        *start, more, views = line.split(separator)
        assert (more, views) == ((f"{depth:g}", "1") if moved else ("", "0"))
        if moved:
            parts = separator.join(start).split(separator)
            assert float(parts[3]) == pytest.approx(float(row[3]) - 0.25)
            assert separator.join(parts[4:]) == separator.join(row[4:])
        else:
            assert separator.join(start) == separator.join(row)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.xyz", b"1 2 3", r"its name must end in \.las, \.laz, \.ply, \.csv"),
        ("none.csv", None, "is not a file, but cloud must be one"),
        ("a.csv", b"x,y,z\n", "has no points; there is nothing to correct"),
        ("a.csv", b"a,b,c\n1,2,3\n", "has no column called x"),
        ("a.ply", b"hello", "is not a PLY file"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\n"
                  b"end_header\n", "has no points"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "has no property y"),
        ("a.las", b"LASF", "cannot be read as LAS"),
        ("a.laz", b"nothing of the kind" * 100, "cannot be read as LAS"),
    ],
)  # fmt: skip
def test_what_is_no_cloud_is_refused_in_one_sentence(tmp_path, name, content, sentence):
    pytest.importorskip("laspy")
    if content is not None:
        (tmp_path / name).write_bytes(content)

    with pytest.raises(CloudError, match=sentence) as refused:
        open_cloud(tmp_path / name)

    assert name in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.csv", "x,y,z\n1,2,three\n"),
        ("a.csv", "x,y,z\n1,2,3\n1,2\n"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
                  "end_header\n1 2 3\n"),
    ],
)  # fmt: skip
def test_a_damaged_cloud_leaves_no_file(tmp_path, rewritten, name, content):
    (tmp_path / name).write_text(content)

    with pytest.raises(CloudError, match=name):
        rewritten(tmp_path / name)

    assert not list((tmp_path / "out").iterdir())
