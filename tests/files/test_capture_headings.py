"""Compass headings in capture.json: of all images or of none, in degrees."""

import math

import pytest

from torchrefrac.files.capture import load_capture
from torchrefrac.scene import CaptureError


def test_headings_arrive_in_radians(write_capture):
    def turn(content):
        for image, heading in zip(content["images"], (90.0, -450), strict=True):
            image["heading_deg"] = heading

    capture = load_capture(write_capture(turn))

    assert capture.has_heading.all()
    assert capture.heading.tolist() == pytest.approx([0.5 * math.pi, -2.5 * math.pi])


def test_a_capture_may_have_no_headings(write_capture):
    assert not load_capture(write_capture()).has_heading.any()


def test_headings_of_some_images_only_are_refused(write_capture):
    folder = write_capture(lambda content: content["images"][0].update(heading_deg=10.0))

    with pytest.raises(CaptureError, match=r"heading_deg of b.png is missing, but others have it; give it for"):
        load_capture(folder)


def test_a_heading_that_is_no_number_is_refused(write_capture):
    def spell(content):
        for image in content["images"]:
            image["heading_deg"] = "north"

    with pytest.raises(CaptureError, match=r"heading_deg is 'north', but must be a number"):
        load_capture(write_capture(spell))
