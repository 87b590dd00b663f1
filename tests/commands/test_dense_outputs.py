"""The files of a dense stage in a run folder: their names, and that they can be taken away again."""

from torchrefrac.commands.dense_outputs import depth_map_stems, remove_dense_outputs
from torchrefrac.files.run import DENSE_RESULTS, PARTS
from torchrefrac.record.summary import dense_lines, summary

METRICS = {
    "dense_method": "patch", "dense_points": 1234567, "seconds_dense": 123.4, "dense_views_median": 4.0,
    "dense_score_median": 0.951,
}  # fmt: skip


def test_depth_maps_are_named_after_their_images():
    assert depth_map_stems(("a.jpg", "left/b.1.jpg", "c.jpg", "c.png")) == {
        "a.jpg": "a", "left/b.1.jpg": "left/b.1", "c.jpg": "c.jpg", "c.png": "c.png",
    }  # fmt: skip


def test_results_are_removed_but_not_what_else_lies_there(tmp_path):
    kept = {"cameras.json", "points.ply", f"{PARTS}/patches_00000.npz", "dense/notes.txt"}
    removed = {*DENSE_RESULTS, "dense/a_depth.npz", "dense/left/right/b_depth.png"}
    for name in kept | removed:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()

    remove_dense_outputs(tmp_path)

    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == kept
    assert not (tmp_path / "dense" / "left").exists()


def test_nothing_to_remove_is_no_error(tmp_path):
    remove_dense_outputs(tmp_path)

    assert not list(tmp_path.iterdir())


def test_a_summary_says_what_is_known():
    plain = dense_lines(METRICS)
    measured = dense_lines(
        METRICS
        | {"dense_patches_per_s": 12345.6, "dense_images_resumed": 2, "dense_surface_median_cm": 0.1}
        | {"dense_accuracy_within_0.2_cm": 0.9, "dense_plane_rms_cm": 0.0456, "dense_plane_inliers": 0.97}
    )

    assert plain == ["dense (patch): 1234567 points in 123.4 s, each in 4 images (median), score 0.951"]
    assert measured[0].startswith("dense (patch): 1234567 points in 123.4 s (12346 patches/s), with 2 images")
    assert measured[1] == (
        "dense against truth: 90.0 % of the points within 0.2 cm of the surface, 0.0456 cm RMS from its planes "
        "without the farthest 3.0 %"
    )
    assert max(map(len, summary(measured).splitlines())) <= 100
