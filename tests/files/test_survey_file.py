"""survey.json: what is read, what is skipped, and what is refused with which sentence."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from torchrefrac.files.survey import read_survey, write_survey
from torchrefrac.scene.capture import CaptureError
from torchrefrac.scene.survey import Survey, SurveyError

NAMES = ("c.jpg", "a.jpg", "b.jpg")
COVARIANCE = [[4e-4, 1e-4, -2e-4], [1e-4, 9e-4, 3e-4], [-2e-4, 3e-4, 2.5e-3]]


@pytest.fixture
def survey_content():
    """A valid survey.json of three images and three marks."""
    return {
        "format": "torchrefrac-survey/1",
        "pixel_origin": "center",
        "images": {
            "a.jpg": {
                "down_in_cam": [0.0, 0.6, 0.8],
                "down_in_cam_sigma_deg": 0.5,
                "height": 42.0,
                "height_sigma": 0.2,
                "center": [1, 2, 3],
                "center_sigma": [0.02, 0.05, 0.1],
            },
            "b.jpg": {"center": [4.0, 5.0, 6.0], "center_covariance": COVARIANCE},
            "c.jpg": {"height": 40, "height_sigma": 1},
        },
        "marks": {
            "A": {"observations": {"a.jpg": [10, 20], "b.jpg": [11.5, 21.5]}},
            "B": {"observations": {"c.jpg": [30.0, 40.0]}, "position": [7, 8, 9], "sigma": 0.01},
            "C": {
                "observations": {"b.jpg": [50.0, 60.0], "a.jpg": [51.0, 61.0]},
                "on_waterline": True,
                "waterline_sigma": 0.003,
            },
        },
        "scale_bars": [{"from": "C", "to": "A", "length": 1.5, "sigma": 0.001}],
    }


@pytest.fixture
def read(tmp_path, survey_content):
    """Reads survey.json with `change` applied to its content."""

    def reader(change=None, names=NAMES):
        if change is not None:
            change(survey_content)
        path = tmp_path / "survey.json"
        path.write_text(json.dumps(survey_content))
        return read_survey(path, names)

    return reader


def _same(first, second):
    """Whether two surveys agree to the last bit, shapes and dtypes included."""
    pairs = [(getattr(first, field.name), getattr(second, field.name)) for field in dataclasses.fields(Survey)]
    return all(
        a.dtype == b.dtype and a.shape == b.shape and torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
        for a, b in pairs
    )


def test_what_is_measured_of_images_arrives_at_their_indices(read):
    survey = read()

    assert survey.names == NAMES
    assert survey.down_in_cam.tolist() == [pytest.approx([0.0, 0.6, 0.8])]
    assert survey.down_sigma.tolist() == [pytest.approx(0.5 * math.pi / 180.0)]
    assert survey.down_image.tolist() == [1]
    assert survey.height.tolist() == [42.0, 40.0]
    assert survey.height_sigma.tolist() == [0.2, 1.0]
    assert survey.height_image.tolist() == [1, 0]
    assert survey.center.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert survey.center_image.tolist() == [1, 2]
    assert survey.skipped == ()


def test_what_is_measured_of_marks_arrives_sorted_by_mark(read):
    survey = read()

    assert survey.control_names == ("A", "B", "C")
    assert survey.control.tolist() == [0, 0, 1, 2, 2]
    assert survey.control_image.tolist() == [1, 2, 0, 2, 1]
    assert survey.known_control.tolist() == [1]
    assert survey.known_position.tolist() == [[7.0, 8.0, 9.0]]
    assert survey.waterline_control.tolist() == [2]
    assert survey.waterline_sigma.tolist() == [0.003]
    assert (survey.bar_from.tolist(), survey.bar_to.tolist()) == ([2], [0])
    assert (survey.bar_length.tolist(), survey.bar_sigma.tolist()) == ([1.5], [0.001])
    assert survey.skipped_controls == ()


def test_opencv_pixels_are_shifted_by_half_a_pixel_once(read):
    survey = read()

    assert survey.control_pixels.tolist() == [[10.5, 20.5], [12.0, 22.0], [30.5, 40.5], [50.5, 60.5], [51.5, 61.5]]


@pytest.mark.parametrize("change", [lambda c: c.update(pixel_origin="corner"), lambda c: c.pop("pixel_origin")])
def test_pixels_are_colmap_s_where_nothing_else_is_said(read, change):
    survey = read(change)

    assert survey.control_pixels[:2].tolist() == [[10.0, 20.0], [11.5, 21.5]]


def test_information_is_the_inverse_of_the_covariance(read):
    survey = read()

    assert survey.center_information[0].numpy() == pytest.approx(np.diag([2500.0, 400.0, 100.0]))
    assert survey.center_information[1].numpy() == pytest.approx(np.linalg.inv(np.array(COVARIANCE)), rel=1e-12)
    assert survey.known_information[0].numpy() == pytest.approx(np.diag([1e4] * 3))


def test_one_sigma_of_a_centre_holds_for_all_axes(read):
    survey = read(lambda c: c["images"]["a.jpg"].update(center_sigma=0.5))

    assert survey.center_information[0].numpy() == pytest.approx(4.0 * np.eye(3))


def test_what_is_written_is_read_as_the_same(read, tmp_path):
    survey = read()

    write_survey(survey, tmp_path / "written.json")

    again = read_survey(tmp_path / "written.json", NAMES)
    for field in dataclasses.fields(Survey):
        first, second = getattr(survey, field.name), getattr(again, field.name)
        if isinstance(first, torch.Tensor):
            torch.testing.assert_close(second, first, rtol=1e-12, atol=1e-12, msg=field.name)
        else:
            assert first == second
    write_survey(Survey.empty(NAMES), tmp_path / "empty.json")
    assert _same(read_survey(tmp_path / "empty.json", NAMES), Survey.empty(NAMES))


def test_errors_of_known_positions_that_go_together_cannot_be_written(read, tmp_path):
    survey = read()
    together = dataclasses.replace(survey, known_information=torch.tensor([COVARIANCE], dtype=torch.float64))

    with pytest.raises(SurveyError, match=r"no place for errors of positions that go together, as of B; give sigmas$"):
        write_survey(together, tmp_path / "written.json")


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_covariance_of_any_unit_is_inverted_as_well(read, unit):
    scales = np.diag([1e-4, 1.0, 1e4]) * unit
    correlation = np.array([[1.0, 0.5, -0.2], [0.5, 1.0, 0.3], [-0.2, 0.3, 1.0]])
    covariance = (scales @ correlation @ scales).tolist()
    expected = np.linalg.inv(correlation)

    survey = read(lambda c: c["images"]["b.jpg"].update(center_covariance=covariance))

    assert scales @ survey.center_information[1].numpy() @ scales == pytest.approx(expected, rel=1e-12)


def test_a_covariance_may_differ_from_its_transpose_by_rounding(read):
    rounded = [list(row) for row in COVARIANCE]
    rounded[0][1] *= 1.0 + 1e-9

    information = read(lambda c: c["images"]["b.jpg"].update(center_covariance=rounded)).center_information[1]

    assert (information - information.mT).abs().max() <= 1e-12 * information.abs().max()


def test_directions_are_normalised_within_the_tolerance(read):
    survey = read(lambda c: c["images"]["a.jpg"].update(down_in_cam=[0, 0, -1.0005]))

    assert survey.down_in_cam.tolist() == [[0.0, 0.0, -1.0]]


def test_a_survey_of_nothing_is_the_empty_one(read):
    def strip(content):
        for name in ("pixel_origin", "images", "marks", "scale_bars"):
            del content[name]

    assert _same(read(strip), Survey.empty(list(NAMES)))


def test_empty_tables_keep_their_shapes():
    survey = Survey.empty(["a.jpg"])

    assert survey.names == ("a.jpg",)
    assert survey.center_information.shape == (0, 3, 3)
    assert survey.control_pixels.shape == (0, 2)
    assert survey.down_in_cam.dtype == survey.bar_sigma.dtype == torch.float64
    assert survey.control.dtype == survey.bar_from.dtype == torch.long


def test_a_mark_said_to_be_off_the_waterline_is_off_it(read):
    survey = read(lambda c: c["marks"]["C"].update(on_waterline=False))

    assert len(survey.waterline_control) == 0
    assert len(survey.control_names) == 3


def test_images_that_the_alignment_lacks_are_skipped_and_listed(read):
    survey = read(names=("c.jpg", "a.jpg"))

    assert survey.skipped == ("b.jpg",)
    assert survey.center_image.tolist() == [1]
    assert survey.height_image.tolist() == [1, 0]
    assert survey.control_image.tolist() == [0]


def test_an_image_seen_by_marks_alone_is_skipped_and_listed_too(read):
    survey = read(lambda c: c["marks"]["A"]["observations"].update({"z.jpg": [1, 2]}))

    assert survey.skipped == ("z.jpg",)
    assert survey.control.tolist() == [0, 0, 1, 2, 2]


def test_marks_that_skipped_images_leave_without_a_place_go_with_their_scale_bars(read):
    survey = read(
        lambda c: c["scale_bars"].append({"from": "B", "to": "A", "length": 2, "sigma": 1}), names=("c.jpg", "a.jpg")
    )

    assert survey.control_names == ("B",)
    assert survey.skipped_controls == ("A", "C")
    assert survey.control.tolist() == [0]
    assert survey.known_control.tolist() == [0]
    assert len(survey.waterline_control) == len(survey.bar_from) == len(survey.bar_length) == 0


def test_a_mark_of_known_position_that_no_image_of_the_alignment_sees_is_skipped(read):
    survey = read(names=("a.jpg", "b.jpg"))

    assert survey.skipped_controls == ("B",)
    assert survey.control_names == ("A", "C")
    assert survey.control.tolist() == [0, 0, 1, 1]
    assert (survey.waterline_control.tolist(), survey.bar_from.tolist(), survey.bar_to.tolist()) == ([1], [1], [0])


def test_a_survey_of_another_alignment_is_refused(read):
    sentence = r"survey.json names the images a.jpg, b.jpg, c.jpg, but the scene has none of them; .* x.jpg, y.jpg$"

    with pytest.raises(SurveyError, match=sentence):
        read(names=("x.jpg", "y.jpg"))


def test_an_error_in_what_is_measured_of_a_skipped_image_is_still_an_error(read):
    with pytest.raises(SurveyError, match=r"images.b.jpg.center is a list of 2"):
        read(lambda c: c["images"]["b.jpg"].update(center=[1, 2]), names=("a.jpg",))


def _set(**values):
    return lambda content: content.update(values)


def _image(**values):
    return lambda content: content["images"]["a.jpg"].update(values)


def _mark(mark, **values):
    return lambda content: content["marks"][mark].update(values)


def _bar(**values):
    return lambda content: content["scale_bars"][0].update(values)


def _without(*path):
    def change(content):
        for name in path[:-1]:
            content = content[name]
        del content[path[-1]]

    return change


def _covariance(*rows):
    return lambda content: content["images"]["b.jpg"].update(center_covariance=list(rows))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_set(format="something/2"), "format is 'something/2', but must be 'torchrefrac-survey/1'"),
        (_without("format"), "format is missing"),
        (_set(pixel_origin="middle"), "pixel_origin is 'middle', but must be 'center'"),
        (_set(scalebars=[]), "scalebars is not a known field; known here are format, pixel_origin"),
        (_set(images=[]), "images is a list of 0, but must be an object"),
        (_set(marks={"": {}}), "marks has an entry with an empty name"),
        (_set(images={"a.jpg": 3}), "images.a.jpg is 3, but must be an object"),
        (_image(hight=3), "images.a.jpg.hight is not a known field; known here are down_in_cam, height, center"),
        (_image(down_in_cam=[0, 0, 1.01]), "images.a.jpg.down_in_cam has length 1.0100, but must be a unit vector"),
        (_image(down_in_cam=[0, 0, 0]), "images.a.jpg.down_in_cam has length 0.0000"),
        (_image(down_in_cam_sigma_deg=0), "images.a.jpg.down_in_cam_sigma_deg is 0, but must be above 0"),
        (_without("images", "a.jpg", "down_in_cam_sigma_deg"), "images.a.jpg.down_in_cam_sigma_deg is missing"),
        (
            _without("images", "a.jpg", "down_in_cam"),
            "images.a.jpg.down_in_cam_sigma_deg is given without down_in_cam; give both or neither",
        ),
        (_image(height=-2), "images.a.jpg.height is -2, but must be above 0"),
        (_image(height_sigma=math.inf), "images.a.jpg.height_sigma is inf, but must be finite"),
        (_image(height_sigma=10**400), "images.a.jpg.height_sigma is inf, but must be finite"),
        (_image(height_sigma=math.nan), "images.a.jpg.height_sigma is nan, but must be finite"),
        (_image(height_sigma="0.2"), "images.a.jpg.height_sigma is '0.2', but must be a number"),
        (_without("images", "a.jpg", "height_sigma"), "images.a.jpg.height_sigma is missing"),
        (_without("images", "a.jpg", "height"), "images.a.jpg.height_sigma is given without height"),
        (_image(center=[1, 2]), "images.a.jpg.center is a list of 2, but must be a list of 3 numbers"),
        (_image(center_sigma=[1, 0, 1]), r"images.a.jpg.center_sigma\[1\] is 0, but must be above 0"),
        (_image(center_sigma=[1, 1]), "images.a.jpg.center_sigma is a list of 2, but must be a list of 3 numbers"),
        (_image(center_sigma=1e-200), r"images.a.jpg.center_sigma is 1e-200, but must lie between 1e-100 and 1e\+100"),
        (
            _image(center_covariance=COVARIANCE),
            "images.a.jpg.center has center_sigma and center_covariance, but needs one of the two",
        ),
        (
            _without("images", "a.jpg", "center_sigma"),
            "images.a.jpg.center has neither center_sigma nor center_covariance, but needs one of the two",
        ),
        (_without("images", "a.jpg", "center"), "images.a.jpg.center_sigma is given without center"),
        (_without("images", "b.jpg", "center"), "images.b.jpg.center_covariance is given without center"),
        (_covariance([1, 0, 0], [0, 1, 0]), "images.b.jpg.center_covariance is a list of 2, but must be 3 rows"),
        (
            _covariance([1, 0.5, 0], [0, 1, 0], [0, 0, 1]),
            r"images.b.jpg.center_covariance is \[\[1.0, 0.5, .* must be symmetric",
        ),
        (
            _covariance([1, 2, 0], [2, 1, 0], [0, 0, 1]),
            r"images.b.jpg.center_covariance is .* must be positive definite",
        ),
        (
            _covariance([1, 1, 0], [1, 1, 0], [0, 0, 1]),
            r"images.b.jpg.center_covariance is .* must be positive definite",
        ),
        (
            _covariance([1, 0, 0], [0, 0, 0], [0, 0, 1]),
            r"images.b.jpg.center_covariance is .* must be positive definite",
        ),
        (
            _covariance([1, 0, 0], [0, -1, 0], [0, 0, 1]),
            r"images.b.jpg.center_covariance is .* must be positive definite",
        ),
        (
            _covariance([1, 1e308, 0], [1e308, 1e-300, 0], [0, 0, 1]),
            r"images.b.jpg.center_covariance is .* positive def",
        ),
        (_covariance([1, 0, 0], [0, 1e-310, 0], [0, 0, 1]), r"images.b.jpg.center_covariance is .* positive definite"),
        (_mark("A", positon=[1, 2, 3]), "marks.A.positon is not a known field"),
        (_mark("A", observations=[]), "marks.A.observations is a list of 0, but must be an object"),
        (_mark("A", observations={"a.jpg": [1]}), r"marks.A.observations.a.jpg is a list of 1, .* list of 2 numbers"),
        (_mark("A", observations={"a.jpg": [1, math.nan]}), r"marks.A.observations.a.jpg\[1\] is nan"),
        (_without("marks", "A", "observations", "a.jpg"), "marks.A is observed 1x, but must be at least 2x, or 1x"),
        (_without("marks", "A", "observations"), "marks.A is observed 0x"),
        (_without("marks", "B", "observations"), "marks.B is observed 0x"),
        (_mark("A", position=[1, 2, 3]), "marks.A.sigma is missing"),
        (_without("marks", "B", "position"), "marks.B.sigma is given without position"),
        (_mark("B", sigma=-1), "marks.B.sigma is -1, but must be above 0"),
        (_mark("C", on_waterline="yes"), "marks.C.on_waterline is 'yes', but must be true or false"),
        (_without("marks", "C", "on_waterline"), "marks.C.waterline_sigma is given without on_waterline"),
        (_without("marks", "C", "waterline_sigma"), "marks.C.waterline_sigma is missing"),
        (_mark("C", waterline_sigma=0), "marks.C.waterline_sigma is 0, but must be above 0"),
        (_bar(to="D"), r"scale_bars\[0\].to is 'D', but must be one of the marks \(A, B, C\)"),
        (_bar(to="C"), r"scale_bars\[0\].to is 'C', but must be another mark than from"),
        (_bar(length=0), r"scale_bars\[0\].length is 0, but must be above 0"),
        (_bar(sigma=0), r"scale_bars\[0\].sigma is 0, but must be above 0"),
        (_bar(unit="m"), r"scale_bars\[0\].unit is not a known field"),
        (_without("scale_bars", 0, "from"), r"scale_bars\[0\].from is missing"),
        (_without("marks"), r"scale_bars\[0\].from is 'C', but must be one of the marks \(none\)"),
    ],
)
def test_a_survey_that_cannot_be_right_is_refused_by_name(read, change, sentence):
    with pytest.raises(SurveyError, match=f"survey.json: {sentence}"):
        read(change)


def test_a_name_given_twice_is_refused(tmp_path):
    path = tmp_path / "survey.json"
    path.write_text('{"format": "torchrefrac-survey/1", "marks": {"A": {}, "B": {}, "A": {}}}')

    with pytest.raises(SurveyError, match="'A' is given twice in one object, but names must differ"):
        read_survey(path, NAMES)


def test_malformed_json_says_where(tmp_path):
    path = tmp_path / "survey.json"
    path.write_text('{"format": ')

    with pytest.raises(SurveyError, match=r"survey.json is not valid JSON: .* line 1"):
        read_survey(path, NAMES)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(SurveyError, match=r"nowhere.json does not exist"):
        read_survey(str(tmp_path / "nowhere.json"), NAMES)

    with pytest.raises(SurveyError, match="is a folder, but must be a JSON file"):
        read_survey(tmp_path, NAMES)


def test_the_error_is_one_of_surveys_and_not_of_captures():
    assert issubclass(SurveyError, ValueError)
    assert not issubclass(SurveyError, CaptureError)
