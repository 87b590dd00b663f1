"""What of a scene takes part in a step, and how it goes back."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Capture, Interfaces, Observations, Scene


@pytest.fixture
def scene(make_basin, draw):
    """Four views of 30 points at the truth; the observations are off by `shift`."""
    basin = make_basin(cameras=4, points=30, seen_by=2)
    pixels, seen = basin.project()
    point, view = seen.T.nonzero(as_tuple=True)
    colors = torch.arange(90, dtype=torch.uint8).reshape(30, 3)
    return Scene.create(
        Rigid(basin.rotation, basin.center),
        basin.lens,
        Interfaces.level(basin.index_ratio),
        basin.points,
        Observations(view, point, pixels[view, point]),
        names=("a", "b", "c", "d"),
        colors=colors,
        length_unit="cm",
    )


@pytest.fixture
def growing(scene):
    """The third view is not registered, every fifth point not placed, every seventh observation set aside."""
    seen = scene.observations
    placed = torch.arange(30) % 5 != 0
    registered = torch.tensor([True, True, False, True])
    accepted = (torch.arange(len(seen)) % 7 != 0) & placed[seen.point] & registered[seen.view]
    return replace(scene, views=replace(scene.views, registered=registered), placed=placed, accepted=accepted)


def test_at_the_truth_all_errors_are_those_of_the_observations(scene, draw):
    shift = draw.normal(len(scene.observations), 2)
    seen = replace(scene.observations, pixels=scene.observations.pixels + shift)

    errors = replace(scene, observations=seen).errors()

    torch.testing.assert_close(errors, shift.norm(dim=-1), rtol=0.0, atol=1e-9)


def test_an_error_is_infinite_without_a_pose_without_a_point_and_behind_the_camera(scene):
    points, placed = scene.points.clone(), scene.placed.clone()
    points[0], placed[1] = points.new_tensor((0.0, 0.0, 500.0)), False
    views = replace(scene.views, registered=torch.tensor([True, True, False, True]))

    errors = replace(scene, points=points, placed=placed, views=views).errors()

    impossible = (scene.observations.view == 2) | (scene.observations.point <= 1)
    assert torch.equal(errors == torch.inf, impossible)


def capture_of(scene):
    names = scene.views.names
    return Capture(
        folder=Path(),
        names=names,
        paths=tuple(map(Path, names)),
        cameras=scene.cameras,
        interfaces=Interfaces.level(1.2),
        down_in_cam=torch.zeros(4, 3, dtype=torch.float64),
        down_sigma=torch.full((4,), 0.01, dtype=torch.float64),
        height=torch.zeros(4, dtype=torch.float64),
        has_height=torch.zeros(4, dtype=torch.bool),
        length_unit="cm",
    )


def test_of_a_capture_nothing_is_known_at_first(scene):
    capture = capture_of(scene)

    empty = Scene.of_capture(capture, scene.observations, scene.colors, 1.33)

    assert empty.views.num_registered == 0
    assert not empty.placed.any()
    assert not empty.accepted.any()
    assert (empty.errors() == torch.inf).all()
    assert empty.index_ratio == 1.33
    assert (empty.length_unit, empty.capture, empty.views.names) == ("cm", capture, scene.views.names)
    assert torch.equal(empty.views.rotation, torch.eye(3, dtype=torch.float64).repeat(4, 1, 1))
    empty.check()


def test_a_part_has_registered_views_and_points_with_accepted_observations(growing):
    part = growing.part()

    rows, seen = growing.accepted, growing.observations
    assert part.view.tolist() == [0, 1, 3]
    assert part.scene.views.names == ("a", "b", "d")
    assert torch.equal(part.point, seen.point[rows].unique())
    assert torch.equal(part.scene.points, growing.points[part.point])
    assert torch.equal(part.scene.colors, growing.colors[part.point])
    assert torch.equal(part.view[part.scene.observations.view], seen.view[rows])
    assert torch.equal(part.point[part.scene.observations.point], seen.point[rows])
    assert torch.equal(part.scene.observations.pixels, seen.pixels[rows])
    assert part.scene.accepted.all()
    assert part.scene.placed.all()
    assert part.scene.views.registered.all()
    part.scene.check()
    torch.testing.assert_close(part.scene.errors(), growing.errors()[rows])


def test_a_part_leaves_out_points_with_too_few_observations(growing):
    count = torch.bincount(growing.observations.point[growing.accepted], minlength=30)
    assert (count == 1).any()

    part = growing.part(min_observations=2)

    assert part.point.tolist() == (count >= 2).nonzero()[:, 0].tolist()
    assert len(part.scene.observations) == int(count[count >= 2].sum())


def test_a_part_of_some_points_has_the_views_that_observe_them(growing):
    of = torch.arange(30) == int(growing.observations.point[growing.accepted][0])

    part = growing.part(of=of)

    rows = growing.accepted & of[growing.observations.point]
    assert part.point.tolist() == of.nonzero()[:, 0].tolist()
    assert part.view.tolist() == growing.observations.view[rows].unique().tolist()
    assert torch.equal(part.view[part.scene.observations.view], growing.observations.view[rows])
    part.scene.check()


def test_points_that_views_see_and_those_that_they_support(growing):
    views, seen = torch.tensor((False, True, False, True)), growing.observations

    rows = views[seen.view]
    assert growing.seen_by(views).nonzero()[:, 0].tolist() == seen.point[rows].unique().tolist()
    assert growing.supported_by(views).nonzero()[:, 0].tolist() == seen.point[rows & growing.accepted].unique().tolist()


def test_accepted_observations_of_points_without_a_position_take_no_part(growing):
    part = replace(growing, placed=torch.arange(30) >= 10).part()

    assert int(part.point.min()) >= 10


def test_of_nothing_there_is_a_part_without_points(growing):
    part = replace(growing, accepted=torch.zeros_like(growing.accepted)).part()

    assert len(part.scene.points) == len(part.scene.observations) == len(part.point) == 0
    assert len(part.scene.views) == 3


def test_photographs_go_with_their_views(growing):
    scene = replace(growing, capture=capture_of(growing))

    for rest in (scene.part().scene, scene.of_views(scene.views.registered)):
        assert rest.capture.names == rest.views.names == ("a", "b", "d")


def test_a_part_goes_back_to_where_it_was_taken(growing, draw):
    part = growing.part()
    assert torch.equal(growing.with_part(part, part.scene).points, growing.points)
    views = part.scene.views
    changed = replace(
        part.scene,
        views=views.at(draw.rotations(3), draw.normal(3, 3)),
        points=part.scene.points + 1.0,
        interfaces=Interfaces.level(1.4),
    )

    back = growing.with_part(part, changed)

    assert torch.equal(back.views.center[part.view], changed.views.center)
    assert torch.equal(back.views.rotation[part.view], changed.views.rotation)
    assert torch.equal(back.views.center[2], growing.views.center[2])
    assert torch.equal(back.views.registered, growing.views.registered)
    stays = torch.ones(30, dtype=torch.bool).index_fill(0, part.point, False)
    assert torch.equal(back.points[part.point], changed.points)
    assert torch.equal(back.points[stays], growing.points[stays])
    assert back.index_ratio == 1.4
    for name in ("placed", "accepted", "observations", "colors"):
        assert getattr(back, name) is getattr(growing, name)


def test_support_counts_the_accepted_observations_of_every_view(growing):
    seen = growing.observations.view[growing.accepted].tolist()

    assert growing.support().tolist() == [seen.count(i) for i in range(4)]
    assert growing.support()[2] == 0


def test_a_trimmed_scene_has_all_views_and_what_is_accepted(growing):
    trimmed = growing.trimmed()

    seen, rows = growing.observations, growing.accepted
    ids = seen.point[rows].unique()
    assert torch.equal(trimmed.points, growing.points[ids])
    assert torch.equal(trimmed.colors, growing.colors[ids])
    assert torch.equal(ids[trimmed.observations.point], seen.point[rows])
    assert torch.equal(trimmed.observations.view, seen.view[rows])
    assert trimmed.placed.all()
    assert trimmed.accepted.all()
    assert trimmed.views is growing.views
    trimmed.check()
    torch.testing.assert_close(trimmed.errors(), growing.errors()[rows])


def test_views_that_go_take_their_photographs_and_judgements_with_them(growing):
    rest = growing.of_views(growing.views.registered)

    seen = growing.observations.view != 2
    assert rest.views.names == ("a", "b", "d")
    assert torch.equal(rest.accepted, growing.accepted[seen])
    assert torch.equal(rest.observations.pixels, growing.observations.pixels[seen])
    assert torch.equal(rest.placed, growing.placed)


def test_weights_stay_with_their_observations(growing):
    weight = torch.arange(float(len(growing.observations)), dtype=torch.float64)
    weighted = replace(growing, observations=replace(growing.observations, weight=weight))

    assert torch.equal(weighted.part().scene.observations.weights, weight[growing.accepted])
    assert torch.equal(weighted.trimmed().observations.weights, weight[growing.accepted])


def test_a_scene_made_at_once_has_everything_placed_and_white_points():
    seen = Observations(torch.tensor([0, 1]), torch.tensor([0, 0]), torch.zeros(2, 2, dtype=torch.float64))

    scene = Scene.create(
        Rigid.identity(2), Intrinsics.create(64, 48, 50.0), Interfaces.level(1.33), torch.zeros(1, 3).double(), seen
    )

    assert scene.views.names == ("0", "1")
    assert scene.views.registered.all()
    assert scene.placed.all()
    assert scene.accepted.all()
    assert scene.colors.tolist() == [[255, 255, 255]]
    assert (scene.length_unit, dict(scene.failures), scene.capture) == ("unit", {}, None)
