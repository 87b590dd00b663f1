"""What is stated and can hardly be is named, and only that."""

from dataclasses import replace

import pytest

from torchrefrac import load_capture
from torchrefrac.camera import Intrinsics
from torchrefrac.evaluate.doubts import doubts
from torchrefrac.files.library import embedded_scene
from torchrefrac.scene import Cameras, WarningCode


@pytest.fixture(scope="module")
def stated():
    """The capture of the embedded scene, 640 x 480 pixels."""
    return load_capture(embedded_scene("tank_small"))


@pytest.mark.parametrize(("center", "share"), [((0.0, 240.0), 50), ((320.0, 350.0), 23), ((250.0, 240.0), 11)])
def test_a_principal_point_far_from_the_middle_is_doubted(stated, center, share):
    cameras = Cameras.of([Intrinsics.create(640, 480, 417.0, center)])

    (found,) = doubts(replace(stated, cameras=cameras))

    assert found.code is WarningCode.INTRINSICS_CONTRADICT
    assert f"640x480 pixels, {share} % of the size from the middle" in found.message


@pytest.mark.parametrize("center", [(320.0, 240.0), (290.0, 250.0)])
def test_others_are_not(stated, center):
    assert doubts(stated) == ()
    assert doubts(replace(stated, cameras=Cameras.of([Intrinsics.create(640, 480, 417.0, center)]))) == ()


def test_a_camera_whose_principal_point_is_doubted_is_named(stated):
    lenses = [Intrinsics.create(640, 480, 417.0), Intrinsics.create(640, 480, 417.0, (0.0, 240.0))]

    (found,) = doubts(replace(stated, cameras=Cameras.of(lenses, ("phone", "gopro"))))

    assert found.message.startswith("the principal point of gopro is stated at (0.0, 240.0)")
