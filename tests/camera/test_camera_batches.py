"""Batches of cameras: indexing, shapes that do not fit, dtypes, and sizes beyond one block."""

from dataclasses import replace

import pytest
import torch

from tests.camera.camera_scenes import COUNT, for_every_interface, scene
from tests.tolerances import assert_same_pixels
from torchrefrac.camera import Intrinsics, ProjectionJacobians, RefractiveCamera
from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.numerics.blocks import BLOCK
from torchrefrac.refraction import FlatInterface

INDICES = {
    "a number": 2,
    "the last": -1,
    "a slice": slice(1, None),
    "none in front": None,
    "none behind": (..., None),
    "two behind": (..., None, None),
    "none between": (slice(None), None),
    "ellipsis": ...,
    "ellipsis and number": (..., 1),
    "number and ellipsis": (1, ...),
    "both numbers": (2, 1),
    "none and number": (None, 1),
    "numbers": torch.tensor([2, 0, 0]),
    "a list": [2, 0],
    "numbers behind": (slice(None), torch.tensor([1, 0])),
    "numbers behind an ellipsis": (..., torch.tensor([1, 0])),
    "a mask": torch.tensor([True, False, True]),
    "a mask of all": torch.tensor([[True, False], [False, True], [True, True]]),
    "a mask and an ellipsis": (torch.tensor([True, False, True]), ...),
    "a mask and none": (torch.tensor([True, False, True]), None),
    "a step and a number": (slice(None, None, 2), 0),
}
for_every_index = pytest.mark.parametrize("index", INDICES.values(), ids=INDICES.keys())
BATCHED = {
    "rotation and centre": ("rotation", "center"),
    "centre": ("center",),
    "rotation": ("rotation",),
    "lens": ("lens",),
    "index": ("index",),
    "plane": ("normal", "offset"),
    "offset": ("offset",),
    "everything": ("rotation", "center", "lens", "index", "normal", "offset"),
}
for_every_batched_part = pytest.mark.parametrize("batched", BATCHED.values(), ids=BATCHED.keys())


@for_every_index
@for_every_batched_part
def test_an_index_picks_cameras_whatever_part_of_them_is_batched(draw, lens, batched, index):
    cameras = _cameras(draw, lens, (3, 2), batched)
    point = torch.tensor([0.1, 0.2, -1.0], dtype=torch.float64)

    picked = cameras[index]

    expected, valid = cameras.project(point)
    assert cameras.shape == (3, 2)
    assert picked.shape == valid[index].shape
    pixels, visible = picked.project(point)
    assert_same_pixels(pixels, _picked(expected, index), slack=0.01)
    assert torch.equal(visible, valid[index])


@pytest.mark.parametrize("shapes", [((), (4,)), ((4,), ()), ((3, 1), (4,)), ((1, 4), (3, 1))])
def test_rotations_and_centres_of_different_batches_broadcast(draw, lens, shapes):
    rotation, center = draw.rotations(*shapes[0]), draw.normal(*shapes[1], 3).abs() + 0.1
    cameras = RefractiveCamera(lens, rotation, center, FlatInterface(1.333))

    picked = cameras[..., -1]

    batch = torch.broadcast_shapes(*shapes)
    assert cameras.shape == batch
    assert picked.shape == batch[:-1]
    point = torch.tensor([0.1, 0.2, -1.0], dtype=torch.float64)
    assert_same_pixels(picked.project(point)[0], cameras.project(point)[0][..., -1, :], slack=0.01)


def test_what_all_cameras_share_stays_shared_under_an_index(draw, lens):
    cameras = _cameras(draw, lens, (4,), ("center",))

    picked = cameras[1]

    assert picked.cam_from_world_rotation is cameras.cam_from_world_rotation
    assert picked.intrinsics.focal is lens.focal
    assert picked.interface.index_ratio == 1.333


def test_an_index_beyond_the_batch_is_refused(draw, lens):
    with pytest.raises(IndexError, match="out of bounds"):
        _cameras(draw, lens, (4,), ("center",))[4]


def test_a_batch_is_a_sequence_of_cameras(draw, lens):
    cameras = _cameras(draw, lens, (4,), ("rotation", "center"))

    assert [camera.shape for camera in cameras] == [()] * 4


