"""A camera whose water and poses are learnt: what moves, by which derivatives, and where it ends."""

import math
from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import COUNT, for_every_interface, scene
from tests.tolerances import EXACT, assert_matches, assert_same_pixels
from torchrefrac.camera import Intrinsics, LearnableCamera, RefractiveCamera
from torchrefrac.camera.learnable import LEARNABLE
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FlatInterface

OF_LAYERS = ("layer_index", "layer_thickness")
OF_TWO_MEDIA = tuple(name for name in LEARNABLE if name not in OF_LAYERS)


@for_every_interface
@pytest.mark.parametrize("place", ["ordinary", "land"])
def test_untrained_it_projects_as_the_camera_it_was_made_from(draw, lens, name, place):
    camera, points = scene(draw, lens, name, place)

    pixels, valid = LearnableCamera(camera, learn=_there(camera))(points)

    expected, expected_valid = camera.project(points)
    assert torch.equal(valid, expected_valid)
    assert_same_pixels(pixels, expected)


def test_what_it_learns_by_default_is_the_index_ratio_and_the_height(make_camera):
    assert _trained(LearnableCamera(make_camera())) == {"index_ratio", "plane_height"}


@pytest.mark.parametrize("learn", [(), *((name,) for name in OF_TWO_MEDIA), ["rotation", "center"], OF_TWO_MEDIA])
def test_only_what_is_to_be_learnt_requires_a_gradient(make_camera, learn):
    assert _trained(LearnableCamera(make_camera(3), learn)) == set(learn)


@pytest.mark.parametrize("learn", [*((name,) for name in OF_TWO_MEDIA), OF_TWO_MEDIA])
def test_a_step_of_an_optimiser_moves_what_is_to_be_learnt_and_nothing_else(make_camera, points_seen, learn):
    camera = make_camera(COUNT)
    points, model = points_seen(camera, COUNT), LearnableCamera(camera, learn)
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=1e-3)

    (model(points)[0] - camera.project(points)[0] + 1.0).square().sum().backward()
    optimizer.step()

    assert {name for name, value in model.named_parameters() if bool((value != 0.0).any())} == set(learn)


def test_the_parameters_are_tilt_and_height_of_the_plane_and_moves_of_the_pose(draw, make_camera, points_seen):
    camera = make_camera(COUNT)
    tilt, height = draw.uniform(-0.1, 0.1, 2), draw.uniform(-0.1, 0.1)
    turn, shift = draw.uniform(-0.1, 0.1, COUNT, 3), draw.uniform(-0.1, 0.1, COUNT, 3)
    model, points = LearnableCamera(camera), points_seen(camera, COUNT)

    _set(model, index_ratio=math.log(1.1), plane_tilt=tilt, plane_height=height, rotation=turn, center=shift)

    moved = RefractiveCamera(
        camera.intrinsics,
        torch.linalg.matrix_exp(_cross_matrices(turn)) @ camera.cam_from_world_rotation,
        camera.center_in_world + shift,
        FlatInterface(1.0 + 1.1 * 0.333, plane=Plane().moved(tilt, height)),
    )
    assert_same_pixels(model(points)[0], moved.project(points)[0])


@pytest.mark.parametrize("value", [-30.0, -3.0, 3.0, 30.0])
def test_the_index_ratio_stays_above_one(make_camera, value):
    model = LearnableCamera(make_camera())

    _set(model, index_ratio=value)

    assert float(model.camera.interface.index_like(model.center).detach()) > 1.0


def test_an_index_ratio_driven_to_one_leaves_straight_rays(make_camera, points_seen):
    camera = make_camera(COUNT)
    model, points = LearnableCamera(camera), points_seen(camera, COUNT)

    _set(model, index_ratio=-1e6)

    assert_same_pixels(model(points)[0], camera.as_pinhole().project(points)[0])


