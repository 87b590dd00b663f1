"""Patches that are adjusted in rendered photographs, against what these show."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.dense.rendered_scenes import FOCAL, Board, cameras_around, marble, render
from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.matching.interest_points import InterestPoints
from torchrefrac.dense.options import DenseOptions
from torchrefrac.dense.patches import Planes
from torchrefrac.dense.refine import attempt, choose_views, compare, refine
from torchrefrac.dense.scope import Scope
from torchrefrac.refraction import FlatInterface

OPTIONS = DenseOptions()
NO_POINTS = InterestPoints(torch.zeros(0, 2), torch.zeros(0, dtype=torch.long))
FLAT = Board((0.0, 0.0, -40.0))
NEAR, FAR = 20.0, 90.0


@pytest.fixture(scope="module")
def pond():
    """Four photographs of a flat bottom."""
    return render([FLAT], cameras_around(4, 30.0, -30.0, 1.33), marble(), 1.33)


def _lattice(step: int = 8) -> Tensor:
    """Middles of pixels (N, 2) of the reference, well inside it."""
    y, x = torch.meshgrid(torch.arange(12.5, 110.0, step), torch.arange(12.5, 150.0, step), indexing="ij")
    return torch.stack((x.flatten(), y.flatten()), dim=-1).double()


def _guesses(draw, rendered, pixels: Tensor, off: float = 5.0, tilt_deg: float = 20.0) -> Planes:
    """The true planes, moved along the rays by up to `off` footprints and tilted by up to `tilt_deg`, of any length."""
    points, normals = rendered.at(pixels)
    sight = points - rendered.cameras.center_in_world[0]
    move = draw.uniform(-off, off, len(pixels), 1) / FOCAL
    turned = normals + math.tan(math.radians(tilt_deg)) * draw.uniform(0.0, 1.0, len(pixels), 1) * draw.directions(
        len(pixels)
    )
    return Planes(points + move * sight, turned * draw.uniform(0.5, 2.0, len(pixels), 1))


def _errors(rendered, pixels: Tensor, points: Tensor) -> Tensor:
    """In pixel footprints: how far points (k, 3) are from what their pixels show (k)."""
    truth, _ = rendered.at(pixels)
    return (points - truth).norm(dim=-1) / (truth - rendered.cameras.center_in_world[0]).norm(dim=-1) * FOCAL


def _angles_deg(rendered, pixels: Tensor, normals: Tensor) -> Tensor:
    _, truth = rendered.at(pixels)
    truth = truth / truth.norm(dim=-1, keepdim=True)
    return torch.rad2deg(torch.linalg.cross(truth, normals).norm(dim=-1).asin())


@pytest.mark.parametrize(
    ("board", "count", "index_ratio", "height", "near", "far"),
    [
        pytest.param(FLAT, 4, 1.33, 30.0, NEAR, FAR, id="a flat bottom"),
        pytest.param(Board((0.0, 0.0, -40.0), (0.4, -0.2, 1.0)), 4, 1.33, 30.0, NEAR, FAR, id="a slope"),
        pytest.param(Board((0.0, 0.0, 10.0), (0.1, 0.1, 1.0)), 4, 1.33, 60.0, -40.0, -4.0, id="land"),
        pytest.param(Board((0.0, 0.0, 0.0), (0.6, 0.1, 1.0)), 4, 1.33, 40.0, -20.0, 20.0, id="a shore"),
        pytest.param(FLAT, 4, 1.0, 30.0, NEAR, FAR, id="no refraction"),
        pytest.param(FLAT, 2, 1.33, 30.0, NEAR, FAR, id="two images"),
    ],
)
def test_guesses_that_are_a_pixel_or_two_off_end_on_the_surface(draw, board, count, index_ratio, height, near, far):
    rendered = render([board], cameras_around(count, height, board.point[2], index_ratio), marble(), index_ratio)
    pixels = _lattice()
    planes = _guesses(draw, rendered, pixels)

    patches, kept = refine(rendered.scope(near, far, OPTIONS), pixels, planes, OPTIONS)

    before, after = (
        _errors(rendered, at, points) for at, points in ((pixels, planes.points), (patches.pixels, patches.points))
    )
    assert before.median() > 1.0
    assert len(kept) > 0.85 * len(pixels)
    assert after.median() < 0.1
    assert (after < 0.5).double().mean() > 0.95
    assert _angles_deg(rendered, patches.pixels, patches.normals).median() < 3.0
    back, seen = rendered.cameras[0].project(patches.points)
    assert seen.all()
    torch.testing.assert_close(back, patches.pixels, rtol=0.0, atol=1e-9)
    assert torch.equal(patches.pixels, pixels[kept])
    assert ((patches.normals * (rendered.cameras.center_in_world[0] - patches.points)).sum(dim=-1) > 0.0).all()


@pytest.mark.parametrize("side", ["near", "far"])
def test_patches_that_leave_the_range_when_they_are_adjusted_are_refused(pond, side):
    """The guesses lie within it, the surface does not."""
    pixels = _lattice(4)
    points, normals = pond.at(pixels)
    origins, direction, _ = pond.cameras[0].cast_rays(pixels)
    distance, inwards = (points - origins).norm(dim=-1), 1.0 if side == "near" else -1.0
    middle = distance.median()
    limit, guess = float(middle + 0.8 * inwards), middle + 1.0 * inwards
    alike = (distance - middle).abs() < 0.4
    planes = Planes((origins + guess * direction)[alike], normals[alike])
    narrow = (limit, FAR) if side == "near" else (NEAR, limit)

    wide_kept, narrow_kept = (
        refine(pond.scope(near, far, OPTIONS), pixels[alike], planes, OPTIONS)[1] for near, far in ((NEAR, FAR), narrow)
    )

    assert len(wide_kept) > 20
    assert len(narrow_kept) == 0


def test_water_left_out_of_account_leaves_nothing_or_a_wrong_surface(draw, pond):
    pixels = _lattice()
    blind = replace(pond, cameras=pond.cameras.as_pinhole())

    patches, _ = refine(blind.scope(NEAR, FAR, OPTIONS), pixels, _guesses(draw, pond, pixels), OPTIONS)

    assert not len(patches) or _errors(pond, patches.pixels, patches.points).median() > 3.0


def test_signs_and_lengths_of_the_guessed_normals_do_not_matter(draw, pond):
    pixels, scope = _lattice(16), pond.scope(NEAR, FAR, OPTIONS)
    points, normals = _guesses(draw, pond, pixels)

    first, second = (refine(scope, pixels, Planes(points, n), OPTIONS) for n in (normals, -7.0 * normals))

    assert torch.equal(first[1], second[1])
    torch.testing.assert_close(first[0].points, second[0].points, rtol=0.0, atol=1e-4)
    torch.testing.assert_close(first[0].normals, second[0].normals, rtol=0.0, atol=1e-3)


def test_patches_know_nothing_of_the_batch_that_they_are_refined_in(draw, pond):
    pixels, scope = _lattice(12), pond.scope(NEAR, FAR, OPTIONS)
    planes = _guesses(draw, pond, pixels)

    whole, batched = (refine(scope, pixels, planes, replace(OPTIONS, batch=batch)) for batch in (1000, 9))

    assert torch.equal(whole[1], batched[1])
    assert len(whole[1]) > 9
    torch.testing.assert_close(whole[0].points, batched[0].points, rtol=0.0, atol=1e-3)
    assert torch.equal(whole[0].visible, batched[0].visible)


def test_of_no_guesses_no_patches_come(pond):
    none = torch.zeros(0, 3, dtype=torch.float64)

    patches, kept = refine(pond.scope(NEAR, FAR, OPTIONS), none[:, :2], Planes(none, none), OPTIONS)

    assert len(patches) == len(kept) == 0
    assert patches.others.shape == patches.visible.shape == (0, 3)


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_windows_without_texture_give_nothing(draw, pond, noise):
    pixels = _lattice()
    grey = 128.0 + noise * draw.normal(*pond.images.shape).float()
    bare = replace(pond, images=grey)

    patches, kept = refine(bare.scope(NEAR, FAR, OPTIONS), pixels, _guesses(draw, pond, pixels), OPTIONS)

    assert len(patches) == len(kept) == 0


def test_windows_with_less_contrast_than_asked_for_are_no_reference(pond):
    pixels = _lattice(5)
    planes = Planes(*pond.at(pixels))
    column, row = pixels.long().unbind(dim=-1)
    windows = pond.images[0].unfold(0, 7, 1).unfold(1, 7, 1)[row - 3, column - 3].flatten(1)
    contrast = windows.double().std(dim=1, correction=0)
    least = float(contrast.median()) + 1e-3

    _, all_kept = refine(pond.scope(NEAR, FAR, OPTIONS), pixels, planes, OPTIONS)
    _, kept = refine(pond.scope(NEAR, FAR, OPTIONS), pixels, planes, replace(OPTIONS, min_contrast=least, noise=0.01))

    assert contrast[kept].min() > least
    assert len(kept) > 0.9 * int((contrast[all_kept] > least).sum())


def test_noise_that_no_two_images_share_gives_next_to_nothing(draw, pond):
    pixels = _lattice()
    loud = replace(pond, images=128.0 + 40.0 * draw.normal(*pond.images.shape).float())

    patches, _ = refine(loud.scope(NEAR, FAR, OPTIONS), pixels, _guesses(draw, pond, pixels), OPTIONS)

    assert len(patches) <= 0.01 * len(pixels)


def test_images_in_which_a_patch_is_hidden_are_left_out():
    lid = Board((2.0, 1.0, -16.0), reach=9.0)
    cameras = cameras_around(5, 30.0, -30.0, 1.33)
    rendered = render([FLAT, lid], cameras, marble(finest=1.0, coarsest=4.0), 1.33)
    pixels = _lattice(3)
    points, normals = rendered.at(pixels)
    on_bottom = points[:, 2] < -39.0
    pixels, points, normals = pixels[on_bottom], points[on_bottom], normals[on_bottom]

    patches, kept = refine(rendered.scope(NEAR, FAR, OPTIONS), pixels, Planes(points, normals), OPTIONS)

    share = _share_shown(rendered, points[kept])
    hidden, shown = share < 0.02, share > 0.98
    visible = torch.zeros_like(hidden).scatter(1, patches.others, patches.visible)
    inside = torch.zeros_like(hidden).scatter(1, patches.others, torch.ones_like(patches.visible))
    assert (hidden & inside)[:, 1:].sum() > 60
    assert visible[hidden & inside].double().mean() < 0.02
    assert visible[shown & inside].double().mean() > 0.98
    assert _errors(rendered, patches.pixels, patches.points).median() < 0.1


def _share_shown(rendered, points: Tensor) -> Tensor:
    """Which share of the 9 x 9 pixels around points (k, 3) of the bottom every image shows of the bottom: (k, m); a
    point outside of the image has none."""
    pixels, _ = rendered.cameras[:, None].project(points)
    column, row = pixels.floor().long().unbind(dim=-1)
    steps = torch.arange(-4, 5)
    rows, columns = row[..., None, None] + steps[:, None], column[..., None, None] + steps
    height, width = rendered.images.shape[1:]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    image = torch.arange(len(rendered.images))[:, None, None, None]
    bottom = rendered.points[image, rows.clamp(0, height - 1), columns.clamp(0, width - 1), 2] < -39.0
    return torch.where(inside, bottom.double(), math.nan).mean(dim=(-2, -1)).T


def test_masked_pixels_are_no_middles_of_patches_and_masked_images_are_not_compared(draw, pond):
    pixels = _lattice()
    planes = _guesses(draw, pond, pixels)
    allowed = torch.ones(pond.images.shape, dtype=torch.bool)
    allowed[0, :, :80] = False
    allowed[2] = False

    patches, _ = refine(pond.scope(NEAR, FAR, OPTIONS, allowed), pixels, planes, OPTIONS)

    assert len(patches) > 0.35 * len(pixels)
    assert (patches.pixels[:, 0] >= 80.0).all()
    assert not patches.visible[patches.others == 2].any()


def _looking_at_the_origin(angles_deg):
    """Cameras 50 from the origin: the first straight above it, the others so many degrees off, to all sides."""
    angle = torch.deg2rad(torch.tensor([0.0, *angles_deg], dtype=torch.float64))
    azimuth = torch.arange(len(angle)).double() * 2.0
    center = 50.0 * torch.stack((angle.sin() * azimuth.cos(), angle.sin() * azimuth.sin(), angle.cos()), dim=-1)
    forward = -center / center.norm(dim=-1, keepdim=True)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor((0.1, 1.0, 0.2)).double().expand_as(forward)), dim=-1
    )
    rotation = torch.stack((right, torch.linalg.cross(forward, right), forward), dim=-2)
    cameras = RefractiveCamera(Intrinsics.create(160, 120, 150.0), rotation, center, FlatInterface(1.33))
    atlas = Atlas.build([torch.zeros(120, 160)] * len(angle), 1)
    ids, tile, none = torch.arange(len(angle)), (0, 0, 160, 120), torch.zeros(0, 3, dtype=torch.float64)
    return Scope(ids, cameras, -50.0, 50.0, none, none[:, :2], atlas, None, tile, lambda _: NO_POINTS)


def test_images_at_the_best_angle_come_first_and_none_beyond_the_largest():
    scope = _looking_at_the_origin([3.0, 70.0, 35.0, 19.0, 0.5, 12.0])
    origin = torch.zeros(1, 3, dtype=torch.float64)

    image, present = choose_views(scope, origin, replace(OPTIONS, views=6))
    few, few_present = choose_views(scope, origin, replace(OPTIONS, views=2))

    assert image[0, :4].tolist() == [4, 6, 3, 1]  # 19, 12, 35, 3 degrees: 20 / 35 is less than 12 / 20
    assert present.tolist() == [[True, True, True, True, False, False]]
    assert few.tolist() == [[4, 6]]
    assert few_present.all()


def test_images_that_do_not_see_a_point_or_are_masked_there_are_not_chosen():
    scope = _looking_at_the_origin([10.0, 20.0, 30.0])
    points = torch.tensor([(0.0, 0.0, 0.0), (18.0, 0.0, 0.0), (0.0, 0.0, -5000.0)], dtype=torch.float64)
    allowed = torch.ones(4, 120, 160, dtype=torch.bool)
    allowed[2, 55:65, 75:85] = False  # around the origin

    image, present = choose_views(replace(scope, allowed=allowed), points, OPTIONS)

    chosen = torch.zeros(3, 4, dtype=torch.bool).scatter(1, image, present)[:, 1:]
    _, seen = scope.cameras[1:, None].project(points, inside_image=True)
    expected = seen.T.clone()
    expected[0, 1] = False
    expected[2] = False  # far away the rays are all but parallel
    assert chosen.tolist() == expected.tolist()
    assert chosen[0].tolist() == [True, False, True]


def test_known_planes_look_the_same_in_another_image_where_they_lie_on_the_surface(draw, pond):
    """By as much as windows that are sampled one by one say."""
    pixels, scope = _lattice(), pond.scope(NEAR, FAR, OPTIONS)
    planes, image = Planes(*pond.at(pixels)), 1 + torch.arange(len(pixels)) % 3
    away = Planes(planes.points + torch.tensor((0.0, 0.0, 8.0)).double(), planes.normals)

    score, good = compare(scope, pixels, planes, image, OPTIONS)
    off_score, off_good = compare(scope, pixels, away, image, OPTIONS)

    single = replace(OPTIONS, iterations=0, views=1, min_views=2, min_score=0.01)
    for other in (1, 2, 3):
        rows = (good & (image == other)).nonzero()[:, 0]
        pair = replace(scope, ids=scope.ids[[0, other]], cameras=scope.cameras[[0, other]], atlas=_pair(pond, other))
        judged, kept = refine(pair, pixels[rows], planes[rows], single)
        torch.testing.assert_close(score[rows[kept]], judged.score, rtol=0.0, atol=1e-4)
        assert len(kept) > 0.9 * len(rows) > 30
    assert good.double().mean() > 0.8
    assert score[good].min() > 0.95
    assert off_good.double().mean() < 0.1
    assert off_score.median() < 0.5


def _pair(rendered, other: int) -> Atlas:
    return Atlas.build([rendered.images[0], rendered.images[other]], OPTIONS.levels, mode=OPTIONS.interpolation)


@pytest.mark.parametrize("change", ["masked", "near", "far", "contrast", "slant"])
def test_known_planes_that_may_not_be_believed_do_not_count(pond, change):
    pixels = _lattice()
    planes, image = Planes(*pond.at(pixels)), torch.ones(len(pixels), dtype=torch.long)
    allowed = torch.ones(pond.images.shape, dtype=torch.bool)
    allowed[1] = False
    scopes = {
        "masked": pond.scope(NEAR, FAR, OPTIONS, allowed),
        "near": pond.scope(80.0, FAR, OPTIONS),
        "far": pond.scope(NEAR, 21.0, OPTIONS),
    }
    options = {"contrast": replace(OPTIONS, min_contrast=200.0), "slant": replace(OPTIONS, max_slant=1e-3)}

    _, good = compare(
        scopes.get(change, pond.scope(NEAR, FAR, OPTIONS)), pixels, planes, image, options.get(change, OPTIONS)
    )

    assert not good.any()


def test_attempts_that_join_others_end_as_alone(draw, pond):
    """Whoever they share their passes with; one that ends is not passed over again."""
    pixels, scope = _lattice(12), pond.scope(NEAR, FAR, OPTIONS)
    planes = _guesses(draw, pond, pixels)
    half, alone = len(pixels) // 2, refine(scope, pixels, planes, OPTIONS)
    number = torch.arange(len(pixels))

    under_way = attempt(scope, number[:half], pixels[:half], planes[:half], OPTIONS)
    ended, passes = [], 0
    while len(under_way):
        if passes == 2:
            late = attempt(scope, number[half:], pixels[half:], planes[half:], OPTIONS)
            under_way = type(under_way).together([under_way, late])
        under_way, some = under_way.advance(scope, OPTIONS)
        ended.append(some)
        passes += 1

    good = torch.cat([some.good for some in ended])
    points = torch.cat([some.patches.points for some in ended])[good.argsort()]
    assert torch.equal(good.sort().values, alone[1])
    torch.testing.assert_close(points, alone[0].points, rtol=0.0, atol=1e-3)
    everyone = torch.cat([some.number for some in ended])
    assert len(everyone) == len(everyone.unique())
    assert passes <= 2 + OPTIONS.iterations + 2


def test_no_attempt_makes_more_passes_than_it_may(draw, pond):
    pixels, options = _lattice(12), replace(OPTIONS, iterations=3)
    scope = pond.scope(NEAR, FAR, options)
    under_way = attempt(scope, torch.arange(len(pixels)), pixels, _guesses(draw, pond, pixels, off=30.0), options)

    for _ in range(options.iterations + 2):
        under_way, _ = under_way.advance(scope, options)

    assert not len(under_way)
