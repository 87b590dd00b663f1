"""The summary of a sweep: what differs between its jobs is found, failures are said first, and errors are drawn."""

import csv
import io
import json
import math

import cv2
import pytest

from torchrefrac.figures.plotting import blank_figure
from torchrefrac.figures.side_views import MODEL_COLORS, TITLES
from torchrefrac.files.run import RunRecord
from torchrefrac.sweeps.design import load_run, load_runs, short_keys, shown_together, what_varied
from torchrefrac.sweeps.drawing import set_heights
from torchrefrac.sweeps.figure import measures_of
from torchrefrac.sweeps.lines import lines_of, spots_of
from torchrefrac.sweeps.summary import write_summary
from torchrefrac.sweeps.table import csv_text, results_table

MODELS = ("none", "radial", "refractive")
KNOWN = {
    "images": 8, "registered_images": 8, "points": 50, "reprojection_median_px": 0.1, "seconds_total": 9.0,
    "determined": ["index ratio"], "held": {},
}  # fmt: skip
ERRORS = {"camera_rms_cm": 0.0125, "point_median_cm": 0.05, "flatness_cm": 0.025, "true_index_ratio": 1.333}


@pytest.fixture
def make_job(tmp_path):
    """`make_job(settings, status, ...)`: a job in memory; other fields of its metrics as given."""
    made = []

    def make(settings, status="complete", **fields):
        results = KNOWN | ERRORS if status == "complete" else {}
        metrics = {"status": status, **results, "scene": settings.get("scene", "tank")} | fields
        folder = tmp_path / f"{len(made)}_{settings.get('model', 'refractive')}"
        made.append(folder)
        reason = {} if status == "complete" else {"reason": "no pair"}
        about = {"model": settings.get("model", "refractive"), "overrides": dict(settings)}
        return RunRecord.of(folder, metrics | reason | about)

    return make


@pytest.fixture
def write_job(make_job):
    """`write_job(settings, status, ...)`: the folder of such a job."""

    def write(settings, status="complete", **fields):
        job = make_job(settings, status, **fields)
        job.write()
        return job.folder

    return write


def rows_of(table):
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]


# What is read, and what varied


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "metrics.json is missing"),
        ('{"status": "comp', "metrics.json is damaged: Unterminated string"),
        ("[1]", "metrics.json is damaged: it must be an object"),
        ('{"stages": 3}', "metrics.json is damaged: stages is 3, but must be a list"),
        ('{"model": ["none"]}', "metrics.json is damaged: model is ['none'], but must be a text"),
        ('{"scene": "' + "a" * 20_000 + '"}', "metrics.json is damaged: scene is 20000 long, but may be 10000 at most"),
        ("{}", "metrics.json gives no reason"),
        ('{"status": "running"}', "came to a sudden end, or is still running"),
    ],
)
def test_a_job_that_cannot_be_read_has_failed_for_that_reason(tmp_path, content, reason):
    if content is not None:
        (tmp_path / "metrics.json").write_text(content)

    job = load_run(tmp_path)

    assert job.status == "failed"
    assert job.reason.startswith(reason)


def test_bytes_that_are_no_text_are_a_reason_too(tmp_path):
    (tmp_path / "metrics.json").write_bytes(b"\xff\xfe\x00")

    assert load_run(tmp_path).reason.startswith("metrics.json is damaged: 'utf-8' codec")


def test_a_run_of_an_earlier_version_is_called_after_its_capture(tmp_path):
    (tmp_path / "metrics.json").write_text(
        json.dumps({"status": "complete", "model": "none", "capture": "data/mybay", **KNOWN})
    )

    job = load_run(tmp_path)

    assert (job.scene, job.model, dict(job.overrides)) == ("mybay", "none", {})


def test_a_failed_job_on_photographs_is_called_after_their_folder(write_job):
    folder = write_job({"scene": "capture", "scene.path": "data/mybay"}, "failed")

    assert load_run(folder).scene == "mybay"


def test_only_what_differs_was_varied_and_an_index_ratio_goes_along_the_axis(make_job):
    jobs = [
        make_job({"scene": s, "model": "none", "scene.images": n, "water.index_ratio": r, "dense": "patch", "seed": i})
        for s, n, r, i in (("tank", "8", "1.3", "0"), ("cans", "16", "1.33", "1"), ("cans", "32", "1.33", "0"))
    ]

    design = what_varied(jobs)

    assert design.x == "water.index_ratio"
    assert design.distinguished == ("scene.images",)
    assert design.averaged == ("seed",)


