"""The error that is left is foretold from the cloud and its cameras alone."""

from dataclasses import replace

import pytest
import torch

from tests.correction.survey import looking_down
from torchrefrac.camera import Intrinsics
from torchrefrac.correction import CorrectionRules, correct_points, forecast_errors
from torchrefrac.geometry import Rigid, align_similarity
from torchrefrac.scene import Interfaces, Observations, Scene, Survey
from torchrefrac.sfm import ReadjustOptions, readjust
from torchrefrac.sfm.frame import transformed

N, RULES = 1.333, CorrectionRules()


def rms(vectors):
    return float(vectors.square().sum(dim=-1).mean().sqrt())


@pytest.fixture
def aligned_without_water(draw):
    """`aligned_without_water(0.0)`: true points, of which a share is land, and what an alignment without water makes of
    exact photographs of them: points and cameras, put onto the cameras' true positions."""

    def make(land=0.0):
        grid = torch.cartesian_prod(torch.linspace(-9, 9, 4), torch.linspace(-9, 9, 3)).double()
        center = torch.cat((grid + draw.uniform(-1.0, 1.0, 12, 2), draw.uniform(18.0, 22.0, 12, 1)), dim=-1)
        cameras = looking_down(center, half=0.8)
        z = draw.uniform(-4.5, -3.0, 220, 1)
        z[: int(land * 220)] = draw.uniform(0.2, 2.0, int(land * 220), 1)
        true = torch.cat((draw.uniform(-12.0, 12.0, 220, 2), z), dim=-1)
        lens = Intrinsics.create(1600, 1600, 1000.0)
        seen = Scene.create(
            Rigid(cameras.rotation, center), lens, Interfaces.level(N), true, Observations.none(), names=cameras.names
        )
        point, view = cameras.see(true[:, None] - center).nonzero().unbind(dim=-1)
        pixels, _ = seen.camera_of(view).project(true[point])
        straight = replace(seen, interfaces=Interfaces.level(1.0), observations=Observations(view, point, pixels))
        straight = replace(straight, accepted=torch.ones_like(point, dtype=torch.bool)).cleaned()
        found, _ = readjust(straight, Survey.empty(cameras.names), ReadjustOptions(max_error=1e3, rounds=1))
        found = transformed(found, align_similarity(found.views.center, center))
        kept = torch.bincount(point, minlength=220) > 1
        moved = replace(cameras, center=found.views.center, rotation=found.views.rotation)
        return true[kept][found.placed], found.points[found.placed], moved

    return make


@pytest.mark.parametrize("land", [0.0, 0.8])
def test_what_is_left_and_what_was_before_are_foretold(aligned_without_water, land):
    true, given, cameras = aligned_without_water(land)
    level, wet = torch.zeros(len(given), dtype=torch.float64), torch.ones(len(given), dtype=torch.bool)
    corrected = correct_points(given, level, wet, cameras, RULES)
    which = corrected.corrected

    found = forecast_errors(given, level, wet, cameras, RULES)

    assert found is not None
    left, before = rms((corrected.points - true)[which]), rms((given - true)[which])
    assert found.left == pytest.approx(left, rel=0.4)
    assert found.before == pytest.approx(before, rel=0.2)
    assert (left < before) == (land > 0.5)  # land holds the poses; else they take up the refraction


def test_what_lies_beyond_the_water_changes_nothing(aligned_without_water):
    _, given, cameras = aligned_without_water(0.0)
    far = given.new_tensor((0.0, 0.0, 400.0))
    level, wet = torch.full_like(given[:, 2], 400.0), torch.ones(len(given), dtype=torch.bool)
    on_map = replace(cameras, center=cameras.center + far)
    alone = forecast_errors(given + far, level, wet, on_map, RULES)
    beside = torch.cat((given, given)) + far

    both = forecast_errors(beside, torch.cat((level, torch.zeros_like(level))), torch.cat((wet, ~wet)), on_map, RULES)

    assert alone is not None
    assert both == alone


def test_nothing_is_foretold_where_too_little_is_known(aligned_without_water):
    _, given, cameras = aligned_without_water()
    level, wet = torch.zeros(len(given), dtype=torch.float64), torch.ones(len(given), dtype=torch.bool)

    def foretold(cameras=cameras, rules=RULES, n=220):
        return forecast_errors(given[:n], level[:n], wet[:n], cameras, rules)

    assert foretold(replace(cameras, rotation=None)) is None
    assert foretold(replace(cameras, field=None)) is None
    assert foretold(replace(cameras, field=torch.full_like(cameras.field, torch.inf))) is None
    assert foretold(cameras[torch.arange(2)]) is None
    assert foretold(rules=CorrectionRules(index_ratio=1.0)) is None
    assert foretold(n=10) is None
    assert foretold(replace(cameras, center=cameras.center + 1e3)) is None
