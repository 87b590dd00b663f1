"""Cameras, interfaces and views as tables: each view sees as a camera of its own that is made by hand."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import Plane, Rigid, so3_exp
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Cameras, Interfaces, Observations, Scene, SceneError, Views

KINDS = [
    Intrinsics.create(1024, 768, 667.0, distortion=(-0.05, 0.02, 1e-3, -2e-3, 0.0)),
    Intrinsics.create(640, 480, (500.0, 501.0), (321.5, 239.25)),
    Intrinsics.create(800, 600, (700.0, 699.0), (400.5, 301.0), (0.1, -0.02, 1e-3, -2e-3, 0.003)),
]
tables = pytest.mark.parametrize(("g", "e"), [(1, 1), (3, 1), (1, 3), (3, 3)])


@pytest.fixture
def make(draw):
    """`make(g, e, level=False)`: seven views over 40 points with g cameras behind e interfaces, and the surfaces as
    they are made by hand."""

    def scene(g, e, level=False):
        m = 7
        rotation = so3_exp(0.1 * draw.normal(m, 3)) @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        center = torch.cat((draw.uniform(-5.0, 5.0, m, 2), draw.uniform(30.0, 40.0, m, 1)), dim=-1)
        tilt = torch.zeros(e, 2) if level else 0.05 * draw.normal(e, 2)
        normal = torch.nn.functional.normalize(torch.cat((tilt.double(), torch.ones(e, 1).double()), dim=-1), dim=-1)
        offset = torch.zeros(e).double() if level else draw.uniform(-2.0, 2.0, e)
        ratio = draw.uniform(1.2, 1.5, e)
        points = torch.cat((draw.uniform(-10.0, 10.0, 40, 2), draw.uniform(-30.0, -10.0, 40, 1)), dim=-1)
        view, point = torch.arange(m).repeat(40), torch.arange(40).repeat_interleave(m)
        return Scene.create(
            Rigid(rotation, center),
            KINDS[:g],
            Interfaces(normal, offset, ratio),
            points,
            Observations(view, point, draw.uniform(0.0, 480.0, 40 * m, 2)),
            camera=torch.tensor([0, 1, 2, 2, 0, 1, 0]) % g,
            interface=torch.tensor([0, 0, 1, 2, 2, 1, 0]) % e,
        )

    return scene


def by_hand(scene, view):
    """The camera of one view, from plain numbers."""
    camera, interface = int(scene.views.camera[view]), int(scene.views.interface[view])
    table = scene.interfaces
    return RefractiveCamera(
        KINDS[camera],
        scene.views.rotation[view],
        scene.views.center[view],
        FlatInterface(table.index_ratio[interface], plane=Plane(table.normal[interface], table.offset[interface])),
    )


@tables
def test_every_view_projects_through_its_own_camera_and_interface(make, g, e):
    scene = make(g, e)

    together, possible = scene.camera_of()[:, None].project(scene.points)

    for view in range(7):
        expected, valid = by_hand(scene, view).project(scene.points)
        one, same = scene.camera_of(view).project(scene.points)
        assert valid.all()
        assert torch.equal(possible[view], valid)
        assert torch.equal(same, valid)
        torch.testing.assert_close(together[view], expected, rtol=0.0, atol=1e-9)
        torch.testing.assert_close(one, expected, rtol=0.0, atol=1e-9)


@tables
def test_every_view_casts_rays_through_its_own_camera_and_interface(make, draw, g, e):
    scene, pixels = make(g, e), draw.uniform(100.0, 400.0, 5, 2)

    origins, directions, _ = scene.camera_of()[:, None].cast_rays(pixels)

    for view in range(7):
        origin, direction, valid = by_hand(scene, view).cast_rays(pixels)
        assert valid.all()
        torch.testing.assert_close(origins[view], origin, rtol=0.0, atol=1e-9)
        torch.testing.assert_close(directions[view], direction, rtol=0.0, atol=1e-12)


@tables
def test_views_are_taken_in_any_shape_and_order(make, g, e):
    scene = make(g, e)
    view = torch.tensor([[6, 2, 2], [0, 3, 5]])

    found, _ = scene.camera_of(view).project(scene.points[7])

    assert found.shape == (2, 3, 2)
    for i, j in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)):
        expected, _ = by_hand(scene, int(view[i, j])).project(scene.points[7])
        torch.testing.assert_close(found[i, j], expected, rtol=0.0, atol=1e-9)


@tables
def test_errors_are_those_of_each_observation_in_its_own_camera(make, g, e):
    scene = make(g, e)
    seen = scene.observations

    errors = scene.errors()

    for row in range(0, len(seen), 13):
        projected, _ = by_hand(scene, int(seen.view[row])).project(scene.points[seen.point[row]])
        torch.testing.assert_close(errors[row], (projected - seen.pixels[row]).norm(), rtol=0.0, atol=1e-9)


def test_a_level_surface_at_zero_is_known_as_one(make):
    assert make(1, 1, level=True).interfaces.is_level
    assert Interfaces.level(1.33).is_level
    assert not Interfaces.level(1.33, 0.5).is_level
    assert not make(1, 1).interfaces.is_level
    assert not make(1, 3, level=True).interfaces.is_level
    scene = make(3, 1, level=True)
    found, _ = scene.camera_of(4).project(scene.points)
    torch.testing.assert_close(found, by_hand(scene, 4).project(scene.points)[0], rtol=0.0, atol=1e-9)


def test_interfaces_refract_where_any_of_them_does():
    air = Interfaces.level(1.0)

    assert not air.refract()
    assert Interfaces.level(1.001).refract()
    assert replace(make_two(), index_ratio=torch.tensor([1.0, 1.33]).double()).refract()


def make_two():
    one = Interfaces.level(1.33)
    return Interfaces(one.normal.repeat(2, 1), torch.tensor([0.0, 3.0]).double(), one.index_ratio.repeat(2))


def test_cameras_are_the_intrinsics_they_were_made_of():
    cameras = Cameras.of(KINDS)

    assert len(cameras) == 3
    for i, wanted in enumerate(KINDS):
        assert (cameras[i].width, cameras[i].height) == cameras.sizes[i] == (wanted.width, wanted.height)
        for name in ("focal", "principal_point", "distortion"):
            assert torch.equal(getattr(cameras[i], name), getattr(wanted, name))


def test_intrinsics_of_views_are_a_batch_where_there_are_several_and_shared_where_there_is_one():
    view = torch.tensor([[2, 0], [1, 1]])

    several, one = Cameras.of(KINDS).of_views(view), Cameras.of(KINDS[:1]).of_views(torch.zeros(2, 2).long())

    assert several.shape == (2, 2)
    assert torch.equal(several.focal[0, 0], KINDS[2].focal)
    assert torch.equal(several.principal_point[1, 0], KINDS[1].principal_point)
    assert one.shape == ()
    assert torch.equal(one.distortion, KINDS[0].distortion)


def test_the_only_camera_and_index_ratio_are_refused_where_there_are_several(make):
    assert torch.equal(make(1, 1).intrinsics.focal, KINDS[0].focal)
    with pytest.raises(SceneError, match="the scene has 3 cameras, but only one can be used here"):
        _ = make(3, 1).intrinsics
    with pytest.raises(SceneError, match=r"the interfaces have index ratios .*, but only one can be used here"):
        _ = make(1, 3).index_ratio
    same = make(1, 3)
    ratio = torch.full_like(same.interfaces.index_ratio, 1.4)
    assert replace(same, interfaces=replace(same.interfaces, index_ratio=ratio)).index_ratio == 1.4


@pytest.mark.parametrize("table", ["cameras", "interfaces", "observations"])
def test_tables_without_a_graph_have_the_same_values(make, table):
    given = getattr(make(3, 3), table)
    names = {"cameras": "focal", "interfaces": "offset", "observations": "pixels"}
    name = names[table]
    learnable = replace(given, **{name: getattr(given, name).clone().requires_grad_()})

    detached = learnable.detached()

    assert not getattr(detached, name).requires_grad
    for key, value in vars(given).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(getattr(detached, key), value)


def test_views_are_registered_where_they_are_posed(draw):
    views = Views.posed(Rigid(draw.rotations(3), draw.normal(3, 3)))

    assert (len(views), views.names, views.num_registered) == (3, ("0", "1", "2"), 3)
    assert views.camera.tolist() == views.interface.tolist() == [0, 0, 0]


def test_some_views_get_poses_and_the_others_stay(draw):
    views = replace(Views.posed(Rigid(draw.rotations(4), draw.normal(4, 3))), registered=torch.zeros(4).bool())
    rotation, center = draw.rotations(2), draw.normal(2, 3)

    moved = views.at(rotation, center, torch.tensor([3, 1]))

    assert moved.registered.tolist() == [False, True, False, True]
    assert torch.equal(moved.rotation[[3, 1]], rotation)
    assert torch.equal(moved.center[[3, 1]], center)
    assert torch.equal(moved.rotation[[0, 2]], views.rotation[[0, 2]])
    assert views.num_registered == 0
    assert views.at(views.rotation, views.center).num_registered == 4


def test_views_are_taken_by_their_numbers(make):
    views = make(3, 3).views

    some = views[torch.tensor([5, 2])]

    assert some.names == ("5", "2")
    assert torch.equal(some.center, views.center[[5, 2]])
    assert some.camera.tolist() == [1, 2]
    assert some.interface.tolist() == [1, 1]


def test_observations_are_taken_by_a_mask_or_numbers_with_their_weights(make):
    seen = make(1, 1).observations
    assert torch.equal(seen.weights, torch.ones(280, dtype=torch.float64))
    weighted = replace(seen, weight=torch.arange(280.0, dtype=torch.float64))

    for rows in (torch.tensor([9, 4]), torch.arange(280) % 3 == 0, slice(0, 5)):
        some = weighted[rows]
        assert torch.equal(some.weights, weighted.weights[rows])
        assert torch.equal(some.view, seen.view[rows])
        assert torch.equal(some.pixels, seen.pixels[rows])
