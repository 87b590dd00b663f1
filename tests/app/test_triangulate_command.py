"""`torchrefrac triangulate` as a person uses it."""

import csv
from pathlib import Path

import numpy as np
import pytest

from torchrefrac import read_scene, triangulate_tracks


@pytest.fixture
def tracks(sparse, tmp_path):
    """fish.csv in the folder of the command: the observations of a run as of two fish in many frames, and these."""
    scene = read_scene(sparse / "run")
    seen = scene.observations
    names = [Path(scene.views.names[view]).stem for view in seen.view.tolist()]
    rows = zip(seen.point.tolist(), names, (seen.pixels - 0.5).tolist(), strict=True)
    lines = [f"{point // 2},{point % 2},{name},{x!r},{y!r}" for point, name, (x, y) in rows]
    _write(tmp_path / "fish.csv", lines)
    return scene, seen, lines


def _write(path, lines):
    path.write_text("\n".join(("frame,id,view,x,y", *lines)) + "\n")


def _read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_tracks_become_points_beside_a_record(torchrefrac, sparse, tracks, metrics, tmp_path):
    scene, seen, _ = tracks
    before = (tmp_path / "fish.csv").read_bytes()

    ended = torchrefrac("triangulate", f"run={sparse / 'run'}", "tracks=fish.csv")

    assert (ended.status, ended.err.count("error")) == (0, 0)
    expected, used = triangulate_tracks(scene, seen)
    count = int(expected.valid.sum())
    assert f"{count} points from {len(seen)} observations in 3 views" in ended.out
    assert "written to fish_3d/points.csv" in ended.out
    assert max(map(len, ended.out.splitlines())) <= 100
    rows = _read(tmp_path / "fish_3d" / "points.csv")
    assert [(int(row["frame"]), int(row["id"])) for row in rows] == [
        divmod(point, 2) for point in expected.valid.nonzero()[:, 0].tolist()
    ]
    points = np.array([[float(row[axis]) for axis in "XYZ"] for row in rows])
    np.testing.assert_allclose(points, expected.points[expected.valid].numpy(), rtol=1e-8, atol=1e-8)
    sigma = expected.covariance[expected.valid].diagonal(dim1=1, dim2=2).sqrt().numpy()
    given = np.array([[float(row[f"sigma_{axis}"]) for axis in "XYZ"] for row in rows])
    np.testing.assert_allclose(given, sigma, rtol=1e-4)
    assert [int(row["views"]) for row in rows] == expected.num_views[expected.valid].tolist()
    record = metrics(tmp_path / "fish_3d")
    assert (record["command"], record["points"], record["observations"]) == ("triangulate", count, len(seen))
    aside = int((~used & expected.valid[seen.point]).sum())
    assert record["observations_set_aside"] == aside == sum(int(row["set_aside"]) for row in rows)
    rms = (expected.rms.square() * expected.num_views)[expected.valid].sum() / expected.num_views[expected.valid].sum()
    assert record["reprojection_rms_px"] == pytest.approx(float(rms.sqrt()))
    assert (tmp_path / "fish.csv").read_bytes() == before
    assert sorted(path.name for path in (tmp_path / "fish_3d").iterdir()) == ["metrics.json", "points.csv"]


def test_pixels_may_count_from_the_corner(torchrefrac, sparse, tracks, tmp_path):
    _, seen, lines = tracks
    corner = [",".join((*line.split(",")[:3], *map(repr, place))) for line, place in
              zip(lines, seen.pixels.tolist(), strict=True)]  # fmt: skip
    _write(tmp_path / "corner.csv", corner)
    given = ("triangulate", f"run={sparse / 'run'}", "-q")

    assert torchrefrac(*given, "tracks=fish.csv", "out=center").out == ""
    assert torchrefrac(*given, "tracks=corner.csv", "pixel_origin=corner", "out=corner").status == 0

    both = [(tmp_path / name / "points.csv").read_bytes() for name in ("center", "corner")]
    assert both[0] == both[1]


@pytest.mark.usefixtures("tracks")
def test_noise_sets_the_sigmas_and_max_error_what_counts(torchrefrac, sparse, metrics, tmp_path):
    given = ("triangulate", f"run={sparse / 'run'}", "tracks=fish.csv")
    assert torchrefrac(*given, "out=usual").status == 0

    assert torchrefrac(*given, "pixel_sigma=0.6", "max_error=0.2", "out=strict").status == 0

    usual, strict = (metrics(tmp_path / name) for name in ("usual", "strict"))
    assert strict["points"] < usual["points"]
    unit = usual["length_unit"]
    sigmas = [_read(tmp_path / name / "points.csv")[0]["sigma_Z"] for name in ("usual", "strict")]
    assert float(sigmas[1]) > 1.5 * float(sigmas[0])
    assert usual[f"point_sigma_median_{unit}"] > 0.0


