"""Scenes: their consistency, and what is left of them when views or observations go."""

from dataclasses import replace

import pytest
import torch

from tests.files.two_cameras import PLAIN, assert_same, two_camera_scene
from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Cameras, Interfaces, Observations, Scene, SceneError


@pytest.fixture
def scene(draw):
    return two_camera_scene(draw)


def small(view, point, points=3, views=3):
    """A scene with these observations; the first coordinate of a pixel is the number of its row."""
    pixels = torch.arange(float(len(view)), dtype=torch.float64)[:, None].repeat(1, 2)
    return Scene.create(
        Rigid.identity(views),
        Intrinsics.create(64, 48, 50.0),
        Interfaces.level(1.0),
        torch.arange(3.0 * points, dtype=torch.float64).reshape(points, 3),
        Observations(torch.tensor(view), torch.tensor(point), pixels),
        names=tuple("abcdef"[:views]),
        colors=torch.arange(3 * points, dtype=torch.uint8).reshape(points, 3),
    )


def test_cleaning_leaves_the_first_of_repeated_observations():
    cleaned = small(view=[2, 0, 2, 0, 1], point=[0, 0, 0, 0, 0], points=1).cleaned()

    assert cleaned.observations.view.tolist() == [2, 0, 1]
    assert cleaned.observations.pixels[:, 0].tolist() == [0, 1, 4]


def test_cleaning_drops_points_that_one_view_sees_and_renumbers_the_others():
    cleaned = small(view=[0, 1, 2, 2, 1, 0], point=[0, 0, 1, 1, 2, 2]).cleaned()

    assert cleaned.points[:, 0].tolist() == [0, 6]
    assert cleaned.colors[:, 0].tolist() == [0, 6]
    assert cleaned.observations.point.tolist() == [0, 0, 1, 1]
    assert cleaned.observations.pixels[:, 0].tolist() == [0, 1, 4, 5]


def test_cleaning_leaves_a_clean_scene_as_it_is(scene):
    assert_same(scene.cleaned(), scene)


def test_cleaning_drops_points_without_observations():
    assert len(small(view=[0, 1], point=[1, 1]).cleaned().points) == 1


def test_views_that_go_take_their_observations_with_them():
    rest = small(view=[0, 1, 2, 1, 2], point=[0, 0, 0, 1, 1]).of_views(torch.tensor([True, False, True]))

    assert rest.views.names == ("a", "c")
    assert rest.observations.view.tolist() == [0, 1, 1]
    assert rest.observations.point.tolist() == [0, 0, 1]
    assert rest.observations.pixels[:, 0].tolist() == [0, 2, 4]


def test_a_scene_has_registered_views_and_the_points_they_share(draw):
    colors = torch.tensor([[1, 2, 3], [4, 5, 6]], dtype=torch.uint8)
    given = Scene.create(
        Rigid(draw.rotations(3), draw.normal(3, 3)),
        Intrinsics.create(64, 48, 50.0),
        Interfaces.level(1.333),
        draw.normal(2, 3),
        Observations(torch.tensor([0, 1, 0, 2]), torch.tensor([0, 0, 1, 1]), draw.normal(4, 2)),
        names=("a", "b", "c"),
        colors=colors,
        length_unit="cm",
    )
    registered = torch.tensor([True, False, True])

    scene = replace(given, views=replace(given.views, registered=registered)).of_views(registered).cleaned()

    assert (scene.views.names, scene.length_unit) == (("a", "c"), "cm")
    assert torch.equal(scene.views.rotation, given.views.rotation[[0, 2]])
    assert torch.equal(scene.views.center, given.views.center[[0, 2]])
    assert torch.equal(scene.points, given.points[1:])
    assert scene.colors.tolist() == [[4, 5, 6]]
    assert (scene.observations.view.tolist(), scene.observations.point.tolist()) == ([0, 1], [0, 0])
    assert torch.equal(scene.observations.pixels, given.observations.pixels[2:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": torch.tensor([0, 1, 2, 0, 0])}, "camera runs from 0 to 2, but must lie in 0 to 1"),
        ({"camera": torch.tensor([0, -1, 0, 0, 0])}, "camera runs from -1 to 0, but must lie in 0 to 1"),
        ({"camera": torch.zeros(5, dtype=torch.int32)}, "camera has dtype torch.int32, but must be torch.long"),
        ({"interface": torch.tensor([0, 0, 1, 0, 0])}, "interface runs from 0 to 1, but must lie in 0 to 0"),
        ({"points": torch.zeros(3, 3, dtype=torch.float64)}, "point runs from 0 to 39, but must lie in 0 to 2"),
        ({"names": ("a", "b")}, r"camera has shape \(5,\), but must have \(2,\) with 2 views"),
    ],
)
def test_an_inconsistent_scene_is_refused(scene, change, message):
    given = {"names": scene.views.names, "camera": scene.views.camera} | change
    points = given.pop("points", scene.points)

    with pytest.raises(SceneError, match=message):
        Scene.create(
            scene.views.pose,
            [scene.cameras[0], scene.cameras[1]],
            scene.interfaces,
            points,
            scene.observations,
            **given,
        )


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("colors", torch.zeros(1, 3), r"colors has shape \(1, 3\), but must have \(40, 3\)"),
        ("pixels", torch.zeros(3, 2), r"pixels has shape \(3, 2\), but must have \(\d+, 2\) with .* observations"),
    ],
)
def test_tables_of_different_lengths_are_refused(scene, name, value, message):
    object.__setattr__(scene if name == "colors" else scene.observations, name, value)  # past the checks in tests

    with pytest.raises(SceneError, match=message):
        scene.check()


def test_batched_intrinsics_are_refused():
    batched = Intrinsics(9, 9, torch.ones(2, 2), torch.ones(2), torch.zeros(5))

    with pytest.raises(ValueError, match=r"intrinsics\[1\] has batch shape \(2,\)"):
        Cameras.of((PLAIN, batched))


def test_observations_out_of_order_are_refused():
    with pytest.raises(SceneError, match="point does not ascend"):
        small(view=[0, 1, 0, 1], point=[1, 1, 0, 0])


@pytest.mark.parametrize(
    ("normal", "offset", "ratio", "message"),
    [
        (torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), "at least one interface"),
        (torch.ones(1, 3), torch.zeros(1), torch.full((1,), 1.333), "unit vectors"),
        (torch.full((1, 3), torch.nan), torch.zeros(1), torch.full((1,), 1.333), "unit vectors"),
        (torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([torch.inf]), torch.full((1,), 1.333), "finite"),
        (torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1), torch.full((1,), 0.75), "index_ratio is 0.75, but n_water"),
        (torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1), torch.full((1,), torch.nan), "index_ratio is nan, but n_wat"),
    ],
)
def test_interfaces_that_are_none_are_refused(normal, offset, ratio, message):
    with pytest.raises(SceneError, match=message):
        replace(small(view=[0, 1], point=[0, 0]), interfaces=Interfaces(normal, offset, ratio)).check()