def test_one_camera_alone_cannot_be_numbered(draw, lens):
    with pytest.raises(IndexError):
        _cameras(draw, lens, (), ())[0]


def test_parts_of_batches_that_do_not_fit_are_refused_with_their_shapes(draw, lens):
    with pytest.raises(
        ValueError,
        match=r"do not broadcast: cam_from_world_rotation \(3,\), center_in_world \(4,\), intrinsics \(\), interface",
    ):
        RefractiveCamera(lens, draw.rotations(3), draw.normal(4, 3), FlatInterface())


def test_an_interface_of_a_batch_that_does_not_fit_is_refused_with_its_shape(draw, lens):
    interface = FlatInterface(draw.uniform(1.1, 1.2, 5))

    with pytest.raises(ValueError, match=r"do not broadcast: .*center_in_world \(4,\).*interface \(5,\)"):
        RefractiveCamera(lens, draw.rotations(), draw.normal(4, 3).abs(), interface)


@pytest.mark.parametrize(
    "method",
    ["project", "project_with_jacobians", "apparent_points", "apparent_depth", "incidence_angle", "refraction_shift"],
)
def test_points_that_do_not_fit_are_refused_with_their_shape(draw, lens, method):
    cameras = _cameras(draw, lens, (4,), ("center",))

    with pytest.raises(ValueError, match=r"do not broadcast: points_in_world \(3,\), camera \(4,\)"):
        getattr(cameras, method)(draw.normal(3, 3))
    with pytest.raises(ValueError, match=r"points_in_world has shape \(4, 2\), but must end in \(3,\)"):
        getattr(cameras, method)(draw.normal(4, 2))
    with pytest.raises(ValueError, match=r"points_in_world has shape \(\), but must end in \(3,\)"):
        getattr(cameras, method)(draw.normal())


@pytest.mark.parametrize("method", ["cast_rays", "view_directions"])
def test_pixels_that_do_not_fit_are_refused_with_their_shape(draw, lens, method):
    cameras = _cameras(draw, lens, (4,), ("center", "rotation"))

    with pytest.raises(ValueError, match=r"do not broadcast: pixels \(3,\), camera \(4,\)"):
        getattr(cameras, method)(draw.normal(3, 2))
    with pytest.raises(ValueError, match=r"pixels has shape \(4, 3\), but must end in \(2,\)"):
        getattr(cameras, method)(draw.normal(4, 3))


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_half_precision_is_raised_to_single(draw, lens, half):
    single = _cameras(draw, lens, (), ()).to(dtype=torch.float32)
    points, pixels = draw.uniform(-1.0, 0.0, 9, 3).to(half), 512.0 * draw.uniform(0.0, 1.0, 9, 2).to(half)

    seen, rays = single.project(points), single.cast_rays(pixels)

    assert seen[0].dtype == rays[0].dtype == torch.float32
    for result, expected in zip(
        (*seen, *rays), (*single.project(points.float()), *single.cast_rays(pixels.float())), strict=True
    ):
        assert torch.equal(result, expected)
    pose = single.cam_from_world_rotation.to(half), single.center_in_world.to(half)
    assert RefractiveCamera(single.intrinsics, *pose, single.interface).project(points)[0].dtype == torch.float32


def test_a_camera_of_half_precision_keeps_the_lens_and_the_grid_of_single(draw, lens):
    camera = _cameras(draw, lens, (), ())

    half = camera.to(dtype=torch.bfloat16)

    assert half.intrinsics.pixel_grid()[-1, -1].tolist() == [999.5, 799.5]


@pytest.mark.parametrize("dtype", [torch.int64, torch.float32])
@pytest.mark.parametrize("method", ["project", "apparent_points", "project_with_jacobians"])
def test_points_of_another_dtype_are_seen_where_the_same_numbers_of_the_cameras_dtype_are(draw, lens, dtype, method):
    camera = _cameras(draw, lens, (), ())
    points = torch.tensor([[1, 1, -3], [0, -1, -2]], dtype=dtype)

    value = getattr(camera, method)(points)[0]

    assert value.dtype == torch.float64
    assert_same_pixels(value, getattr(camera, method)(points.double())[0])


