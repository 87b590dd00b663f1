"""Candidates along the image of a bent ray: planted correspondences, a brute-force search, the pinhole's line."""

import pytest
import torch
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.matching.epipolar_curve import Candidates, evenly, find_candidates, sample
from torchrefrac.dense.matching.interest_points import InterestPoints
from torchrefrac.dense.rays import PixelRays


def test_a_curve_is_the_image_of_evenly_spaced_points_of_the_ray(make_basin):
    _, other, rays, distance, _ = _planted(make_basin(points=5))
    near, far = distance - 60.0, distance + 20.0

    pixels, at, valid = sample(rays, other, evenly(near, far, 9))

    assert pixels.shape == (5, 9, 2)
    torch.testing.assert_close(at, near[:, None] + 10.0 * torch.arange(9), rtol=0.0, atol=1e-12)
    for i in range(9):
        expected, seen = other.project(rays.at(near + 10.0 * i))
        torch.testing.assert_close(pixels[:, i], expected, rtol=0.0, atol=1e-9)
        assert torch.equal(valid[:, i], seen)


@pytest.mark.parametrize("land", [0, 60])
def test_every_planted_match_is_found_at_its_true_distance(make_basin, draw, land: int):
    _, other, rays, distance, pixels = _planted(make_basin(points=300, land=land))
    kind = torch.arange(300) % 2
    near, far = distance - draw.uniform(5.0, 40.0, 300), distance + draw.uniform(5.0, 40.0, 300)

    found = find_candidates(rays, kind, other, InterestPoints(pixels, kind), near, far)

    assert (distance[:land] < 0.0).all()
    true = found.point == found.other
    assert torch.equal(found.point[true], torch.arange(300))
    torch.testing.assert_close(found.distance[true], distance, rtol=0.0, atol=1e-6)
    assert float(found.offset[true].max()) < 1e-6


def test_the_straight_epipolar_line_misses_most_of_what_the_curve_finds(make_basin):
    basin = make_basin(points=200)
    reference, other, rays, distance, pixels = _planted(basin)
    kind = torch.zeros(200, dtype=torch.long)
    points = InterestPoints(pixels, kind)
    straight = PixelRays.cast(reference.as_pinhole(), basin.project()[0][0])

    along_curve = find_candidates(rays, kind, other, points, distance - 30.0, distance + 30.0)
    along_line = find_candidates(straight, kind, other.as_pinhole(), points, 0.0 * distance, 0.0 * distance + 400.0)

    assert int((along_curve.point == along_curve.other).sum()) == 200
    assert int((along_line.point == along_line.other).sum()) < 67


