"""Whole images without their refraction: against pictures of a textured plane traced ray by ray in NumPy."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_erosion

from tests.tolerances import EXACT, assert_matches
from torchrefrac.camera import Intrinsics, RefractiveCamera, remove_refraction
from torchrefrac.geometry import Plane, so3_exp
from torchrefrac.refraction import FlatInterface

WIDTH, HEIGHT = 64, 48
LENS = Intrinsics.create(WIDTH, HEIGHT, (62.0, 60.0), (33.0, 23.0))
DISTORTED = Intrinsics.create(WIDTH, HEIGHT, (62.0, 60.0), (33.0, 23.0), (-0.2, 0.08, 0.002, -0.003, -0.01))
DEPTH = 1.2
INTERFACES = {
    "water": FlatInterface(1.333),
    "tilted water": FlatInterface(1.333, plane=Plane((0.1, -0.05, 1.0), 0.1)),
    "glass wall": FlatInterface.glass_wall(Plane(offset=0.2), 0.3),
    "looking out": FlatInterface(layers=(1.333, 1.0)),
    "port": FlatInterface.glass_wall(Plane((0.05, 0.1, -1.0), -0.5), 0.1, moves_with_camera=True),
}
for_every_interface = pytest.mark.parametrize("name", INTERFACES)


@for_every_interface
def test_the_image_becomes_what_straight_rays_show_of_the_plane_at_that_depth(name):
    camera = _camera(INTERFACES[name])

    image, mask = remove_refraction(_picture(camera, DEPTH), camera, DEPTH)

    inside, bound = _inner(mask), _bound(_picture(camera, DEPTH))
    straight = _picture(camera.as_pinhole(), DEPTH, camera.plane_in_world())
    assert inside.mean() > 0.5
    assert _largest_difference(image, straight, inside) < bound
    assert _largest_difference(_picture(camera, DEPTH), straight, inside) > 10.0 * bound


@for_every_interface
def test_a_pixel_is_seen_where_its_point_lies_within_the_traced_outline_of_the_image(name):
    camera = _camera(INTERFACES[name])

    image, mask = remove_refraction(_picture(camera, DEPTH) + 9.0, camera, DEPTH)

    inside = _signed_distance_to_outline(camera, camera.as_pinhole())
    clear = np.abs(inside) > 1e-3
    assert clear.mean() > 0.99
    assert np.array_equal(mask.numpy()[clear], inside[clear] > 0.0)
    assert mask.any()
    assert (image[:, ~mask] == 0.0).all()
    assert (image[:, mask] > 5.0).all()


def test_pixels_that_the_camera_does_not_see_are_masked_and_zero():
    camera = _camera(INTERFACES["water"])
    wide = Intrinsics.create(2 * WIDTH, 2 * HEIGHT, 40.0)
    target = replace(camera.as_pinhole(), intrinsics=wide)

    image, mask = remove_refraction(torch.ones(3, HEIGHT, WIDTH).double(), camera, DEPTH, target)

    assert image.shape == (3, 2 * HEIGHT, 2 * WIDTH)
    assert mask.shape == (2 * HEIGHT, 2 * WIDTH)
    assert 0.0 < mask.double().mean() < 0.9
    assert (image[:, ~mask] == 0.0).all()
    assert_matches(image[:, mask], torch.ones_like(image[:, mask]), slack=10.0)


def test_above_the_horizon_nothing_is_seen():
    camera = _camera(INTERFACES["water"], tilt=1.5)
    depth = torch.tensor(DEPTH, dtype=torch.float64, requires_grad=True)

    image, mask = remove_refraction(torch.ones(1, HEIGHT, WIDTH).double(), camera, depth)
    image.sum().backward()

    rising = camera.view_directions(LENS.pixel_grid())[..., 2] >= 0.0
    assert rising.any()
    assert not mask[rising].any()
    assert (image[:, rising] == 0.0).all()
    assert image.isfinite().all()
    assert depth.grad is not None
    assert depth.grad.isfinite()


def test_a_map_gives_every_pixel_the_depth_of_its_own():
    camera = _camera(INTERFACES["water"])
    depths = torch.linspace(0.5, 3.0, WIDTH, dtype=torch.float64).expand(HEIGHT, WIDTH)
    picture = _picture(camera, DEPTH)

    image, mask = remove_refraction(picture, camera, depths)

    for column in (3, 20, 40, 60):
        alone, alone_mask = remove_refraction(picture, camera, float(depths[0, column]))
        assert_matches(image[..., column], alone[..., column], slack=100.0)
        assert torch.equal(mask[:, column], alone_mask[:, column])


def test_a_map_of_one_depth_is_that_depth():
    camera, depths = _camera(INTERFACES["port"]), torch.full((HEIGHT, WIDTH), DEPTH, dtype=torch.float64)
    picture = _picture(camera, DEPTH)

    image, mask = remove_refraction(picture, camera, depths)

    expected, expected_mask = remove_refraction(picture, camera, DEPTH)
    assert_matches(image, expected)
    assert torch.equal(mask, expected_mask)


def test_a_target_without_distortion_undistorts_in_the_same_step():
    camera = _camera(INTERFACES["water"], lens=DISTORTED)
    target = replace(camera.as_pinhole(), intrinsics=LENS)
    picture = _picture(camera, DEPTH)

    image, mask = remove_refraction(picture, camera, DEPTH, target)

    inside = _inner(mask)
    assert inside.mean() > 0.5
    assert _largest_difference(image, _picture(target, DEPTH), inside) < _bound(picture)
    assert _largest_difference(image, remove_refraction(picture, camera, DEPTH)[0], inside) > 2.0 * _bound(picture)


def test_a_target_elsewhere_shows_what_straight_rays_show_from_there():
    camera = _camera(INTERFACES["water"])
    target = replace(camera.as_pinhole(), center_in_world=camera.center_in_world + torch.tensor([0.2, -0.1, 0.3]))
    picture = _picture(camera, DEPTH)

    image, mask = remove_refraction(picture, camera, DEPTH, target)

    inside = _inner(mask)
    assert inside.mean() > 0.5
    assert _largest_difference(image, _picture(target, DEPTH), inside) < _bound(picture)


@pytest.mark.parametrize("lens", [LENS, DISTORTED])
def test_without_refraction_the_image_stays_as_it_is(draw, lens):
    camera, picture = _camera(FlatInterface(1.0), lens=lens), draw.uniform(0.0, 1.0, 3, HEIGHT, WIDTH)

    image, mask = remove_refraction(picture, camera, DEPTH)

    assert mask.all()
    torch.testing.assert_close(image, picture, rtol=0.0, atol=EXACT.pixel)


def test_the_gradients_of_image_depth_and_index_ratio_are_right(draw):
    camera, picture = _camera(INTERFACES["water"]), _picture(_camera(INTERFACES["water"]), DEPTH)
    rows, columns = slice(20, 26), slice(28, 36)

    def resample(image, depth, index_ratio):
        moving = replace(camera, interface=FlatInterface(index_ratio))
        whole = torch.nn.functional.pad(image, (28, WIDTH - 36, 20, HEIGHT - 26))
        return remove_refraction(picture + whole, moving, depth)[0][:, rows, columns]

    at = (
        draw.normal(1, 6, 8).requires_grad_(),
        torch.tensor(DEPTH, dtype=torch.float64, requires_grad=True),
        torch.tensor(1.333, dtype=torch.float64, requires_grad=True),
    )
    assert torch.autograd.gradcheck(resample, at, eps=1e-7, rtol=1e-4, atol=1e-5)


def test_the_depth_is_found_again_by_its_gradient():
    camera, guess = _camera(INTERFACES["water"]), torch.tensor(0.9, dtype=torch.float64, requires_grad=True)
    picture, wanted = _picture(camera, DEPTH), _picture(camera.as_pinhole(), DEPTH)

    def error(depth):
        image, mask = remove_refraction(picture, camera, depth)
        return ((image - wanted).square() * mask).sum() / mask.sum()

    optimizer = torch.optim.Adam([guess], lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        error(guess).backward()
        optimizer.step()

    assert abs(guess.item() - DEPTH) < 0.02


def test_an_image_in_single_precision_stays_in_it():
    camera = _camera(INTERFACES["water"])
    picture = _picture(camera, DEPTH)

    image, mask = remove_refraction(picture.float(), camera, DEPTH)

    expected, expected_mask = remove_refraction(picture, camera, DEPTH)
    assert image.dtype == torch.float32
    assert torch.equal(mask, expected_mask)
    torch.testing.assert_close(image.double(), expected, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("shape", [(3, WIDTH, HEIGHT), (3, HEIGHT, WIDTH + 1), (HEIGHT, WIDTH, 3)])
def test_an_image_of_another_size_than_the_cameras_is_refused(shape):
    with pytest.raises(ValueError, match=r"image has shape .*, but must end in \(48, 64\)"):
        remove_refraction(torch.zeros(shape), _camera(INTERFACES["water"]), DEPTH)


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (1, 3, HEIGHT, WIDTH)])
def test_an_image_without_channels_or_in_a_batch_is_refused(shape):
    with pytest.raises(ValueError, match=r"image has shape .*, but must be \(channels, height, width\)"):
        remove_refraction(torch.zeros(shape), _camera(INTERFACES["water"]), DEPTH)


def test_a_batch_of_cameras_is_refused():
    camera = _camera(INTERFACES["water"])
    batch = replace(camera, center_in_world=camera.center_in_world.expand(2, 3))

    with pytest.raises(ValueError, match=r"camera has batch shape \(2,\), but must be a single one"):
        remove_refraction(torch.zeros(3, HEIGHT, WIDTH), batch, DEPTH)


@pytest.mark.parametrize(
    "depth", [0.0, -1.0, float("nan"), torch.tensor(0.0), torch.linspace(0.0, 1.0, WIDTH).expand(HEIGHT, WIDTH)]
)
def test_a_depth_that_is_not_above_zero_is_refused(depth):
    with pytest.raises(ValueError, match=r"depth is .*, but must be finite and above 0"):
        remove_refraction(torch.zeros(3, HEIGHT, WIDTH), _camera(INTERFACES["water"]), depth)


@pytest.mark.parametrize("shape", [(WIDTH, HEIGHT), (1, HEIGHT, WIDTH), (2, HEIGHT, WIDTH)])
def test_a_map_of_depths_of_another_size_than_the_target_is_refused(shape):
    with pytest.raises(ValueError, match="depth"):
        remove_refraction(torch.zeros(3, HEIGHT, WIDTH), _camera(INTERFACES["water"]), torch.ones(shape))


def test_a_batch_of_targets_is_refused():
    camera = _camera(INTERFACES["water"])
    target = replace(camera.as_pinhole(), center_in_world=camera.center_in_world.expand(2, 3))

    with pytest.raises(ValueError, match="target"):
        remove_refraction(torch.zeros(3, HEIGHT, WIDTH), camera, DEPTH, target)


def test_an_image_of_whole_numbers_is_refused():
    image = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.uint8)

    with pytest.raises(ValueError, match=r"image has dtype torch\.uint8"):
        remove_refraction(image, _camera(INTERFACES["water"]), DEPTH)


@dataclass(frozen=True)
class _Layers:
    """The first surface in the world, as n . x = offset, and what lies behind it."""

    normal: np.ndarray
    offset: float
    indices: tuple[float, ...]
    thickness: tuple[float, ...]


def _camera(interface, lens=LENS, tilt=0.15):
    """Two above the origin, looking down, leaning forward by `tilt` radians and turned a little."""
    lean = so3_exp(torch.tensor([tilt, 0.0, 0.1], dtype=torch.float64))
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    return RefractiveCamera(lens, lean @ down, torch.tensor([0.1, -0.2, 2.0], dtype=torch.float64), interface)


def _picture(camera, depth, plane=None):
    """What `camera` sees (2, H, W) of a texture on the plane `depth` below the first surface of its interface.

    A straight camera is told which `plane` that is; by default z = 0.
    """
    layers = _layers(camera, plane)
    grid = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    points = _traced(camera, layers, grid, depth)
    x, y, z = np.moveaxis(points, -1, 0)
    waves = (np.sin(1.1 * x + 0.4 * y) + np.sin(0.9 * z - 1.3 * y + 1.0), np.sin(1.5 * y + 0.3) + np.sin(1.4 * x))
    return torch.as_tensor(np.stack(waves))


def _layers(camera, plane=None):
    plane = camera.plane_in_world() if plane is None else plane
    origin = torch.zeros(3, dtype=torch.float64)
    return _Layers(
        plane.normal_like(origin).numpy(),
        -float(plane.signed_distance(origin)),
        tuple(float(index) for index in camera.interface.indices),
        tuple(float(thickness) for thickness in camera.interface.thickness),
    )


def _traced(camera, layers, pixels, depth):
    """Where the rays of pixels (*B, 2) meet the plane `depth` below the first surface, by Snell's law in vectors."""
    lens, rotation = camera.intrinsics, camera.cam_from_world_rotation.numpy()
    position = camera.center_in_world.numpy()
    ideal = _undistorted((pixels - lens.principal_point.numpy()) / lens.focal.numpy(), lens.distortion.numpy())
    direction = np.concatenate((ideal, np.ones_like(ideal[..., :1])), axis=-1) @ rotation
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    surfaces = np.concatenate(([0.0], np.cumsum(layers.thickness)))
    for level, before, after in zip(surfaces, layers.indices, layers.indices[1:], strict=False):
        position = _reached(position, direction, layers, level)
        eta = before / after
        cosine = -(direction @ layers.normal)[..., None]
        direction = eta * direction + (eta * cosine - np.sqrt(1.0 - eta**2 * (1.0 - cosine**2))) * layers.normal
    return _reached(position, direction, layers, depth)


