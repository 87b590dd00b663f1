"""The verticals of a whole capture, from its pairs."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.recorder import SilentRecorder
from torchrefrac.sfm import SfmOptions, UnknownVerticalError, complete_gravity, level_capture
from torchrefrac.sfm import vertical as module


@pytest.fixture
def unlevelled(survey_of):
    """`unlevelled(...)`: a survey whose capture knows no gravity."""

    def make(**options):
        survey = survey_of(**options)
        axes = torch.zeros_like(survey.capture.down_in_cam)
        axes[:, 2] = 1.0
        capture = replace(
            survey.capture,
            down_in_cam=axes,
            down_sigma=torch.full_like(survey.capture.height, math.inf),
            has_gravity=False,
        )
        return replace(survey, capture=capture)

    return make


class Notes(SilentRecorder):
    def __init__(self):
        self.texts = []

    def note(self, text):
        self.texts.append(text)


def level(survey, pairs, recorder=None):
    ratio = survey.basin.index_ratio
    find = complete_gravity if survey.capture.has_gravity else level_capture
    return find(survey.capture, pairs, survey.features(), ratio, SfmOptions(), recorder or SilentRecorder())


def angles(capture, survey):
    """Angles (m) in radians between the verticals of the capture and the true ones."""
    return torch.linalg.cross(capture.down_in_cam, survey.basin.down_in_cam).norm(dim=-1).asin()


def test_every_vertical_is_found_to_what_down_sigma_says(unlevelled):
    survey = unlevelled(cameras=4, points=400, noise=0.3, outliers=0.05)
    capture = level(survey, survey.pairs())
    assert capture.has_gravity
    assert module.LEAST_DOWN_SIGMA <= float(capture.down_sigma[0]) < math.radians(1.0)
    assert angles(capture, survey).amax() < 3.0 * float(capture.down_sigma[0])


def test_verticals_of_some_images_are_completed_from_their_pairs_and_the_others_stay(survey_of):
    survey = survey_of(cameras=4, points=400, noise=0.3, gravity_error_deg=0.2)
    unknown = torch.tensor([False, True, False, True])
    axes = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    capture = replace(
        survey.capture,
        down_in_cam=torch.where(unknown[:, None], axes, survey.capture.down_in_cam),
        down_sigma=torch.where(unknown, math.inf, survey.capture.down_sigma),
    )

    found = level(replace(survey, capture=capture), survey.pairs())

    assert torch.equal(found.down_in_cam[~unknown], survey.capture.down_in_cam[~unknown])
    assert torch.equal(found.down_sigma[~unknown], survey.capture.down_sigma[~unknown])
    assert (found.down_sigma[unknown] < math.radians(1.0)).all()
    assert (angles(found, survey)[unknown] < 3.0 * found.down_sigma[unknown]).all()


def test_an_image_that_no_pair_relates_to_the_others_gets_a_vague_vertical(survey_of):
    survey = survey_of(cameras=3, points=60)
    sigma = survey.capture.down_sigma.clone()
    sigma[2] = math.inf

    found = level(replace(survey, capture=replace(survey.capture, down_sigma=sigma)), [])

    assert torch.equal(found.down_in_cam, survey.capture.down_in_cam)
    assert found.down_sigma.tolist() == [*sigma[:2].tolist(), module.VAGUE_SIGMA]


def test_a_vertical_that_contradicts_the_majority_does_not_count():
    down = torch.nn.functional.normalize(
        torch.tensor([[0.0, 0.001, 1.0], [0.0, -0.001, 1.0], [0.5, 0.0, 1.0]], dtype=torch.float64), dim=-1
    )
    mean, sigma, scatter = module.mean_vertical(down, torch.full((3,), 0.002, dtype=torch.float64))
    assert torch.linalg.cross(mean, down.new_tensor((0.0, 0.0, 1.0))).norm() < 1e-9
    assert float(sigma) == pytest.approx(math.sqrt((0.002**2 + module.LEAST_SIGMA**2) / 2))
    assert float(scatter) == pytest.approx(0.001 * math.sqrt(2.0), rel=1e-5)


def test_two_verticals_that_contradict_each_other_are_uncertain():
    down = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]], dtype=torch.float64), dim=-1)
    mean, sigma, _ = module.mean_vertical(down, torch.tensor((0.01, 0.002), dtype=torch.float64))
    torch.testing.assert_close(mean, down[1])
    assert float(sigma) == module.PINHOLE_SIGMA


def test_each_image_gets_its_best_pairs(survey_of):
    survey = survey_of(cameras=6, points=60)
    pairs = sorted(survey.pairs(), key=len, reverse=True)
    chosen = module.best_pairs(pairs)
    assert len(chosen) < len(pairs)
    for image in range(6):
        own = [pair for pair in pairs if image in (pair.first, pair.second)]
        assert all(any(pair is c for c in chosen) for pair in own[: module.PAIRS_PER_IMAGE])


def test_a_vertical_that_no_pair_shows_comes_from_a_neighbour(unlevelled, monkeypatch):
    survey = unlevelled(cameras=3, points=300, noise=0.3)
    first_two = [pair for pair in survey.pairs() if pair.second < 2]
    monkeypatch.setattr(module, "best_pairs", lambda pairs: first_two)
    capture = level(survey, survey.pairs())
    off = angles(capture, survey)
    assert off[:2].amax() < math.radians(0.5)
    assert off[2] < math.radians(12.0)
    assert float(capture.down_sigma[0]) > math.radians(2.0)


def test_an_image_without_matches_is_noted_and_keeps_its_axis(unlevelled):
    survey = unlevelled(cameras=3, points=300, noise=0.3)
    recorder = Notes()
    capture = level(survey, [pair for pair in survey.pairs() if pair.second < 2], recorder)
    assert capture.down_in_cam[2].tolist() == [0.0, 0.0, 1.0]
    assert [text.split(":")[0] for text in recorder.texts] == ["2.jpg"]
    assert float(capture.down_sigma[0]) < math.radians(1.0)


def test_where_no_pair_shows_it_the_error_names_images_and_remedy(unlevelled):
    weak = unlevelled(cameras=2, points=200, noise=0.3, index_ratio=1.003)
    with pytest.raises(UnknownVerticalError, match=r"0.jpg and 1.jpg: .*too weak.*; measure down_in_cam"):
        level(weak, weak.pairs())
    with pytest.raises(UnknownVerticalError, match="no pair of images has 20 matches"):
        level(weak, [replace(pair, matches=pair.matches[:10]) for pair in weak.pairs()])