def test_points_of_one_view_and_contradictions_are_left_out_and_counted(torchrefrac, sparse, tracks, metrics, tmp_path):
    scene, _, lines = tracks
    names = [Path(name).stem for name in scene.views.names]
    more = [f"9999,0,{names[0]},10,10", f"9998,0,{names[0]},10,10", f"9998,0,{names[1]},600,400"]
    _write(tmp_path / "more.csv", [*lines, *more])
    given = ("triangulate", f"run={sparse / 'run'}")
    assert torchrefrac(*given, "tracks=fish.csv", "out=plain").status == 0

    ended = torchrefrac(*given, "tracks=more.csv", "out=more")

    plain, record = metrics(tmp_path / "plain"), metrics(tmp_path / "more")
    assert record["points"] == plain["points"]
    assert record["points_of_one_view"] == 1
    assert record["points_contradicted"] == plain["points_contradicted"] + 1
    assert "left out: 1 points, as only one view sees them" in ended.out
    assert (tmp_path / "more" / "points.csv").read_text() == (tmp_path / "plain" / "points.csv").read_text()


def test_what_cannot_be_right_is_one_sentence_and_writes_nothing(torchrefrac, sparse, tracks, tmp_path):
    _, _, lines = tracks
    view = lines[0].split(",")[2]
    _write(tmp_path / "unknown.csv", [*lines, "0,0,cam99,1,2"])
    _write(tmp_path / "words.csv", [f"0,0,{view},left,2"])
    _write(tmp_path / "single.csv", [f"0,0,{view},1,2"])
    (tmp_path / "column.csv").write_text("frame,id,image,x,y\n")

    for name, sentence in (
        ("unknown.csv", f"unknown.csv: line {len(lines) + 2}: view is 'cam99', but the run has placed"),
        ("words.csv", "words.csv: line 2: x is 'left', but must be a number"),
        ("column.csv", "column.csv has no column view; its first line must name frame, id, view, x, y"),
        ("single.csv", "single.csv: none of 1 points can be placed: 1 are seen by one view only"),
        ("none.csv", "none.csv does not exist, but must be a CSV file of tracks"),
    ):
        ended = torchrefrac("triangulate", f"run={sparse / 'run'}", f"tracks={name}", "out=new")
        assert (ended.status, ended.err.count("error: ")) == (1, 1)
        assert sentence in ended.err
    ended = torchrefrac("triangulate", "run=nowhere", "tracks=fish.csv", "out=new")
    assert "nowhere is not a folder, but run must be that of a run" in ended.err
    assert not (tmp_path / "new").exists()


@pytest.mark.usefixtures("tracks")
def test_the_same_command_again_replaces_what_it_wrote_and_nothing_else(torchrefrac, sparse, tmp_path):
    given = ("triangulate", f"run={sparse / 'run'}", "tracks=fish.csv")
    assert torchrefrac(*given).status == torchrefrac(*given).status == 0
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "points.csv").write_text("mine")

    ended = torchrefrac(*given, "out=old")

    assert "old holds points.csv, which no triangulate has written; name another folder as out" in ended.err
    assert (tmp_path / "old" / "points.csv").read_text() == "mine"
    (tmp_path / "fish.csv").rename(tmp_path / "points.csv")
    ended = torchrefrac("triangulate", f"run={sparse / 'run'}", "tracks=points.csv", "out=.")
    assert "where the tracks lie, but they must stay" in ended.err


def test_parts_of_a_long_table_are_those_of_the_whole(torchrefrac, sparse, tracks, tmp_path, monkeypatch):
    given = ("triangulate", f"run={sparse / 'run'}", "tracks=fish.csv", "-q")
    torchrefrac(*given, "out=whole")
    monkeypatch.setattr("torchrefrac.commands.triangulate.PART", 60)

    torchrefrac(*given, "out=parts")

    whole, parts = (np.array([list(map(float, row.values())) for row in _read(tmp_path / name / "points.csv")])
                    for name in ("whole", "parts"))  # fmt: skip
    np.testing.assert_allclose(parts, whole, rtol=1e-8, atol=1e-8)