def _undistorted(distorted, coefficients):
    """Brown's lens undone, by repeating: the ideal place is the distorted one less the shift at the ideal place."""
    k1, k2, p1, p2, k3 = coefficients
    ideal = distorted
    for _ in range(200):
        x, y = np.moveaxis(ideal, -1, 0)
        r2 = x**2 + y**2
        radial = r2 * (k1 + r2 * (k2 + r2 * k3))
        shift_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x**2)
        shift_y = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y**2)
        ideal = distorted - np.stack((shift_x, shift_y), axis=-1)
    return ideal


def _reached(position, direction, layers, level):
    gap = layers.offset - level - position @ layers.normal
    return position + (gap / (direction @ layers.normal))[..., None] * direction


def _signed_distance_to_outline(camera, target):
    """How far inside (H, W) what `camera` sees of the plane the point of each pixel of `target` lies."""
    layers, plane = _layers(camera), camera.plane_in_world()
    t = np.linspace(0.0, 1.0, 400, endpoint=False)
    corners = np.array([[0.0, 0.0], [WIDTH, 0.0], [WIDTH, HEIGHT], [0.0, HEIGHT]])
    edge = np.concatenate([a + t[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])
    outline = _traced(camera, layers, edge, DEPTH)
    grid = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    points = _traced(target, _layers(target, plane), grid, DEPTH)
    axes = np.linalg.svd(layers.normal[None])[2][1:].T  # (3, 2)
    polygon = (outline @ axes).astype(np.float32)[:, None]
    return np.array([[cv2.pointPolygonTest(polygon, p.tolist(), True) for p in row] for row in points @ axes])


def _inner(mask):
    """The pixels two and more from any that is not seen: bilinear interpolation there needs no border."""
    return binary_erosion(mask.numpy(), np.ones((3, 3)), iterations=2)


def _largest_difference(image, other, inside):
    return float((image - other)[:, torch.as_tensor(inside)].abs().max())


def _bound(picture):
    """The error of bilinear interpolation, an eighth of the second differences; half as much again for their change."""
    across, along = (np.abs(np.diff(picture.numpy(), n=2, axis=axis)).max() for axis in (1, 2))
    return 1.5 * (across + along) / 8.0