def test_what_a_failed_job_was_asked_for_does_not_take_the_axis_away(make_job):
    jobs = [make_job({"scene.index_ratio": "1.2"}), make_job({"scene.index_ratio": "abc"}, "failed")]

    assert what_varied(jobs).x == "scene.index_ratio"
    assert what_varied([*jobs, make_job({"scene.index_ratio": "abc"})]).x is None


def test_of_two_numbers_the_one_with_more_values_goes_along_the_axis(make_job):
    jobs = [make_job({"a.few": a, "a.many": b}) for a in "12" for b in "123"]

    assert what_varied(jobs).keys == ("a.many", "a.few")


def test_folders_of_captures_are_told_by_the_names_of_the_scenes(make_job):
    jobs = [make_job({"scene.path": f"data/{name}"}, scene=name) for name in ("bay", "reef")]
    alike = [make_job({"scene.path": f"{day}/bay"}, scene="bay") for day in ("monday", "tuesday")]

    assert what_varied(jobs).keys == ()
    assert what_varied(alike).keys == ("scene.path",)


def test_of_jobs_that_tell_nothing_nothing_is_concluded(make_job):
    assert what_varied([make_job({"scene.index_ratio": "1.2"}), make_job({}, "failed")]).keys == ()


def test_a_key_is_short_where_its_last_part_is_unique():
    assert short_keys(["scene.index_ratio", "water.index_ratio", "sfm.max_error", "dense"]) == {
        "scene.index_ratio": "scene.index_ratio", "water.index_ratio": "water.index_ratio",
        "sfm.max_error": "max_error", "dense": "dense",
    }  # fmt: skip


# Tables


def test_the_file_of_all_numbers_has_a_row_a_job_with_the_failed_ones_first(make_job):
    jobs = [
        make_job({"model": "none", "scene.index_ratio": "1.2"}),
        make_job({"model": "none", "scene.index_ratio": "1.5"}, "failed"),
        make_job({"model": "radial", "scene.index_ratio": "1.5"}, camera_rms_cm=math.nan, only_here=3),
    ]

    rows = list(csv.DictReader(io.StringIO(csv_text(jobs, what_varied(jobs)))))

    assert [row["job"] for row in rows] == ["1_none", "0_none", "2_radial"]
    about = ["job", "status", "reason", "scene", "model", "scene.index_ratio"]
    numbers = (name for name, value in {**KNOWN, **ERRORS, "only_here": 3}.items() if isinstance(value, int | float))
    assert list(rows[0]) == [*about, *sorted(numbers)]
    assert [row["reason"] for row in rows] == ["no pair", "", ""]
    assert [row["only_here"] for row in rows] == ["", "", "3"]
    assert [row["camera_rms_cm"] for row in rows] == ["", "0.0125", ""]


def test_commas_quotes_and_line_breaks_survive_the_file(make_job):
    job = make_job({"features.name": 'a,"b"\nc'})
    other = make_job({"features.name": "d"})

    rows = list(csv.DictReader(io.StringIO(csv_text([job, other], what_varied([job, other])))))

    assert [row["features.name"] for row in rows] == ['a,"b"\nc', "d"]


def test_the_table_has_what_varied_and_the_errors(make_job):
    jobs = [make_job({"model": m, "scene.index_ratio": r}) for m in ("none", "radial") for r in ("1.2", "1.5")]

    header, _, first, *others = rows_of(results_table(jobs, what_varied(jobs)))

    assert header == [
        "model", "index_ratio", "registered", "camera RMS (cm)", "3D error (cm)", "flatness (cm)", "seconds",
    ]  # fmt: skip
    assert first == ["none", "1.2", "8/8", "0.0125", "0.0500", "0.0250", "9.0"]
    assert len(others) == 3


def test_a_table_of_scenes_in_several_units_names_them_beside_the_numbers(make_job):
    in_metres = make_job({"scene": "riverbed"})
    metrics = {name.replace("_cm", "_m"): value for name, value in in_metres.metrics.items()}
    jobs = [make_job({"scene": "tank"}), RunRecord.of(in_metres.folder, metrics)]

    header, _, first, second = rows_of(results_table(jobs, what_varied(jobs)))

    assert header[3] == "camera RMS"
    assert (first[3], second[3]) == ("0.0125 cm", "0.0125 m")


