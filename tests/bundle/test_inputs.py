"""What cannot be adjusted is refused by name, before anything is computed."""

import re
from dataclasses import replace

import pytest
import torch

from torchrefrac.bundle import Observations, UnadjustableError, adjust, check_inputs

NAMES = ("left.jpg", "right.jpg", "far.jpg", "low.jpg")


@pytest.fixture
def refusal():
    """`refusal(planted, ...)`: what `check_inputs` says; changes are those of the state."""

    def message(planted, held=None, names=None, **changes):
        with pytest.raises(UnadjustableError) as caught:
            check_inputs(replace(planted.truth, **changes), planted.observations, planted.links, held, names)
        return str(caught.value)

    return message


@pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
def test_a_planted_scene_is_not_refused(plant, index_ratio):
    planted = plant(lenses=2, planes=2, land=3, index_ratio=index_ratio)

    check_inputs(planted.truth, planted.observations, planted.links)


@pytest.mark.parametrize("name", ["rotation", "center", "points", "index_ratio", "normal", "offset"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_state_that_is_not_finite_is_refused(plant, refusal, name, value):
    planted = plant()
    broken = getattr(planted.truth, name).clone()
    broken[(-1,) * broken.dim()] = value

    message = refusal(planted, **{name: broken})

    assert message == f"state.{name} is not finite"


@pytest.mark.parametrize("name", ["focal", "principal_point", "distortion"])
def test_a_lens_that_is_not_finite_is_refused(plant, refusal, name):
    planted = plant(lenses=2)
    broken = getattr(planted.truth.lens, name).clone()
    broken[1, 0] = torch.nan

    message = refusal(planted, lens=replace(planted.truth.lens, **{name: broken}))

    assert message == f"state.lens.{name} is not finite"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("camera", 4, "observations.camera has ids outside 0 to 3"),
        ("camera", -1, "observations.camera has ids outside 0 to 3"),
        ("point", 30, "observations.point has ids outside 0 to 29"),
        ("point", -2, "observations.point has ids outside 0 to 29"),
    ],
)
def test_ids_out_of_range_are_refused(plant, refusal, name, value, message):
    planted = plant()
    ids = getattr(planted.observations, name).clone()
    ids[5] = value

    told = refusal(replace(planted, observations=replace(planted.observations, **{name: ids})))

    assert told == message


def test_pixels_that_are_not_finite_are_refused_with_their_images(plant, refusal):
    planted = _with_broken_pixels(plant(), 7, 3)
    camera = planted.observations.camera

    message = refusal(planted, names=NAMES)

    first, second = (NAMES[int(camera[row])] for row in (3, 7))
    assert message == (f"pixels are not finite in observation 3 ({first}), 7 ({second}); leave such observations out")


def test_a_message_shows_the_first_four_of_many(plant, refusal):
    planted = _with_broken_pixels(plant(), *range(10, 19))

    message = refusal(planted)

    assert re.fullmatch(r".* observation 10 \(camera \d\), 11 .*, 12 .*, 13 .* and 5 more; leave .*", message)


def test_cameras_below_their_water_are_refused(plant, refusal):
    planted = plant(planes=2)
    offset = planted.truth.planes[1] + torch.tensor((0.0, 100.0))

    message = refusal(planted, names=NAMES, offset=offset)

    assert message == (
        "not above the water plane: far.jpg, low.jpg; give the plane in the frame of the cameras, its normal towards "
        "them"
    )


def test_in_air_there_is_no_water_to_be_below(plant):
    planted = plant(index_ratio=1.0)
    sunk = replace(planted.truth, offset=planted.truth.planes[1] + 100.0)

    check_inputs(sunk, planted.observations, planted.links)


def test_points_that_fewer_than_two_images_see_are_refused(plant, refusal):
    planted = plant()
    seen = planted.observations
    first_of_five = (seen.point == 5).nonzero()[0, 0]
    rows = torch.arange(len(seen))
    planted = planted.without((seen.point == 2) | ((seen.point == 5) & (rows != first_of_five)))

    message = refusal(planted)

    assert message == "seen by fewer than two images: point 2, 5; leave such points out"


def test_an_image_without_observations_is_refused(plant, refusal):
    planted = _without_image(plant(), 2)

    message = refusal(planted, names=NAMES)

    assert message == (
        "no common points connect the images: 2 parts, apart from the largest: far.jpg; adjust the parts one by one"
    )


def test_a_held_image_may_see_nothing(plant):
    planted = _without_image(plant(), 2)
    held = torch.zeros(4, 6, dtype=torch.bool)
    held[2] = True

    check_inputs(planted.truth, planted.observations, planted.links, held)


def test_an_image_of_which_a_part_is_held_may_not(plant, refusal):
    planted = _without_image(plant(), 2)
    held = torch.zeros(4, 6, dtype=torch.bool)
    held[2, 3:] = True

    assert "apart from the largest: camera 2" in refusal(planted, held)


def test_parts_that_no_points_connect_are_refused_and_the_largest_is_not_named(plant, refusal):
    planted = plant(cameras=5)
    point = torch.arange(30)
    camera = torch.where(point < 20, point % 3, 3)  # images 0, 1, 2 and images 3, 4
    second = torch.where(point < 20, (point + 1) % 3, 4)
    seen = Observations(torch.cat((camera, second)), torch.cat((point, point)), torch.zeros(60, 2, dtype=torch.float64))

    message = refusal(replace(planted, observations=seen), names=(*NAMES, "last.jpg"))

    assert message == (
        "no common points connect the images: 2 parts, apart from the largest: low.jpg, last.jpg; adjust the parts one "
        "by one"
    )


def test_adjust_refuses_what_the_check_refuses_unless_told_otherwise(plant):
    planted = _without_image(plant(), 2)

    with pytest.raises(UnadjustableError, match="apart from the largest: camera 2"):
        adjust(planted.truth, planted.observations)

    assert planted.adjusted(planted.truth, check=False).status == "converged"


def test_the_refusal_is_a_value_error():
    assert issubclass(UnadjustableError, ValueError)


def _with_broken_pixels(planted, *rows):
    pixels = planted.observations.pixels.clone()
    pixels[list(rows), 1] = torch.nan
    return replace(planted, observations=replace(planted.observations, pixels=pixels))


def _without_image(planted, image):
    """What the other images see, of points that two of them see."""
    planted = planted.without(planted.observations.camera == image)
    seen = planted.observations
    alone = torch.bincount(seen.point, minlength=30) < 2
    keep = (~alone).nonzero()[:, 0]
    new = torch.cumsum((~alone).long(), dim=0) - 1
    seen = seen[~alone[seen.point]]
    seen = replace(seen, point=new[seen.point])
    return replace(planted, truth=replace(planted.truth, points=planted.truth.points[keep]), observations=seen)
