"""What cannot be adjusted is refused by name, before anything is computed."""

import re
from dataclasses import replace

import pytest
import torch

from tests.bundle.changes import changed, tensor_of
from torchrefrac.bundle import UnadjustableError, adjust, check_inputs
from torchrefrac.scene import Observations, SceneError

NAMES = ("left.jpg", "right.jpg", "far.jpg", "low.jpg")


@pytest.fixture
def refusal():
    """`refusal(planted, ...)`: what `check_inputs` says; changes are those of the scene."""

    def message(planted, fixed=None, names=None, **changes):
        with pytest.raises(UnadjustableError) as caught:
            check_inputs(changed(_named(planted, names), **changes), fixed)
        return str(caught.value)

    return message


@pytest.mark.parametrize("index_ratio", [1.333, 1.0], ids=["water", "air"])
def test_a_planted_scene_is_not_refused(plant, index_ratio):
    planted = plant(cameras=2, interfaces=2, land=3, index_ratio=index_ratio)

    check_inputs(planted.truth)


@pytest.mark.parametrize(
    ("table", "name"),
    [
        ("views.", "rotation"),
        ("views.", "center"),
        ("", "points"),
        ("interfaces.", "index_ratio"),
        ("interfaces.", "normal"),
        ("interfaces.", "offset"),
    ],
)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_scene_that_is_not_finite_is_refused(plant, refusal, table, name, value):
    planted = plant()
    broken = tensor_of(planted.truth, name).clone()
    broken[(-1,) * broken.dim()] = value

    message = refusal(planted, **{name: broken})

    assert message == f"scene.{table}{name} is not finite"


@pytest.mark.parametrize("name", ["focal", "principal_point", "distortion"])
def test_a_camera_that_is_not_finite_is_refused(plant, refusal, name):
    planted = plant(cameras=2)
    broken = tensor_of(planted.truth, name).clone()
    broken[1, 0] = torch.nan

    message = refusal(planted, **{name: broken})

    assert message == f"scene.cameras.{name} is not finite"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("view", 4, "observations.view has ids outside 0 to 3"),
        ("view", -1, "observations.view has ids outside 0 to 3"),
        ("point", 30, "observations.point has ids outside 0 to 29"),
        ("point", -2, "observations.point has ids outside 0 to 29"),
    ],
)
def test_ids_out_of_range_are_refused(plant, refusal, name, value, message):
    planted = plant()
    ids = getattr(planted.observations, name).clone()
    ids[5] = value

    found = refusal(replace(planted, observations=replace(planted.observations, **{name: ids})))

    assert found == message


def test_pixels_that_are_not_finite_are_refused_with_their_images(plant, refusal):
    planted = _with_broken_pixels(plant(), 7, 3)
    view = planted.observations.view

    message = refusal(planted, names=NAMES)

    first, second = (NAMES[int(view[row])] for row in (3, 7))
    assert message == (f"pixels are not finite in observation 3 ({first}), 7 ({second}); leave such observations out")


def test_a_message_shows_the_first_four_of_many(plant, refusal):
    planted = _with_broken_pixels(plant(), *range(10, 19))

    message = refusal(planted)

    assert re.fullmatch(r".* observation 10 \(\d\), 11 .*, 12 .*, 13 .* and 5 more; leave .*", message)


def test_cameras_below_their_water_are_refused(plant, refusal):
    planted = plant(interfaces=2)
    offset = planted.truth.interfaces.offset + torch.tensor((0.0, 100.0))

    message = refusal(planted, names=NAMES, offset=offset)

    assert message == (
        "not above the water plane: far.jpg, low.jpg; give the plane in the frame of the cameras, its normal towards "
        "them"
    )


def test_in_air_there_is_no_water_to_be_below(plant):
    planted = plant(index_ratio=1.0)
    sunk = changed(planted.truth, offset=planted.truth.interfaces.offset + 100.0)

    check_inputs(sunk)


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


def test_a_fixed_image_may_see_nothing(plant):
    planted = _without_image(plant(), 2)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[2] = True

    check_inputs(planted.seen_in(planted.truth), fixed)


def test_an_image_of_which_a_part_is_fixed_may_not(plant, refusal):
    planted = _without_image(plant(), 2)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[2, 3:] = True

    assert "apart from the largest: 2" in refusal(planted, fixed)


def test_parts_that_no_points_connect_are_refused_and_the_largest_is_not_named(plant, refusal):
    planted = plant(views=5)
    point = torch.arange(30)
    view = torch.where(point < 20, point % 3, 3)  # images 0, 1, 2 and images 3, 4
    second = torch.where(point < 20, (point + 1) % 3, 4)
    seen = Observations(torch.cat((view, second)), torch.cat((point, point)), torch.zeros(60, 2, dtype=torch.float64))

    message = refusal(replace(planted, observations=seen), names=(*NAMES, "last.jpg"))

    assert message == (
        "no common points connect the images: 2 parts, apart from the largest: low.jpg, last.jpg; adjust the parts one "
        "by one"
    )


def test_adjust_refuses_what_the_check_refuses_unless_asked_not_to(plant):
    planted = _without_image(plant(), 2)

    with pytest.raises(UnadjustableError, match="apart from the largest: 2"):
        adjust(planted.seen_in(planted.truth))

    assert planted.adjusted(planted.truth, check=False).status == "converged"


def test_the_refusal_is_a_value_error():
    assert issubclass(UnadjustableError, ValueError)


def test_interfaces_of_two_index_ratios_are_refused(plant):
    planted = plant(interfaces=2)
    scene = changed(planted.truth, index_ratio=torch.tensor((1.33, 1.34), dtype=torch.float64))

    with pytest.raises(SceneError, match=r"index ratios \[1.33, 1.34\], but only one can be used here"):
        check_inputs(scene)


@pytest.mark.parametrize("name", ["view", "point", "observation"])
def test_a_scene_of_which_a_part_is_left_out_is_refused(plant, name):
    scene = plant().truth
    masks = {
        "view": scene.views.registered.clone(),
        "point": scene.placed.clone(),
        "observation": scene.accepted.clone(),
    }
    masks[name][1] = False
    views = replace(scene.views, registered=masks["view"])
    scene = replace(scene, views=views, placed=masks["point"], accepted=masks["observation"])

    with pytest.raises(UnadjustableError, match=f"not every {name} takes part; adjust `scene.part\\(\\).scene`"):
        check_inputs(scene)


def _named(planted, names):
    """The true scene as it is seen, with names of its views."""
    scene = planted.seen_in(planted.truth)
    return scene if names is None else replace(scene, views=replace(scene.views, names=names))


def _with_broken_pixels(planted, *rows):
    pixels = planted.observations.pixels.clone()
    pixels[list(rows), 1] = torch.nan
    return replace(planted, observations=replace(planted.observations, pixels=pixels))


def _without_image(planted, image):
    """What the other images see, of points that two of them see."""
    planted = planted.without(planted.observations.view == image)
    seen = planted.observations
    alone = torch.bincount(seen.point, minlength=30) < 2
    keep = (~alone).nonzero()[:, 0]
    new = torch.cumsum((~alone).long(), dim=0) - 1
    seen = seen[~alone[seen.point]]
    seen = replace(seen, point=new[seen.point])
    return replace(planted, truth=changed(planted.truth, points=planted.truth.points[keep]), observations=seen)