@for_every_interface
def test_the_gradient_of_every_parameter_is_right(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    assert _gradient_is_right(LearnableCamera(camera, _there(camera)), points, draw)


def test_a_gradient_reaches_every_parameter(make_camera, points_seen):
    camera = make_camera(COUNT)
    points, model = points_seen(camera, COUNT), LearnableCamera(camera, OF_TWO_MEDIA)

    model(points)[0].square().sum().backward()

    assert all(bool((getattr(model, name).grad != 0.0).all()) for name in OF_TWO_MEDIA)


def test_tilt_height_and_index_ratio_are_learnt_from_exact_pixels(make_camera, points_seen, lens):
    guess = make_camera(4, index_ratio=1.25)[:, None]
    points, truth = points_seen(guess, 4, 40), LearnableCamera(guess)
    _set(truth, index_ratio=math.log(0.333 / 0.25), plane_tilt=torch.tensor([0.03, -0.02]), plane_height=0.15)
    pixels = truth(points)[0].detach()
    inside = lens.contains(pixels)
    model = LearnableCamera(guess, learn=("index_ratio", "plane_tilt", "plane_height"))

    _minimize(model, lambda: ((model(points)[0] - pixels)[inside] / 1000.0).square().sum())

    assert inside.sum() > 100
    for name in LEARNABLE:
        torch.testing.assert_close(getattr(model, name), getattr(truth, name), rtol=0.0, atol=1e-8)


def test_a_water_level_learnt_above_the_camera_is_masked_and_does_not_raise(make_camera, points_seen):
    camera = make_camera(COUNT)
    model, points = LearnableCamera(camera), points_seen(camera, COUNT)
    _set(model, plane_height=10.0)

    pixels, valid = model(points)

    assert not valid.any()
    assert pixels.isfinite().all()


def test_a_saved_state_restores_what_was_learnt(draw, make_camera, points_seen):
    camera = make_camera(COUNT)
    points, trained, fresh = points_seen(camera, COUNT), LearnableCamera(camera), LearnableCamera(camera)
    _set(trained, **{name: 0.1 * draw.normal(*value.shape) for name, value in trained.named_parameters()})

    fresh.load_state_dict(trained.state_dict())

    assert set(trained.state_dict()) == set(LEARNABLE)
    assert torch.equal(fresh(points)[0], trained(points)[0])


@for_every_interface
def test_in_single_precision_it_is_the_same_camera(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    model = LearnableCamera(camera, learn=_there(camera)).to(torch.float32)

    pixels, _ = model(points.float())
    assert pixels.dtype == model.camera.center_in_world.dtype == torch.float32
    assert_same_pixels(pixels, camera.project(points)[0].float(), slack=10.0)


def test_learning_leaves_the_camera_it_started_from_as_it_was(make_camera, points_seen):
    camera = make_camera(COUNT)
    model, points = LearnableCamera(camera, OF_TWO_MEDIA), points_seen(camera, COUNT)
    before = camera.project(points)[0]

    _set(model, index_ratio=0.3, plane_height=0.2, center=torch.ones(COUNT, 3))

    assert torch.equal(camera.project(points)[0], before)
    assert_matches(model.camera.center_in_world, camera.center_in_world + 1.0)


def test_a_name_that_is_not_known_is_refused(make_camera):
    with pytest.raises(ValueError, match="learn names depth, fov, but must be some of index_ratio, layer_index"):
        LearnableCamera(make_camera(), learn=("fov", "index_ratio", "depth"))


def test_the_parameters_of_the_lens_are_changes_of_its_numbers(draw, make_camera, points_seen):
    camera = make_camera(COUNT)
    model, points = LearnableCamera(camera), points_seen(camera, COUNT)
    bend = 0.01 * draw.normal(5)

    _set(model, focal=math.log(1.02), principal_point=torch.tensor([3.0, -2.0]), distortion=bend)

    given = camera.intrinsics
    other = Intrinsics.create(
        given.width,
        given.height,
        (1.02 * given.focal).tolist(),
        (given.principal_point + torch.tensor([3.0, -2.0])).tolist(),
        (given.distortion + bend).tolist(),
    )
    expected = RefractiveCamera(other, camera.cam_from_world_rotation, camera.center_in_world, camera.interface)
    assert_same_pixels(model(points)[0], expected.project(points)[0])


def test_the_parameters_of_layers_are_those_of_glass(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "ordinary")
    model = LearnableCamera(camera)

    _set(model, index_ratio=0.1, layer_index=[0.05], layer_thickness=[-0.3])

    (first, glass, water), (thickness,) = camera.interface.indices, camera.interface.thickness
    changed = 1.0 + (glass - 1.0) * math.exp(0.05), first * (1.0 + (water / first - 1.0) * math.exp(0.1))
    other = FlatInterface(
        layers=(first, *changed), thickness=(thickness * math.exp(-0.3),), plane=camera.interface.plane,
        moves_with_camera=camera.interface.moves_with_camera,
    )  # fmt: skip
    expected = RefractiveCamera(camera.intrinsics, camera.cam_from_world_rotation, camera.center_in_world, other)
    assert_same_pixels(model(points)[0], expected.project(points)[0])


def test_a_focal_length_and_glass_are_learnt_from_exact_pixels(draw, lens):
    camera, points = scene(draw, lens, "glass wall", "ordinary")
    names = ("focal", "layer_thickness", "principal_point")
    truth, model = LearnableCamera(camera), LearnableCamera(camera, names)
    _set(truth, focal=0.01, layer_thickness=[0.2], principal_point=torch.tensor([2.0, 1.0]))
    pixels = truth(points)[0].detach()

    _minimize(model, lambda: ((model(points)[0] - pixels) / 1000.0).square().sum())

    for name in ("focal", "layer_thickness"):
        torch.testing.assert_close(getattr(model, name), getattr(truth, name), rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("name", OF_LAYERS)
def test_layers_that_are_not_there_cannot_be_learnt(make_camera, name):
    with pytest.raises(ValueError, match="interface has no layer between its first medium and its last"):
        LearnableCamera(make_camera(), learn=(name,))


def test_distortion_that_is_not_there_cannot_be_learnt(make_camera):
    camera = make_camera()
    plain = replace(camera, intrinsics=Intrinsics.create(640, 480, 500.0, distortion=()))
    without = replace(plain, intrinsics=replace(plain.intrinsics, distortion=torch.zeros(0).double()))

    with pytest.raises(ValueError, match="intrinsics have no coefficients of distortion"):
        LearnableCamera(without, learn=("distortion",))


@pytest.mark.parametrize("index_ratio", [1.0, torch.tensor([1.3, 1.0])])
def test_an_index_ratio_of_one_cannot_be_learnt(make_camera, index_ratio):
    camera = make_camera(2, index_ratio=index_ratio)

    with pytest.raises(ValueError, match="index_ratio is 1 or less, but must be above 1 to be learnt"):
        LearnableCamera(camera)


def _there(camera):
    """What there is to learn of a camera."""
    missing = set() if camera.interface.thickness else set(OF_LAYERS)
    if not bool((torch.as_tensor(camera.interface.index_ratio) > 1.0).all()):
        missing.add("index_ratio")
    if not all(bool((torch.as_tensor(index) > 1.0).all()) for index in camera.interface.indices[1:-1]):
        missing.add("layer_index")
    return tuple(name for name in LEARNABLE if name not in missing)


def _trained(model):
    return {name for name, value in model.named_parameters() if value.requires_grad}


def _set(model, **values):
    with torch.no_grad():
        for name, value in values.items():
            parameter = getattr(model, name)
            parameter.copy_(torch.as_tensor(value, dtype=parameter.dtype))


def _gradient_is_right(model, points, draw):
    """Whether autograd agrees with finite differences, at the start and a little off it."""
    learnt = {name: value for name, value in model.named_parameters() if value.requires_grad}

    def project(*values):
        return torch.func.functional_call(model, dict(zip(learnt, values, strict=True)), (points,))[0]

    return all(
        torch.autograd.gradcheck(
            project,
            [(size * draw.normal(*value.shape)).requires_grad_() for value in learnt.values()],
            rtol=1e-4,
            atol=1e-4,
        )
        for size in (0.0, 0.01)
    )


def _minimize(model, loss):
    optimizer = torch.optim.LBFGS(
        [value for value in model.parameters() if value.requires_grad],
        max_iter=200,
        tolerance_grad=EXACT.rounding,
        tolerance_change=EXACT.rounding**2,
        line_search_fn="strong_wolfe",
    )

    def closure():
        optimizer.zero_grad()
        value = loss()
        value.backward()
        return value

    optimizer.step(closure)


def _cross_matrices(omega):
    """Matrices (*B, 3, 3) whose product with a vector is the cross product of `omega` (*B, 3) and that vector."""
    axes = torch.eye(3, dtype=omega.dtype).expand(*omega.shape, 3)
    return torch.linalg.cross(omega[..., None, :].expand_as(axes), axes).mT
