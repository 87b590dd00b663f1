"""Which pixels look past the water, and what each medium is made dense of."""

import pickle
from dataclasses import replace

import pytest
import torch

from torchrefrac.dense.densify import nearer
from torchrefrac.dense.media import BLOCK, PartOfStore, media_of
from torchrefrac.scene import DepthMap, WaterExtent


@pytest.fixture
def scene(survey_of):
    """Dry is what has a large x."""
    survey = survey_of(cameras=4, points=80)
    scene = survey.scene(with_points=True)
    return replace(scene, dry=scene.points[:, 0] > scene.points[:, 0].median())


def test_a_scene_without_dry_points_has_one_medium_and_stays_as_it_is(scene):
    for same in (replace(scene, dry=None), replace(scene, dry=torch.zeros_like(scene.placed))):
        (medium,) = media_of(same)
        assert medium.scene is same
        assert medium.where is None


def test_each_medium_has_its_points_and_cameras_that_look_through_it(scene):
    wet, straight = media_of(scene)
    assert not scene.dry[wet.scene.observations.point].any()
    assert scene.dry[straight.scene.observations.point].all()
    assert len(wet.scene.observations) + len(straight.scene.observations) == len(scene.observations)
    assert wet.scene.index_ratio == scene.index_ratio
    assert straight.scene.index_ratio == 1.0
    assert wet.scene.dry is None
    assert straight.scene.dry is None


def test_a_pixel_looks_where_the_nearest_observed_point_lies(scene):
    wet, straight = media_of(scene)
    seen = scene.observations[scene.observations.view == 2]
    assert wet.where is not None
    assert straight.where is not None
    past = straight.where(2)
    assert past.shape == (768, 1024)
    assert torch.equal(past, ~wet.where(2))
    for row, column in [(10, 20), (400, 500), (700, 33), (301, 902)]:
        center = seen.pixels.new_tensor((column // BLOCK + 0.5, row // BLOCK + 0.5)) * BLOCK
        nearest = (seen.pixels - center).norm(dim=-1).argmin()
        assert bool(past[row, column]) == bool(scene.dry[seen.point[nearest]])


def test_where_the_extent_is_drawn_that_decides(scene):
    left = torch.tensor([(-1.0, -1.0), (512.0, -1.0), (512.0, 800.0), (-1.0, 800.0)], dtype=torch.float64)
    capture = replace(scene.capture, water_extent=WaterExtent(None, (None, left, None, None)))
    _, straight = media_of(replace(scene, capture=capture))
    assert straight.where is not None
    assert torch.equal(straight.where(1), (torch.arange(1024) >= 512).expand(768, -1))
    assert not torch.equal(straight.where(0), straight.where(1))


def test_of_two_maps_the_nearer_counts(draw):
    def depth_map(depth, valid):
        values = torch.tensor(depth, dtype=torch.float64)[None]
        return DepthMap("a", 4, values[..., None].expand(1, 4, 3), values, 0.1 * values, torch.tensor([valid]), "cm")

    both = nearer(
        depth_map([1.0, 5.0, 3.0, 0.0], [True, True, True, False]),
        depth_map([2.0, 4.0, 0.0, 0.0], [True, True, False, False]),
    )
    assert both.depth.tolist() == [[1.0, 4.0, 3.0, 0.0]]
    assert both.valid.tolist() == [[True, True, True, False]]
    assert both.points[0, 1].tolist() == [4.0, 4.0, 4.0]


def test_the_second_medium_has_a_place_of_its_own_in_a_store():
    class Kept(dict):
        def load(self, image):
            return self.get(image)

        def save(self, image, patches):
            self[image] = patches

        def room(self, count, views):
            return count, views

    kept = Kept()
    PartOfStore(kept, 5).save(2, "patches")
    assert kept == {7: "patches"}
    assert PartOfStore(kept, 5).load(2) == "patches"
    assert PartOfStore(kept, 5).load(1) is None
    assert PartOfStore(kept, 5).room(3, 2) == (3, 2)


def test_what_an_image_sees_is_the_same_in_another_process(scene):
    for medium in media_of(scene):
        assert medium.where is not None

        sent = pickle.loads(pickle.dumps(medium.where))

        assert torch.equal(sent(1), medium.where(1))
