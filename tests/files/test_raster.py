"""The surface model: known surfaces, a slow oracle that goes from cell to cell, and its files."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from torchrefrac.dense.rasterize import point_spacing, rasterize
from torchrefrac.files.ply import DenseFileError
from torchrefrac.files.raster import load_raster, write_raster
from torchrefrac.scene.dense import DenseCloud

NUMBERS = ("x_west", "y_north", "cell_size", "length_unit")


def cloud_of(points, sigma=0.01, colors=None):
    """A cloud of points (n, 3), grey unless they have colours."""
    points = torch.as_tensor(points, dtype=torch.float64).reshape(-1, 3)
    count = len(points)
    return DenseCloud(
        points=points,
        normals=torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(count, 3),
        colors=torch.full((count, 3), 128, dtype=torch.uint8) if colors is None else colors,
        sigma=torch.as_tensor(sigma, dtype=torch.float64).expand(count).clone(),
        score=torch.ones(count, dtype=torch.float64),
        views=torch.full((count,), 3),
        reference=torch.zeros(count, dtype=torch.long),
        relative_sigma=torch.as_tensor(sigma, dtype=torch.float64).expand(count).clone(),
        length_unit="m",
    )


def on_a_grid(surface, width=4.0, length=3.0, spacing=0.05):
    """Points (n, 3) of a surface z(x, y), on a grid that begins half a spacing inside [0, width] x [0, length]."""
    x, y = torch.meshgrid(
        torch.arange(spacing / 2, width, spacing, dtype=torch.float64),
        torch.arange(spacing / 2, length, spacing, dtype=torch.float64),
        indexing="ij",
    )
    x, y = x.flatten(), y.flatten()
    return torch.stack((x, y, surface(x, y)), dim=-1)


def slope(x, y):
    return -2.0 - 0.3 * x + 0.2 * y


def test_a_plane_has_its_height_at_the_centres_of_the_cells():
    raster = rasterize(cloud_of(on_a_grid(slope)), cell_size=0.1)

    assert raster.height.shape == (30, 40)
    assert raster.valid.all()
    assert not raster.filled.any()
    assert torch.equal(raster.count, torch.full((30, 40), 4))
    assert torch.allclose(raster.height, slope(raster.x[None], raster.y[:, None]), rtol=0.0, atol=1e-12)
    assert torch.equal(raster.depth, -raster.height)
    assert (raster.x_west, raster.y_north) == (0.0, pytest.approx(3.0))
    assert (raster.cell_size, raster.length_unit) == (0.1, "m")


def test_north_is_up_and_west_is_left():
    raster = rasterize(cloud_of([[0.5, 7.5, 1.0], [2.5, 7.5, 2.0], [0.5, 5.5, 3.0]]), cell_size=1.0)

    assert raster.height.tolist() == [[1.0, 0.0, 2.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]
    assert raster.valid.tolist() == [[True, False, True], [False] * 3, [True, False, False]]
    assert (raster.x_west, raster.y_north) == (0.0, 8.0)
    assert raster.x.tolist() == [0.5, 1.5, 2.5]
    assert raster.y.tolist() == [7.5, 6.5, 5.5]


def test_negative_coordinates_and_edges_of_cells_are_counted_from_multiples_of_the_cell_size():
    raster = rasterize(cloud_of([[-1.0, -1.0, 1.0], [-0.25, -0.25, 2.0], [0.0, 0.0, 3.0]]), cell_size=0.5)

    assert (raster.x_west, raster.y_north) == (-1.0, 0.0)
    assert raster.height.tolist() == [[0.0, 2.0, 3.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]


def test_land_has_a_negative_depth_and_an_empty_cell_none():
    raster = rasterize(cloud_of([[0.5, 0.5, 1.5], [2.5, 0.5, -4.0]]), cell_size=1.0)

    assert raster.depth.tolist() == [[-1.5, 0.0, 4.0]]


def test_both_sides_of_a_step_keep_their_height():
    points = on_a_grid(lambda x, y: torch.where(x < 2.0, -1.0, -3.0))

    raster = rasterize(cloud_of(points), cell_size=0.1)

    assert torch.equal(raster.height, torch.where(raster.x < 2.0, -1.0, -3.0).double().expand(30, 40))


@pytest.mark.parametrize("upper_part", [1, 3])
def test_where_two_surfaces_lie_above_each_other_the_upper_one_counts(upper_part):
    lower = on_a_grid(slope)
    upper = on_a_grid(lambda x, y: slope(x, y) + 1.0)[::upper_part]

    raster = rasterize(cloud_of(torch.cat((lower, upper))), cell_size=0.2)

    assert (raster.height - slope(raster.x[None], raster.y[:, None]) - 1.0).abs().max() < 0.05


def test_single_points_above_a_surface_do_not_raise_it(draw):
    ground = on_a_grid(slope)
    high = ground[::40] + torch.tensor([0.01, 0.01, 1.0], dtype=torch.float64)

    raster = rasterize(cloud_of(torch.cat((ground, high))), cell_size=0.1)

    assert torch.allclose(raster.height, slope(raster.x[None], raster.y[:, None]), rtol=0.0, atol=1e-12)


def test_of_two_points_apart_the_one_that_the_cells_around_agree_with_counts():
    ground = on_a_grid(slope, spacing=0.1)
    high = ground[777:778] + torch.tensor([0.01, 0.01, 1.0], dtype=torch.float64)

    raster = rasterize(cloud_of(torch.cat((ground, high))), cell_size=0.1)

    assert torch.equal(raster.count, torch.ones(30, 40, dtype=torch.long))
    assert torch.allclose(raster.height, slope(raster.x[None], raster.y[:, None]), rtol=0.0, atol=1e-12)


def test_noise_is_averaged_with_weights_and_without_bias(draw):
    points = on_a_grid(lambda x, y: torch.zeros_like(x) - 1.0, spacing=0.02)
    sigma = torch.where(draw.uniform(0.0, 1.0, len(points)) < 0.5, 0.05, 0.2).double()
    points[:, 2] += sigma * draw.normal(len(points))

    raster = rasterize(cloud_of(points, sigma), cell_size=0.2)

    error = raster.height + 1.0
    assert error.mean().abs() < 4.0 * error.std() / math.sqrt(error.numel())
    assert error.std() < 1.1 * 0.05 / math.sqrt(50.0)
    assert 0.8 < (error / raster.sigma).square().mean().sqrt() < 1.2


def test_colours_are_those_of_the_upper_surface():
    points = torch.tensor([[0.5, 0.5, -1.0], [0.6, 0.5, -1.0], [0.5, 0.5, -9.0], [0.6, 0.5, -9.0]])
    colors = torch.tensor([[10, 20, 30], [20, 40, 251], [255, 0, 0], [255, 0, 0]], dtype=torch.uint8)

    raster = rasterize(cloud_of(points, colors=colors), cell_size=1.0)

    assert raster.colors.tolist() == [[[15, 30, 140]]]


def test_the_raster_is_what_a_loop_over_its_cells_makes(draw):
    count = 4000
    points = torch.cat((draw.uniform(-2.0, 2.0, count, 2), draw.uniform(-3.0, -1.0, count, 1)), dim=-1)
    points[::2, 2] = slope(points[::2, 0], points[::2, 1]) / 2.0
    sigma = draw.power_of_ten(-2.5, -1.0, count)
    colors = torch.randint(256, (count, 3), generator=draw.generator).to(torch.uint8)

    raster = rasterize(cloud_of(points, sigma, colors), cell_size=0.1)

    height, deviation, members, color = _loop(points.numpy(), sigma.numpy(), colors.numpy(), raster)
    measured = members > 0
    assert np.array_equal(measured, (raster.valid & ~raster.filled).numpy())
    assert np.array_equal(members, raster.count.numpy())
    assert np.allclose(height[measured], raster.height.numpy()[measured], rtol=0.0, atol=1e-12)
    assert np.allclose(deviation[measured], raster.sigma.numpy()[measured], rtol=1e-9)
    assert np.abs(color[measured] - raster.colors.numpy()[measured]).max() < 0.5 + 1e-9


def test_a_cell_among_five_others_is_filled_as_the_plane_goes_on_and_a_larger_hole_stays():
    points = on_a_grid(slope)
    hole = ((points[:, 0] - 1.05).abs() < 0.05) & ((points[:, 1] - 1.05).abs() < 0.05)
    hole |= (points[:, 0] - 2.55).abs().le(0.15) & (points[:, 1] - 2.05).abs().le(0.15)

    raster = rasterize(cloud_of(points[~hole]), cell_size=0.1)

    corners, cross = [[8, 24], [8, 26], [10, 24], [10, 26]], [[8, 25], [9, 24], [9, 25], [9, 26], [10, 25]]
    assert raster.filled.nonzero().tolist() == [*corners, [19, 10]]
    assert (~raster.valid).nonzero().tolist() == cross
    right = slope(raster.x[None], raster.y[:, None])
    assert torch.allclose(raster.height[raster.valid], right[raster.valid], rtol=0.0, atol=1e-12)
    assert (raster.count[raster.filled] == 0).all()
    assert (raster.sigma[raster.filled] > raster.sigma[20, 20]).all()
    assert (raster.colors[raster.filled] == 128).all()
    assert raster.height[9, 25] == 0.0


def test_a_filled_cell_is_the_mean_of_opposite_neighbours_and_as_uncertain_as_they_differ():
    points = [[x + 0.5, y + 0.5, float(z)] for (x, y), z in _ring().items()]

    raster = rasterize(cloud_of(points, sigma=0.3), cell_size=1.0)

    assert raster.filled[1, 1]
    assert raster.height[1, 1] == pytest.approx((1.0 + 2.0 + 3.0 + 4.0) / 4.0)
    spread = (1.0**2 + 2.0**2 + 3.0**2 + 4.0**2) / 4.0
    assert raster.sigma[1, 1] == pytest.approx(math.sqrt(0.3**2 + spread))


def test_the_cell_size_follows_the_spacing_of_points(draw):
    scattered = torch.cat((draw.uniform(0.0, 1.0, 20000, 2), torch.zeros(20000, 1)), dim=-1)

    assert point_spacing(scattered) == pytest.approx(1.0 / math.sqrt(20000), rel=0.05)
    assert point_spacing(on_a_grid(slope, spacing=0.05)) == pytest.approx(0.05, rel=0.15)
    assert rasterize(cloud_of(scattered)).cell_size == pytest.approx(1.5 / math.sqrt(20000), rel=0.1)


def test_with_its_own_cell_size_a_surface_has_no_empty_cells(draw):
    points = draw.uniform(0.0, 1.0, 20000, 3)
    points[:, 2] = -1.0

    assert rasterize(cloud_of(on_a_grid(slope))).valid.all()
    assert rasterize(cloud_of(points)).valid.double().mean() > 0.97


@pytest.mark.parametrize("cell_size", [None, 0.5])
def test_an_empty_cloud_is_a_raster_without_cells(cell_size):
    raster = rasterize(DenseCloud.empty("cm"), cell_size)

    assert raster.height.shape == raster.depth.shape == raster.valid.shape == (0, 0)
    assert raster.colors.shape == (0, 0, 3)
    assert raster.length_unit == "cm"


@pytest.mark.parametrize("count", [1, 2, 20])
def test_points_at_one_place_are_a_raster_of_one_cell(count):
    raster = rasterize(cloud_of([[3.25, -4.5, -2.0]] * count, sigma=0.1))

    assert (raster.height.tolist(), raster.count.tolist()) == ([[-2.0]], [[count]])
    assert raster.sigma.item() == pytest.approx(0.1 / math.sqrt(count))
    assert raster.cell_size == 1.0


def test_points_on_a_line_are_a_row_of_cells():
    points = torch.zeros(11, 3)
    points[:, 0] = torch.arange(11)

    raster = rasterize(cloud_of(points), cell_size=1.0)

    assert raster.height.shape == (1, 11)
    assert raster.valid.all()


def test_what_points_have_in_common_does_not_fall_with_their_number():
    many = cloud_of([[0.5, 0.5, 1.0]] * 100, sigma=0.1)
    axes = torch.tensor((9.0, 9.0, 0.05)).double().expand(100, 3)
    cloud = replace(many, axis_sigma=axes, common_sigma=torch.full((100,), 0.03, dtype=torch.float64))

    assert rasterize(cloud, cell_size=1.0).sigma.item() == pytest.approx(math.hypot(0.04 / math.sqrt(100), 0.03))


def test_points_that_are_exact_have_the_sigma_of_their_scatter():
    raster = rasterize(cloud_of([[0.5, 0.5, 1.0], [0.5, 0.5, 1.2], [1.5, 0.5, 1.0]], sigma=0.0), cell_size=1.0)

    assert raster.height.tolist() == [[pytest.approx(1.1), 1.0]]
    assert raster.sigma.tolist() == [[pytest.approx(0.1), 0.0]]


def test_stray_points_far_away_do_not_make_the_raster_larger():
    points = on_a_grid(slope)
    stray = torch.tensor([[1e9, 0.0, 0.0], [0.0, -1e7, 0.0], [math.nan, 0.0, 0.0], [1.0, 1.0, math.inf]])

    raster = rasterize(cloud_of(torch.cat((stray, points))), cell_size=0.1)

    assert raster.height.shape == (30, 40)
    assert torch.equal(raster.height, rasterize(cloud_of(points), cell_size=0.1).height)


def test_a_raster_of_absurdly_many_cells_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"cell_size is 1e-06, but makes .* give a larger one, for at most 50000000"):
        rasterize(cloud_of(on_a_grid(slope)), cell_size=1e-6)


@pytest.mark.parametrize("cell_size", [0.0, -1.0, math.inf, math.nan])
def test_a_cell_size_that_is_no_length_is_refused(cell_size):
    with pytest.raises(ValueError, match=r"cell_size is .*, but must be a length above 0"):
        rasterize(cloud_of(on_a_grid(slope)), cell_size)


@pytest.mark.parametrize("count", [0, 1, 3000])
def test_a_raster_survives_the_file_to_the_last_bit(tmp_path, draw, count):
    raster = rasterize(cloud_of(draw.uniform(-1.0, 1.0, count, 3)))

    write_raster(raster, tmp_path / "run")
    loaded = load_raster(tmp_path / "run" / "dsm.npz")

    for field in fields(raster):
        one, other = getattr(raster, field.name), getattr(loaded, field.name)
        assert one == other if field.name in NUMBERS else torch.equal(one, other) and one.dtype == other.dtype
    with np.load(tmp_path / "run" / "dsm.npz") as archive:
        assert np.array_equal(archive["depth"], raster.depth.numpy())


def test_a_damaged_raster_is_named(tmp_path):
    write_raster(rasterize(cloud_of(on_a_grid(slope)), 0.1), tmp_path)
    path = tmp_path / "dsm.npz"
    data = path.read_bytes()

    path.write_bytes(data[:-100])
    with pytest.raises(DenseFileError, match=r"dsm\.npz is not a whole NumPy archive"):
        load_raster(path)
    np.savez(path, format=np.array("torchrefrac-raster/1"), height=np.zeros((2, 2)))
    with pytest.raises(DenseFileError, match=r"dsm\.npz lacks depth, sigma"):
        load_raster(path)
    with pytest.raises(DenseFileError, match=r"none\.npz is not a whole NumPy archive: .*No such file"):
        load_raster(tmp_path / "none.npz")


def _ring():
    """Heights of the eight cells around (1, 1), by column and row from the south: of opposite ones one is 0, the other
    2, 4, 6 or 8."""
    pairs = (((0, 1), (2, 1), 1.0), ((1, 0), (1, 2), 2.0), ((0, 0), (2, 2), 3.0), ((0, 2), (2, 0), 4.0))
    return {cell: mean + side * mean for one, other, mean in pairs for cell, side in ((one, -1), (other, 1))}


def _loop(points, sigma, colors, raster):
    """Height, sigma, count and colour of every cell, by the words of `rasterize` and nothing else."""
    rows, columns = raster.height.shape
    size = raster.cell_size
    row = np.floor((raster.y_north - points[:, 1]) / size).astype(int)
    column = np.floor((points[:, 0] - raster.x_west) / size).astype(int)
    z, reach = points[:, 2], np.maximum(3.0 * sigma, size)
    weight = np.maximum(sigma, 0.1 * np.sort(sigma)[(len(sigma) - 1) // 2]) ** -2
    height, deviation = np.zeros((2, rows, columns))
    members, color = np.zeros((rows, columns), dtype=int), np.zeros((rows, columns, 3))
    for r in range(rows):
        for c in range(columns):
            here = np.flatnonzero((row == r) & (column == c))
            if not len(here):
                continue
            support = np.array([(np.abs(z[here] - z[i]) <= reach[i]).sum() for i in here])
            if support.max() == 1 and len(here) > 1:
                around = np.flatnonzero((abs(row - r) <= 1) & (abs(column - c) <= 1) & ((row != r) | (column != c)))
                support += np.array([(np.abs(z[around] - z[i]) <= 2.0 * reach[i]).sum() for i in here])
            good = (support >= min(2, support.max())) & (4 * support >= support.max())
            level = z[here][good].max()
            for _ in range(4):
                near = here[np.abs(z[here] - level) <= reach[here]]
                level = np.average(z[near], weights=weight[near])
            share = weight[near] / weight[near].sum()
            formal = ((share * sigma[near]) ** 2).sum()
            scatter = (share * (z[near] - level) ** 2).sum() / max(len(near) - 1, 1)
            height[r, c], deviation[r, c], members[r, c] = level, math.sqrt(max(formal, scatter)), len(near)
            color[r, c] = share @ colors[near]
    return height, deviation, members, color