@pytest.mark.parametrize("interface", [FlatInterface(), FlatInterface.flat_port(0.1, 0.01), FlatInterface(1.0)])
def test_intrinsics_from_plain_numbers_follow_the_dtype_of_the_pose(draw, interface):
    lens = Intrinsics.create(1000, 800, 900.0)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    camera = RefractiveCamera(lens, rotation, torch.tensor([0.1, 0.2, 1.0]), interface)
    points = draw.uniform(-0.3, 0.0, 5, 3).float()

    results = (*camera.project(points), *camera.cast_rays(camera.intrinsics.pixel_grid()), *camera.rays(4, 5))

    assert camera.intrinsics.focal.dtype == torch.float32
    assert {result.dtype for result in results} == {torch.float32, torch.bool}
    assert camera.project_with_jacobians(points)[1].focal.dtype == torch.float32
    assert camera.project(points.double())[0].dtype == torch.float64
    double = RefractiveCamera(lens.to(dtype=torch.float32), rotation.double(), camera.center_in_world, interface)
    assert double.intrinsics.focal.dtype == double.project(points)[0].dtype == torch.float64


@pytest.mark.parametrize(
    "wrong", [torch.eye(3) * 1.01, torch.diag(torch.tensor([1.0, 1.0, -1.0])), torch.zeros(3, 3)], ids=str
)
def test_a_rotation_that_is_none_is_refused(lens, wrong):
    center = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.stack((torch.eye(3), wrong))

    with pytest.raises(ValueError, match=r"^cam_from_world_rotation must be a rotation"):
        RefractiveCamera(lens, poses, center, FlatInterface())
    assert RefractiveCamera(lens, poses, center, FlatInterface(), check=False).shape == (2,)


def test_a_pose_of_whole_numbers_is_refused(lens):
    with pytest.raises(ValueError, match=r"^cam_from_world_rotation has dtype torch\.int64"):
        RefractiveCamera(lens, torch.eye(3, dtype=torch.int64), torch.zeros(3), FlatInterface(1.0))
    with pytest.raises(ValueError, match=r"^center_in_world has dtype torch\.int64"):
        RefractiveCamera(lens, torch.eye(3), torch.tensor([0, 0, 1]), FlatInterface())


