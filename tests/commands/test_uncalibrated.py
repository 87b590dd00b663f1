"""Cameras that know nothing but EXIF: what is left of a calibration, and what is refined."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.commands.verification import initializer_of
from torchrefrac.config import ModelOptions, Options
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras
from torchrefrac.sfm import uncalibrated

FILM_DIAGONAL_MM = math.sqrt(36.0**2 + 24.0**2)


@pytest.fixture
def capture():
    """The embedded tank, taken in turn by a wide and by a long lens of other sizes, both with distortion."""
    lenses = (
        Intrinsics.create(640, 480, (415.0, 419.0), (300.0, 250.0), (0.1, -0.02, 0.0, 0.0, 0.0)),
        Intrinsics.create(480, 360, 900.0, (239.0, 181.0), (-0.3, 0.1, 0.0, 0.0, 0.0)),
    )
    known = load_capture(embedded_scene("tank_small"))
    return replace(known, cameras=Cameras.of(lenses, ("wide", "long")), camera=torch.arange(len(known)) % 2)


def test_each_photograph_has_a_camera_of_its_own_of_which_it_knows_whole_millimetres_of_focal_length(capture):
    found = uncalibrated(capture)

    assert found.camera.tolist() == list(range(len(capture)))
    assert found.cameras.names == capture.names
    for image, own in enumerate(found.camera.tolist()):
        stated, guessed = capture.intrinsics_of(image), found.cameras[own]
        diagonal = math.hypot(stated.width, stated.height)
        equivalent = float(guessed.focal[0]) / diagonal * FILM_DIAGONAL_MM
        assert equivalent == pytest.approx(round(equivalent), abs=1e-9)
        assert abs(float(stated.focal.mean()) / diagonal * FILM_DIAGONAL_MM - equivalent) <= 0.5
        assert (guessed.width, guessed.height) == (stated.width, stated.height)
        assert guessed.focal[0] == guessed.focal[1]
        assert guessed.principal_point.tolist() == [0.5 * stated.width, 0.5 * stated.height]
        assert not guessed.distortion.any()
    assert not found.cameras.are_uncertain


@pytest.mark.parametrize(
    ("model", "asked", "refined"),
    [
        ("none", (), ()),
        ("none", ("focal", "index_ratio"), ("focal",)),
        ("radial", ("focal", "radial"), ("focal", "radial")),
        ("radial", ("distortion",), ("distortion",)),
        ("bundler", (), ("focal", "radial")),
        ("bundler", ("distortion", "focal"), ("distortion", "focal")),
        ("bundler", ("principal_point",), ("principal_point", "focal", "radial")),
    ],
)
def test_models_without_refraction_refine_what_is_asked_for_and_what_is_their_own(capture, model, asked, refined):
    options = Options(model=ModelOptions(model))
    options = replace(options, sfm=replace(options.sfm, bundle=replace(options.sfm.bundle, refine=asked)))

    _, sfm = initializer_of(capture, 1.33, options, SilentRecorder())

    assert sfm.bundle.refine == refined
