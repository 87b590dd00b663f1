"""The one reader of JSON: what other programs write is read, what cannot be read is refused soon, in one sentence."""

import time

import pytest

from torchrefrac import load_capture
from torchrefrac.files.fields import read_json
from torchrefrac.files.survey import read_survey
from torchrefrac.files.truth import load_truth
from torchrefrac.files.water import read_water
from torchrefrac.scene import CaptureError, SceneError, SurveyError

IMAGES = 1_500_000


def test_a_byte_order_mark_is_read_over(write_capture):
    folder = write_capture()
    path = folder / "capture.json"
    path.write_text(path.read_text(), encoding="utf-8-sig")

    assert load_capture(folder).names == ("a.png", "b.png")


def test_a_byte_order_mark_is_read_over_in_every_file(tmp_path):
    survey, water = tmp_path / "survey.json", tmp_path / "water.json"
    survey.write_text('{"format": "torchrefrac-survey/1"}', encoding="utf-8-sig")
    plane = '{"normal": [0, 0, 1], "offset": 2.5}'
    content = f'{{"format": "torchrefrac-water/1", "length_unit": "m", "index_ratio": 1.33, "planes": [{plane}]}}'
    water.write_text(content, encoding="utf-8-sig")
    (tmp_path / "truth.json").write_text('{"length_unit": "m", "images": []}', encoding="utf-8-sig")

    assert read_survey(survey, ("a",)).names == ("a",)
    assert read_water(water, ("a",))[0].offset.tolist() == [2.5]
    with pytest.raises(CaptureError, match="is missing"):
        read_json(tmp_path / "truth.json").text("format")


def test_a_name_that_is_given_twice_is_named(write_capture):
    folder = write_capture()
    path = folder / "capture.json"
    path.write_text(path.read_text().replace('"height": 30.0', '"height": 30.0, "height": 3.0'))

    with pytest.raises(
        CaptureError, match=r"capture.json: 'height' is given twice in one object, but names must differ"
    ):
        load_capture(folder)


def test_so_it_is_in_water_and_truth(tmp_path):
    for name in ("water.json", "truth.json"):
        (tmp_path / name).write_text('{"length_unit": "m", "length_unit": "cm"}')

    with pytest.raises(SceneError, match=r"water.json: 'length_unit' is given twice"):
        read_water(tmp_path / "water.json", ("a",))
    with pytest.raises(CaptureError, match=r"truth.json: 'length_unit' is given twice"):
        load_truth(tmp_path)


@pytest.mark.parametrize("nested", ["[" * 100_000, '{"a":' * 100_000, "[" * 100_000 + "]" * 100_000])
def test_nesting_without_end_is_refused(tmp_path, nested):
    path = tmp_path / "survey.json"
    path.write_text(f'{{"images": {nested}}}')

    with pytest.raises(SurveyError, match=r"survey.json is nested more deeply than anything that is read here"):
        read_survey(path, ("a",))


@pytest.mark.parametrize(
    ("number", "said"), [("9" * 5000, "inf"), ("-" + "9" * 5000, "-inf"), ("NaN", "nan"), ("-Infinity", "-inf")]
)
def test_numbers_without_end_and_none_are_refused_by_their_field(write_capture, number, said):
    folder = write_capture()
    path = folder / "capture.json"
    path.write_text(path.read_text().replace("1.333", number))

    with pytest.raises(CaptureError, match=f"index_ratio is {said}, but must be finite"):
        load_capture(folder)


def test_a_size_of_five_thousand_digits_is_no_whole_number(write_capture):
    folder = write_capture()
    path = folder / "capture.json"
    path.write_text(path.read_text().replace('"width": 64', f'"width": {"9" * 5000}'))

    with pytest.raises(CaptureError, match=r"intrinsics.width is inf, but must be a whole number"):
        load_capture(folder)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            '"length_unit": "cm"',
            '"length_unit": "{}"',
            "length_unit has 1000000 characters, but must have at most 1000",
        ),
        ("1.333", '"{}"', r"index_ratio is 'a{99}... \(1000002 characters\), but must be a number"),
        ('"index_ratio"', '"{}": 1.0, "index_ratio"', r"a{100}... \(1000000 characters\) is not a known field"),
    ],
)
def test_of_a_text_without_end_little_is_said(write_capture, old, new, sentence):
    folder = write_capture()
    path = folder / "capture.json"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new.format("a" * 1_000_000)))

    with pytest.raises(CaptureError, match=sentence):
        load_capture(folder)


def test_whole_numbers_that_a_float_would_round_stay_as_they_are(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": 123456789012345678}')

    assert read_json(path).integer("a") == 123456789012345678


@pytest.mark.parametrize(
    ("image", "sentence"),
    [
        ("{}", r"images lists 1500000, but must list at most 100000"),
        ('{"name": "00000.jpg", "height": 30.0}', r"capture.json has \d+ MB, but must have at most 32"),
    ],
)
def test_a_million_and_a_half_images_are_refused_within_a_second(write_capture, image, sentence):
    folder = write_capture()
    path = folder / "capture.json"
    start, _, _ = path.read_text().partition('"images": ')
    path.write_text(f'{start}"images": [{", ".join([image] * IMAGES)}]}}')

    begun = time.process_time()
    with pytest.raises(CaptureError, match=sentence):
        load_capture(folder)
    assert time.process_time() - begun < 1.0
