"""The structure of the normal equations: orders, tiles and chunks."""

import pytest
import torch

from torchrefrac.optim import Family, SchurPlan, plan

PORTIONS = [(64, 1 << 19), (4, 1 << 19), (4, 2 * 4 * 3 * 6 * 4), (1, 1)]


@pytest.fixture(params=PORTIONS, ids=lambda portion: f"tile{portion[0]}-elements{portion[1]}")
def portions(request, cut):
    cut(*request.param)
    return request.param


def test_the_order_sorts_the_observations_by_place_then_camera(make_linear, portions):
    linear = make_linear(points=30, pairs=70)

    made = linear.plan()

    assert torch.equal(made.order.sort().values, torch.arange(70))
    assert torch.equal(made.reduced, linear.camera[made.order])
    assert torch.equal(made.place, made.place_of[linear.point[made.order]])
    rank = made.place * 5 + made.reduced
    assert (rank.diff() > 0).all()


def test_every_point_has_a_place_of_its_own_and_the_tiles_are_as_few_as_can_be(make_linear, portions):
    tile = portions[0]

    made = make_linear(points=30, pairs=70).plan()

    assert len(made.place_of.unique()) == 30
    assert made.place_of.max() < made.num_places
    assert made.num_places == -(-30 // tile) * tile


def test_the_chunks_hold_every_observation_once_and_no_empty_tile(make_linear, portions):
    linear = make_linear(points=30, pairs=70)
    linear = linear.where(linear.point % 10 > 1)

    made = linear.plan()

    listed = torch.cat([torch.arange(len(made.order))[chunk.observations] for chunk in made.chunks])
    assert torch.equal(listed, torch.arange(len(made.order)))
    tiles = torch.cat([torch.arange(chunk.tiles.start, chunk.tiles.stop) for chunk in made.chunks])
    assert torch.equal(tiles, (made.place // portions[0]).unique())


def test_a_chunk_knows_who_sees_its_tiles_and_where_each_observation_belongs(make_linear, portions):
    tile = portions[0]
    made = make_linear(points=30, pairs=70).plan()

    for chunk in made.chunks:
        across = chunk.reduced.shape[1]
        row, slot = chunk.slot // across, chunk.slot % across
        assert torch.equal(row, 3 * (made.place[chunk.observations] - chunk.tiles.start * tile))
        assert torch.equal(chunk.reduced[row // (3 * tile), slot], made.reduced[chunk.observations])
        for cameras, number in zip(chunk.reduced, range(chunk.tiles.start, chunk.tiles.stop), strict=True):
            seen_by = made.reduced[made.place // tile == number].unique()
            assert torch.equal(cameras[: len(seen_by)], seen_by)
            assert (cameras[len(seen_by) :] == 5).all()


def test_chunks_stay_within_their_size_unless_they_are_one_tile_and_are_about_as_wide(make_linear, portions):
    tile, elements = portions

    made = make_linear(points=60, pairs=130).plan()

    widths = torch.cat([(chunk.reduced < 5).sum(dim=1) for chunk in made.chunks])
    assert (widths.diff() >= 0).all()
    for chunk in made.chunks:
        count, across = chunk.reduced.shape
        assert count == 1 or count * across * tile * 3 * 6 <= elements
        narrowest = int((chunk.reduced < 5).sum(dim=1).min())
        assert narrowest <= across <= narrowest * 1.15 + 1


def test_points_of_near_locality_share_a_tile(cut, generator):
    cut(tile=4)
    locality = torch.randperm(23, generator=generator) * 100

    made = SchurPlan.create(torch.arange(23) % 5, torch.arange(23), 5, 23, locality=locality)

    rank = locality // 100
    mates = (made.place_of[:, None] // 4) == (made.place_of // 4)
    assert torch.equal(mates, (rank[:, None] // 4) == (rank // 4))


def test_without_locality_points_that_the_same_cameras_see_share_a_tile(cut):
    """Three groups of four points, each seen by two cameras of its own."""
    cut(tile=4)
    group = torch.arange(12) % 3
    camera = torch.cat((2 * group, 2 * group + 1))

    made = SchurPlan.create(camera, torch.arange(12).repeat(2), 6, 12)

    mates = (made.place_of[:, None] // 4) == (made.place_of // 4)
    assert torch.equal(mates, group[:, None] == group)
    assert [chunk.reduced.tolist() for chunk in made.chunks] == [[[0, 1], [2, 3], [4, 5]]]


def test_the_columns_are_the_pose_of_the_camera_and_its_member_of_each_family():
    lens = Family(3, torch.tensor([1, 0, 1, 1]), 2)
    level = Family(1, torch.tensor([0, 0, 0, 0]))

    made = SchurPlan.create(torch.tensor([0]), torch.tensor([0]), 4, 1, (lens, level), num_extra=2)

    assert made.num_shared == 7
    assert made.size == 24 + 7 + 2
    assert made.columns[1].tolist() == [6, 7, 8, 9, 10, 11, 24, 25, 26, 30]
    assert made.columns[2].tolist() == [12, 13, 14, 15, 16, 17, 27, 28, 29, 30]


def test_a_plan_with_other_families_is_that_which_is_made_with_them(make_linear):
    linear, other = make_linear(families=[(2, 1)], extra=1), (Family(3, torch.tensor([1, 0, 1, 1, 0]), 2),)

    changed = linear.plan().with_families(other)

    made = SchurPlan.create(linear.camera, linear.point, 5, 12, other, 1)
    assert (changed.size, changed.num_shared, changed.families) == (made.size, made.num_shared, made.families)
    assert torch.equal(changed.columns, made.columns)
    assert torch.equal(changed.order, made.order)


@pytest.mark.parametrize("gram", [1, 3, 256])
@pytest.mark.parametrize("cached", [1, 7, 16384])
def test_the_gram_rows_list_the_observations_of_each_camera_once(make_linear, cut, gram, cached):
    cut(gram=gram, cached=cached)
    linear = make_linear()
    made = linear.where(linear.camera != 2).plan()

    table, owner, ends = made.gram_rows

    found, first = [], 0
    for stretch, end in enumerate(ends):
        for row, camera in zip(table[first:end], owner[first:end], strict=True):
            listed = stretch * cached + row[row < cached]
            assert len(listed)
            assert (made.reduced[listed] == camera).all()
            found.append(listed)
        first = end
    assert table.shape == (len(owner), gram)
    assert first == len(owner)
    assert torch.equal(torch.cat(found).sort().values, torch.arange(len(made.order)))


@pytest.mark.parametrize("points", [0, 3])
def test_without_observations_there_is_nothing_to_multiply(points):
    nobody = torch.zeros(0, dtype=torch.long)

    made = SchurPlan.create(nobody, nobody, 2, points)

    assert made.chunks == ()
    assert made.size == 12
    assert len(made.place_of) == points
    assert made.gram_rows[0].shape == (0, plan.GRAM_ROWS)


def test_a_camera_that_sees_a_point_twice_is_refused():
    with pytest.raises(
        ValueError,
        match="two observations are of the same reduced and the same eliminated block",
    ):
        SchurPlan.create(torch.tensor([0, 1, 0]), torch.tensor([2, 2, 2]), 2, 3)