def test_without_refraction_the_curve_is_the_epipolar_line(make_basin):
    basin = make_basin(points=80, index_ratio=1.0)
    _, other, rays, distance, pixels = _planted(basin)
    kind = torch.zeros(80, dtype=torch.long)
    line = _epipolar_lines(basin)
    beside = (line @ torch.cat((pixels, torch.ones(80, 1, dtype=torch.float64)), dim=1).T).abs()

    found = find_candidates(rays, kind, other, InterestPoints(pixels, kind), distance - 30.0, distance + 30.0, band=3.0)
    drawn = sample(rays, other, evenly(distance - 30.0, distance + 30.0, 7)).pixels

    away = (drawn * line[:, None, :2]).sum(dim=-1) + line[:, 2:]
    assert float(away.abs().max()) < 1e-8
    inner = ((found.distance - distance[found.point]).abs() < 29.999).nonzero()[:, 0]
    assert len(inner) > 80
    torch.testing.assert_close(found.offset[inner], beside[found.point[inner], found.other[inner]], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(
    ("low", "high", "band", "spacing"),
    [
        (20.0, 130.0, 2.0, 4.0),  # under water
        (-30.0, 130.0, 5.0, 4.0),  # from the land into the water
        (-30.0, -1.0, 5.0, 4.0),  # on the land alone
        (-400.0, 300.0, 5.0, 4.0),  # from above the other camera, behind which the ray begins
        (20.0, 130.0, 8.0, 60.0),  # chords longer than the band is wide
        (70.0, 70.0, 8.0, 4.0),  # one place
    ],
)
def test_a_search_through_every_pair_finds_the_same(
    make_basin, draw, low: float, high: float, band: float, spacing: float
):
    _, other, rays, _, _ = _planted(make_basin(points=30, land=6, index_ratio=1.33))
    beside = draw.uniform(max(low, -60.0), min(high, 130.0), 300)
    pixels, seen = other.project(rays[torch.arange(300) % 30].at(beside), inside_image=True)
    pixels = (pixels + 4.0 * draw.normal(300, 2))[seen]
    near, far = torch.full((30,), low).double(), torch.full((30,), high).double()
    kind, others = torch.arange(30) % 2, InterestPoints(pixels, torch.arange(len(pixels)) // 30 % 2)

    found = find_candidates(rays, kind, other, others, near, far, band, spacing)

    distance, offset = _through_every_pair(rays, other, pixels, low, high)
    wanted = (offset <= band) & (kind[:, None] == others.kind)
    point, match = wanted.nonzero().unbind(dim=-1)
    assert len(point) > 50
    assert torch.equal(found.point, point)
    assert torch.equal(found.other, match)
    torch.testing.assert_close(found.offset, offset[point, match], rtol=0.0, atol=1e-7)
    torch.testing.assert_close(found.distance, distance[point, match], rtol=0.0, atol=1e-3)


def test_points_of_another_kind_are_no_candidates(make_basin):
    _, other, rays, distance, pixels = _planted(make_basin(points=50))
    corner, blob = torch.zeros(50, dtype=torch.long), torch.ones(50, dtype=torch.long)
    both = InterestPoints(torch.cat((pixels, pixels)), torch.cat((blob, corner)))

    none = find_candidates(rays, corner, other, InterestPoints(pixels, blob), distance - 30.0, distance + 30.0)
    found = find_candidates(rays, corner, other, both, distance - 30.0, distance + 30.0)

    assert len(none) == 0
    assert len(found) >= 50
    assert bool((found.other >= 50).all())


def test_a_single_point_is_found_as_among_many(make_basin):
    _, other, rays, _, pixels = _planted(make_basin(points=40, land=5))
    kind = torch.zeros(40, dtype=torch.long)
    near, far = torch.full((40,), -40.0), torch.full((40,), 200.0)

    among_many = find_candidates(rays, kind, other, InterestPoints(pixels, kind), near, far)

    for i in range(40):
        alone = find_candidates(rays, kind, other, InterestPoints(pixels[i : i + 1], kind[:1]), near, far)
        rows = among_many.other == i
        assert torch.equal(alone.point, among_many.point[rows])
        torch.testing.assert_close(alone.distance, among_many.distance[rows], rtol=0.0, atol=1e-6)


def test_more_curves_than_are_worked_on_at_once_are_numbered_through(make_basin):
    _, other, rays, distance, pixels = _planted(make_basin(points=1500))
    kind = torch.zeros(1500, dtype=torch.long)

    found = find_candidates(rays, kind, other, InterestPoints(pixels, kind), distance - 3.0, distance + 3.0)

    assert torch.equal(found.point[found.point == found.other], torch.arange(1500))
    pair = found.point * 1500 + found.other
    assert bool((pair.diff() > 0).all())


@pytest.mark.parametrize("case", ["no rays", "no other points", "far away", "out of sight"])
def test_where_nothing_is_found_the_tensors_are_empty(make_basin, case: str):
    _, other, rays, distance, pixels = _planted(make_basin(points=20))
    kind = torch.zeros(20, dtype=torch.long)
    near, far, others = distance - 5.0, distance + 5.0, InterestPoints(pixels, kind)
    if case == "no rays":
        none = torch.zeros(0, dtype=torch.long)
        rays, kind, near, far = rays[none], kind[none], near[none], far[none]
    elif case == "no other points":
        others = InterestPoints(pixels[:0], kind[:0])
    elif case == "far away":
        others = InterestPoints(pixels + 5000.0, kind)
    else:
        near, far = near - 900.0, near - 890.0

    found = find_candidates(rays, kind, other, others, near, far)

    assert len(found) == 0
    assert _dtypes(found) == [torch.long, torch.long, torch.float64, torch.float64]


def test_misuse_is_named(make_basin):
    basin = make_basin(points=4)
    _, other, rays, distance, pixels = _planted(basin)
    kind = torch.zeros(4, dtype=torch.long)
    others = InterestPoints(pixels, kind)

    with pytest.raises(ValueError, match=r"camera has batch shape \(2,\), but must be a single camera"):
        find_candidates(rays, kind, basin.cameras, others, distance, distance)
    with pytest.raises(ValueError, match="far - near is -1 somewhere, but must be finite and at least 0"):
        find_candidates(rays, kind, other, others, distance, distance - 1.0)
    with pytest.raises(ValueError, match="band is 0, but must be finite and above 0"):
        find_candidates(rays, kind, other, others, distance, distance, band=0.0)
    with pytest.raises(ValueError, match="spacing is -1, but must be finite and above 0"):
        find_candidates(rays, kind, other, others, distance, distance, spacing=-1.0)
    with pytest.raises(ValueError, match=r"shapes do not broadcast: rays \(4,\), near \(3,\), far \(4,\)"):
        find_candidates(rays, kind, other, others, distance[:3], distance)


def _planted(basin) -> tuple[RefractiveCamera, RefractiveCamera, PixelRays, Tensor, Tensor]:
    """Reference and other camera; the points' rays from the one and distances along them; pixels in the other."""
    pixels, _ = basin.project()
    reference, other = basin.cameras[0], basin.cameras[1]
    rays = PixelRays.cast(reference, pixels[0])
    land = basin.points[:, 2] > 0.0
    reach = (basin.points - rays.origin).norm(dim=-1)
    return reference, other, rays, torch.where(land, -reach, reach), pixels[1]


def _epipolar_lines(basin) -> Tensor:
    """(n, 3) of the pinhole pair, first two entries a unit vector: from the fundamental matrix."""
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[:2, :2] = torch.diag(basin.lens.focal.expand(2))
    matrix[:2, 2] = basin.lens.principal_point
    inverse = torch.linalg.inv(matrix)
    turn = basin.rotation[1] @ basin.rotation[0].T
    x, y, z = (basin.rotation[1] @ (basin.center[0] - basin.center[1])).tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    first = torch.cat((basin.project()[0][0], torch.ones(len(basin.points), 1, dtype=torch.float64)), dim=1)
    line = first @ (inverse.T @ cross @ turn @ inverse).T
    return line / line[:, :2].norm(dim=1, keepdim=True)


def _through_every_pair(
    rays: PixelRays, camera: RefractiveCamera, pixels: Tensor, low: float, high: float
) -> tuple[Tensor, Tensor]:
    """Distance and offset (n, m) of the nearest place of each curve to each pixel: many samples, then golden section
    in either direction from the nearest one."""
    samples = (
        torch.cat((torch.linspace(low, high, 4001, dtype=torch.float64), torch.zeros(1))).clamp(low, high).sort()[0]
    )
    drawn, valid = camera.project(rays[:, None].at(samples.expand(len(rays.origin), -1)))
    drawn = torch.where(valid[..., None], drawn, torch.inf)
    nearest = torch.stack(
        [torch.cdist(curve, pixels, compute_mode="donot_use_mm_for_euclid_dist").argmin(dim=0) for curve in drawn]
    )

    def gap(distance: Tensor) -> Tensor:
        seen, visible = camera.project(rays[:, None].at(distance))
        return torch.where(visible, (seen - pixels).norm(dim=-1), torch.inf)

    best, offset = samples[nearest], gap(samples[nearest])
    for step in (-1, 1):
        a, b = samples[nearest], samples[(nearest + step).clamp(0, len(samples) - 1)]
        for _ in range(60):
            third = (b - a) * 0.381966
            left = gap(a + third) <= gap(b - third)
            a, b = torch.where(left, a, a + third), torch.where(left, b - third, b)
        closer = gap((a + b) / 2.0) < offset
        best, offset = torch.where(closer, (a + b) / 2.0, best), torch.minimum(gap((a + b) / 2.0), offset)
    return best, offset


def _dtypes(found: Candidates) -> list[torch.dtype]:
    return [found.point.dtype, found.other.dtype, found.distance.dtype, found.offset.dtype]