def test_an_estimated_index_ratio_has_a_column_and_an_assumed_one_has_none(make_job):
    assumed = [make_job({"model": "refractive"}, index_ratio=1.33)]
    estimated = [*assumed, make_job({"model": "radial"}, index_ratio=1.3321, index_ratio_sigma=0.001)]

    assert "estimated ratio" not in results_table(assumed, what_varied(assumed))
    assert [row[-2] for row in rows_of(results_table(estimated, what_varied(estimated)))[2:]] == ["-", "1.3321"]


def test_a_wide_table_is_shortened_until_the_terminal_holds_it(make_job):
    jobs = [
        make_job({"scene": s, "model": m, "scene.index_ratio": r, "seed": n}, index_ratio_sigma=0.1, index_ratio=1.3)
        for s in ("riverbed", "tank") for m in MODELS for r in ("1.2", "1.333") for n in "12"
    ]  # fmt: skip

    table = results_table(jobs, what_varied(jobs))

    assert max(map(len, table.splitlines())) <= 100
    assert rows_of(table)[0] == [
        "scene", "model", "index_ratio", "seed", "reg.", "camera (cm)", "3D (cm)", "flat (cm)", "ratio",
    ]  # fmt: skip


def test_jobs_that_nothing_tells_apart_are_called_by_their_folders(make_job):
    jobs = [make_job({}), make_job({})]

    assert [row[0] for row in rows_of(results_table(jobs, what_varied(jobs)))] == [
        "job", "-" * 14, "0_refractive", "1_refractive",
    ]  # fmt: skip


# The picture


def test_a_line_holds_one_model_and_one_of_what_else_was_varied(make_job):
    jobs = [
        make_job({"model": m, "scene.index_ratio": r, "dense": d, "sfm.max_error": "2", "seed": s})
        for m in ("none", "refractive") for r in ("1.2", "1.5") for d in ("patch", "depthmap") for s in "01"
    ]  # fmt: skip

    lines = lines_of(jobs, what_varied(jobs))

    assert [line.label for line in lines] == [
        f"{TITLES[m]}, {d}" for m in ("none", "refractive") for d in ("patch", "depthmap")
    ]
    assert [len(line.jobs) for line in lines] == [4] * 4
    assert len({(line.color, line.dash) for line in lines}) == 4


def test_a_model_has_its_own_colour_whatever_it_is_compared_with(make_job):
    alone = lines_of([make_job({"model": "refractive"})], what_varied([]))
    together = [make_job({"model": model}) for model in ("mine", *MODELS)]

    lines = lines_of(together, what_varied(together))

    assert alone[0].color == lines[3].color
    assert [round(255 * channel) for channel in lines[3].color] == list(bytes.fromhex(MODEL_COLORS["refractive"][1:]))
    assert len({line.color for line in lines}) == 4


def test_seeds_share_a_spot_and_a_failed_job_leaves_a_gap(make_job):
    jobs = [
        make_job({"scene.index_ratio": "1.2", "seed": "0"}, camera_rms_cm=1.0),
        make_job({"scene.index_ratio": "1.2", "seed": "1"}, camera_rms_cm=3.0, registered_images=7),
        make_job({"scene.index_ratio": "1.0", "seed": "0"}, camera_rms_cm=0.5),
        make_job({"scene.index_ratio": "1.5", "seed": "0"}, "failed"),
        make_job({"scene.index_ratio": "abc", "seed": "0"}, "failed"),
        make_job({"scene": "cans", "scene.index_ratio": "1.7", "seed": "0"}),
    ]
    design = what_varied(jobs)

    first, shared, failed = spots_of(lines_of(jobs, design)[0], "tank", design.x, "camera_rms_cm", 0.0)

    assert (first.x, first.mean, first.partial) == (1.0, 0.5, False)
    assert (shared.x, shared.values, shared.mean, shared.partial) == (1.2, (1.0, 3.0), 2.0, True)
    assert (failed.x, failed.values, failed.failures) == (1.5, (), 1)
    assert math.isnan(failed.mean)


def test_without_truth_the_rows_are_what_can_be_told(make_job):
    job = make_job({})
    without = RunRecord.of(job.folder, KNOWN | {"status": "complete"})

    assert [measure.title for measure in measures_of([job])] == ["camera RMS", "3D error, median", "flatness, RMS"]
    assert [measure.title for measure in measures_of([without])] == ["error (px), median", "registered (%)", "points"]
    assert measures_of([]) == []