@for_every_interface
def test_a_camera_of_another_dtype_sees_the_same_in_that_dtype(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")

    single = camera.to(dtype=torch.float32)

    assert single.shape == camera.shape
    assert single.center_in_world.dtype == single.intrinsics.focal.dtype == torch.float32
    pixels, valid = single.project(points.float())
    assert pixels.dtype == torch.float32
    assert torch.equal(valid, camera.project(points)[1])
    assert_same_pixels(pixels, camera.project(points)[0].float())
    jacobians = single.project_with_jacobians(points.float())[1]
    for block, expected in zip(jacobians, camera.project_with_jacobians(points)[1], strict=True):
        assert block.dtype == torch.float32
        size = torch.cat((expected.abs().flatten(), expected.new_ones(1))).amax()
        torch.testing.assert_close(block / size, (expected / size).float(), rtol=0.0, atol=1e-4)


def test_a_change_of_dtype_leaves_numbers_as_they_are(draw, lens):
    camera = _cameras(draw, lens, (4,), ("center",))

    back = camera.to(dtype=torch.float32).to(dtype=torch.float64)

    assert back.interface.index_ratio == 1.333
    assert back.center_in_world.dtype == torch.float64


@pytest.mark.parametrize("name", ["water", "glass wall", "looking out", "port", "no refraction"])
def test_a_batch_beyond_one_block_sees_what_its_parts_see(draw, lens, name):
    camera, points = scene(draw, lens, name, "ordinary")
    many = (points + 0.01 * draw.normal(BLOCK // COUNT + 500, COUNT, 3)).contiguous()
    assert BLOCK < many[..., 0].numel() < 2 * BLOCK

    results = _everything(camera, many)

    parts = [_everything(camera, part) for part in many.split(1000)]
    for i, result in enumerate(results):
        torch.testing.assert_close(result, torch.cat([part[i] for part in parts]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "shapes", [((3, 1), (12000,)), ((1, 3), (12000, 1)), ((40000, 1), (1,)), ((2, 1), (3, 1, 9000))]
)
def test_a_grid_beyond_one_block_sees_what_its_rows_see(draw, lens, shapes):
    cameras = _cameras(draw, lens, shapes[0], ("rotation", "center", "lens"))
    points = draw.uniform(-1.0, 0.0, *shapes[1], 3)
    pixels, valid = cameras.project(points)
    batch = torch.broadcast_shapes(*shapes)

    one = tuple(size // 2 for size in batch)

    assert pixels.shape == (*batch, 2)
    spread = _spread(cameras, batch)
    alone, visible = spread[one].project(points.expand(*batch, 3)[one])
    assert_same_pixels(pixels[one], alone, slack=0.1)
    assert torch.equal(valid[one], visible)
    last = tuple(size - 1 for size in batch)
    assert_same_pixels(pixels[last], spread[last].project(points.expand(*batch, 3)[last])[0], slack=0.1)
    rays = cameras.cast_rays(pixels.clamp(0.0, 800.0))
    assert rays[0].shape == (*batch, 3)
    for ray, expected in zip(rays, spread[last].cast_rays(pixels[last].clamp(0.0, 800.0)), strict=True):
        torch.testing.assert_close(ray[last], expected, rtol=0.0, atol=1e-12)


def test_a_grid_beyond_one_block_has_the_jacobians_of_its_rows(draw, lens):
    cameras = _cameras(draw, lens, (5, 1), ("rotation", "center", "index", "offset"))
    points = draw.uniform(-1.0, -0.5, 5000, 3)

    _, blocks, valid = cameras.project_with_jacobians(points)

    assert valid.shape == (5, 5000)
    _, alone, _ = cameras[4].project_with_jacobians(points[-3:])
    for name, block, expected in zip(ProjectionJacobians._fields, blocks, alone, strict=True):
        assert block.shape[:2] == (5, 5000), name
        torch.testing.assert_close(block[4, -3:], expected, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("count", [3, 40000])
def test_gradients_of_many_points_are_those_of_few(draw, lens, count):
    camera = _cameras(draw, lens, (), ())
    points = draw.uniform(-1.0, -0.5, count, 3).requires_grad_()

    camera.project(points)[0].sum().backward()

    expected = camera.project_with_jacobians(points.detach())[1].point.sum(dim=-2)
    torch.testing.assert_close(points.grad, expected, rtol=1e-9, atol=1e-9)


def _cameras(draw, lens, shape, batched):
    """Cameras above a nearly level plane; `batched` names what is (*shape), the rest is shared by all of them."""

    def batch(name):
        return shape if name in batched else ()

    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    wobble = so3_exp(0.2 * draw.normal(*batch("rotation"), 3))
    center = torch.cat((draw.normal(*batch("center"), 2), draw.uniform(2.0, 3.0, *batch("center"), 1)), dim=-1)
    focal = lens.focal + draw.uniform(0.0, 50.0, *batch("lens"), 2) if "lens" in batched else lens.focal
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    normal = up + 0.1 * draw.normal(*batch("normal"), 3) if "normal" in batched else (0.0, 0.0, 1.0)
    offset = draw.uniform(-0.1, 0.1, *shape) if "offset" in batched else 0.0
    index = draw.uniform(1.2, 1.5, *shape) if "index" in batched else 1.333
    interface = FlatInterface(index, plane=Plane(normal, offset))
    return RefractiveCamera(replace(lens, focal=focal), wobble @ down, center, interface)


def _spread(cameras, batch):
    """The same cameras, each written out."""
    return replace(
        cameras,
        intrinsics=replace(cameras.intrinsics, focal=cameras.intrinsics.focal.expand(*batch, 2)),
        cam_from_world_rotation=cameras.cam_from_world_rotation.expand(*batch, 3, 3),
        center_in_world=cameras.center_in_world.expand(*batch, 3),
    )


def _picked(values, index):
    """Values (*batch, 2) at an index of the batch alone."""
    batch = values.shape[:-1]
    return values.flatten(0, -2)[torch.arange(batch.numel()).reshape(batch)[index]]


def _everything(camera, points):
    pixels, jacobians, valid = camera.project_with_jacobians(points)
    again, visible = camera.project(points)
    origins, directions, met = camera.cast_rays(pixels)
    apparent, _ = camera.apparent_points(points)
    return [pixels, valid, again, visible, origins, directions, met, apparent, *jacobians]