@pytest.mark.parametrize(
    ("values", "scale"), [((0.01, 0.5), "log"), ((0.01, 0.2), "linear"), ((0.0, 5.0), "linear"), ((), "linear")]
)
def test_a_wide_range_of_errors_has_a_logarithmic_axis(values, scale):
    panel = blank_figure(2.0, 2.0).subplots()

    set_heights(panel, values)

    assert panel.get_yscale() == scale
    low, high = panel.get_ylim()
    assert all(low <= value < high for value in values)


@pytest.mark.parametrize(
    "settings",
    [
        [{"model": m, "scene.index_ratio": r} for m in MODELS for r in ("1.0", "1.333", "abc")],
        [{"water.index_ratio": r, "seed": s} for r in ("1.30", "1.33", "1.36") for s in "01"],
        [{"model": m, "dense": d} for m in MODELS for d in ("patch", "depthmap")],
        [{"scene": f"scene{i}", "features.count": n} for i in range(5) for n in ("10", "1000")],
        [{}],
    ],
    ids=["true ratio", "assumed ratio", "no number", "many scenes", "one job"],
)
def test_every_sweep_has_a_picture(write_job, tmp_path, settings):
    runs = [write_job(job, "failed" if "abc" in job.values() else "complete") for job in settings]

    write_summary(tmp_path / "sweep", runs)

    assert {path.name for path in (tmp_path / "sweep").iterdir()} == {"summary.csv", "summary.md", "summary.png"}
    picture = cv2.imread(str(tmp_path / "sweep" / "summary.png"))
    assert picture is not None
    assert picture.std() > 5.0


# All together


def test_what_is_printed_says_failures_first_within_the_terminal(write_job, tmp_path):
    long = "no pair of images has enough matches that agree with one relative pose of two cameras, which needs overlap"
    runs = [write_job({"model": "none"}), write_job({"model": "radial"}, "failed"), write_job({"model": "refractive"})]
    known = json.loads((runs[1] / "metrics.json").read_text())
    (runs[1] / "metrics.json").write_text(json.dumps(known | {"reason": long}))
    (runs[2] / "metrics.json").unlink()

    text = str(write_summary(tmp_path, runs))

    failed, listed, table = text.split("\n\n")
    assert failed == "2 of 3 jobs failed:"
    assert " ".join(listed.split()) == f"- 1_radial (tank, radial): {long} - 2_refractive: metrics.json is missing"
    assert [row[0] for row in rows_of(table)[2:]] == ["none"]
    assert max(map(len, text.splitlines())) <= 100


def test_the_summary_links_to_what_lies_beside_it(write_job, tmp_path):
    runs = [write_job({"model": model}) for model in MODELS]
    for name in ("figure1.png", "figure1_of_another_sweep.png", "table1.md"):
        (tmp_path / name).touch()

    text = str(write_summary(tmp_path, runs))

    written = (tmp_path / "summary.md").read_text()
    assert written.startswith(text + "\n")
    links = [line.split("](")[1].split(")")[0] for line in written.splitlines() if line.startswith("- [")]
    assert links == ["summary.png", "summary.csv", "table1.md", "figure1.png"]


def test_failures_alone_have_no_picture_and_none_of_an_earlier_sweep(write_job, tmp_path):
    (tmp_path / "summary.png").touch()

    text = str(write_summary(tmp_path, [write_job({"model": "none"}, "failed")]))

    assert text == "The job failed:\n\n- 0_none (tank, none): no pair"
    assert not (tmp_path / "summary.png").exists()
    assert (tmp_path / "summary.csv").read_text().count("\n") == 2


def test_a_summary_of_nothing_is_refused(tmp_path):
    with pytest.raises(ValueError, match="runs is empty, but a summary needs at least one run folder"):
        write_summary(tmp_path, [])


def test_figures_of_reconstructions_are_named_by_scene_and_values_and_show_one_seed(make_job):
    jobs = [
        make_job({"scene": s, "model": m, "water": w, "seed": i}, capture=f"cache/{s}_0123")
        for s in ("tank", "cans") for m in ("none", "refractive") for w in ("a/b", "sea") for i in "01"
    ]  # fmt: skip

    named = shown_together(jobs, what_varied(jobs))

    assert sorted(named) == ["_cans_a-b.png", "_cans_sea.png", "_tank_a-b.png", "_tank_sea.png"]
    assert all([job.overrides["seed"] for job in jobs] == ["0", "0"] for jobs in named.values())


def test_jobs_are_kept_in_the_order_of_the_runs(write_job):
    runs = [write_job({"seed": str(i)}) for i in range(3)]

    assert [job.folder for job in load_runs(runs[::-1])] == runs[::-1]
