"""The MSAC loop, driven by estimators that know where numbers lie on a line."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.ransac import RansacOptions, msac, ransac

ONE_BY_ONE = RansacOptions(max_error=1.0, batch_size=1, min_samples=1, min_inliers=2)


class Location:
    """A model is a place (1); its error at a datum is the distance. Samples are answered with their mean.

    `answer` replaces the mean: the candidates of every sample (M) and which of them are valid (M). `refits` replaces
    the mean of the inliers: the places that successive refits give. What was asked is kept in `samples` and `fitted`.
    """

    def __init__(self, data, sample_size=1, answer=None, refits=None):
        self.data, self.sample_size, self.num_data = data, sample_size, len(data)
        self.answer, self.refits = answer, refits
        self.samples, self.fitted = [], []

    def solve(self, samples):
        self.samples.append(samples)
        if self.answer is None:
            return self.data[samples].mean(dim=1)[:, None, None], torch.ones(len(samples), 1, dtype=torch.bool)
        places, valid = (torch.tensor(value).expand(len(samples), -1) for value in self.answer)
        return places[..., None], valid

    def squared_errors(self, models):
        return (models - self.data).square()

    def refit(self, model, inliers):
        self.fitted.append((float(model[0]), inliers))
        place = self.data[inliers].mean() if self.refits is None else torch.tensor(self.refits.pop(0))
        return place.reshape(1, 1), torch.ones(1, dtype=torch.bool)


@pytest.fixture
def make_location(draw):
    """`make_location(inliers, outliers, ...)`: inliers within 0.3 of 5, outliers at 100 and far beyond."""

    def make(inliers, outliers, **scripted):
        far = 100.0 + 50.0 * torch.arange(outliers, dtype=torch.float64)
        return Location(torch.cat((5.0 + draw.uniform(-0.3, 0.3, inliers), far)), **scripted)

    return make


@pytest.mark.parametrize(
    ("inliers", "outliers", "sample_size", "expected"),
    [(50, 50, 2, 33), (90, 10, 2, 6), (50, 50, 7, 1175), (10, 90, 1, 88), (100, 0, 7, 1)],
)
def test_as_many_samples_are_drawn_as_the_confidence_needs(
    make_location, generator, inliers, outliers, sample_size, expected
):
    """ln(1 - 0.9999) / ln(1 - ratio^size), rounded up."""
    location = make_location(inliers, outliers, sample_size=sample_size, answer=([5.0], [True]))

    report = ransac(location, ONE_BY_ONE, generator)

    assert report.num_samples == len(location.samples) == expected


def test_more_confidence_needs_more_samples(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]))

    report = ransac(location, replace(ONE_BY_ONE, confidence=1.0 - 1e-8), generator)

    assert report.num_samples == 65


def test_samples_are_drawn_in_whole_batches(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]))

    report = ransac(location, replace(ONE_BY_ONE, batch_size=10), generator)

    assert report.num_samples == 40
    assert [tuple(batch.shape) for batch in location.samples] == [(10, 2)] * 4


def test_without_outliers_the_least_number_of_samples_is_enough(make_location, generator):
    report = ransac(make_location(100, 0), replace(ONE_BY_ONE, batch_size=8, min_samples=24), generator)

    assert report.num_samples == 24


@pytest.mark.parametrize(("batch_size", "max_samples"), [(1, 7), (10, 50), (10, 45), (64, 10)])
def test_never_more_than_max_samples_are_drawn(make_location, generator, batch_size, max_samples):
    location = make_location(50, 50, answer=([5.0], [False]))

    report = ransac(location, replace(ONE_BY_ONE, batch_size=batch_size, max_samples=max_samples), generator)

    assert report.num_samples == sum(len(batch) for batch in location.samples) == max_samples


def test_a_sample_holds_no_datum_twice_and_every_datum_gets_its_turn(make_location, generator):
    location = make_location(0, 10, sample_size=4, answer=([5.0], [False]))

    ransac(location, replace(ONE_BY_ONE, batch_size=50, max_samples=200), generator)

    samples = torch.cat(location.samples).sort(dim=-1).values
    assert (samples[:, 1:] > samples[:, :-1]).all()
    assert samples.unique().tolist() == list(range(10))


def test_the_place_is_found_and_its_inliers_are_exactly_those_within_max_error(make_location, generator):
    location = make_location(40, 60)

    report = ransac(location, ONE_BY_ONE, generator)

    assert report.status == "success"
    assert report.num_inliers == 40
    assert torch.equal(report.inliers, location.data < 50.0)
    torch.testing.assert_close(report.model[0], location.data[:40].mean())


def test_the_score_is_the_sum_of_squared_errors_truncated_at_max_error(make_location, generator):
    location = make_location(40, 60)

    report = ransac(location, replace(ONE_BY_ONE, max_error=1.5), generator)

    residual = (location.data - report.model).square().clamp(max=1.5**2)
    assert report.score == pytest.approx(float(residual.sum()), rel=1e-12)


def test_the_nearer_of_two_models_with_the_same_inliers_wins(make_location, generator):
    location = make_location(40, 60, answer=([5.5, 5.01, 5.4], [True] * 3), refits=[5.5])

    report = ransac(location, ONE_BY_ONE, generator)

    assert float(report.model[0]) == pytest.approx(5.01)


def test_a_model_that_is_not_valid_never_wins(make_location, generator):
    location = make_location(40, 60, answer=([5.0, 5.2], [False, True]), refits=[5.2])

    report = ransac(location, ONE_BY_ONE, generator)

    assert float(report.model[0]) == pytest.approx(5.2)


def test_an_invalid_refit_is_not_taken(make_location, generator):
    location = make_location(40, 60, answer=([5.2], [True]))
    location.refit = lambda model, inliers: (torch.tensor([[5.0]]), torch.tensor([False]))

    report = ransac(location, ONE_BY_ONE, generator)

    assert float(report.model[0]) == pytest.approx(5.2)


def test_data_where_a_model_is_impossible_count_as_outliers(make_location, generator):
    location = make_location(40, 60, answer=([5.0], [True]))
    squared = location.squared_errors
    location.squared_errors = lambda models: torch.where(torch.arange(100) < 30, torch.inf, squared(models))

    report = ransac(location, ONE_BY_ONE, generator)

    assert report.num_inliers == 10
    assert math.isfinite(report.score)


def test_only_a_model_that_improves_is_refitted(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]), refits=[5.0])

    report = ransac(location, ONE_BY_ONE, generator)

    assert report.num_samples == 33
    assert len(location.fitted) == 1


def test_refitting_goes_on_while_it_improves(make_location, generator):
    location = make_location(100, 0, answer=([5.7], [True]), refits=[5.5, 5.3, 5.4, 5.0])

    report = ransac(location, replace(ONE_BY_ONE, refits=10), generator)

    assert [place for place, _ in location.fitted] == pytest.approx([5.7, 5.5, 5.3])
    assert float(report.model[0]) == pytest.approx(5.3)


def test_refitting_ends_after_as_many_rounds_as_asked_for(make_location, generator):
    location = make_location(100, 0, answer=([5.7], [True]), refits=[5.5, 5.3, 5.2, 5.1])

    ransac(location, replace(ONE_BY_ONE, refits=2), generator)

    assert len(location.fitted) == 2


def test_a_refit_is_given_the_inliers_of_the_best_model(make_location, generator):
    location = make_location(40, 60, answer=([5.2], [True]), refits=[5.2])

    ransac(location, ONE_BY_ONE, generator)

    assert torch.equal(location.fitted[0][1], location.data < 50.0)


@pytest.mark.parametrize(("inliers", "refits"), [(3, 0), (4, 1)])
def test_a_refit_is_asked_for_only_with_more_inliers_than_a_sample_has(make_location, generator, inliers, refits):
    location = make_location(inliers, 20, sample_size=3, answer=([5.2], [True]), refits=[5.2])

    ransac(location, replace(ONE_BY_ONE, max_samples=10), generator)

    assert len(location.fitted) == refits


@pytest.mark.parametrize(("count", "sample_size", "min_inliers"), [(6, 2, 7), (6, 7, 1), (0, 1, 1)])
def test_too_few_data_are_reported_and_nothing_is_drawn(make_location, generator, count, sample_size, min_inliers):
    location = make_location(count, 0, sample_size=sample_size)

    report = ransac(location, replace(ONE_BY_ONE, min_inliers=min_inliers), generator)

    assert report.status == "too_few_data"
    assert (report.num_samples, report.num_inliers, len(report.inliers)) == (0, 0, count)
    assert not location.samples


def test_fewer_inliers_than_asked_for_are_no_consensus(make_location, generator):
    report = ransac(make_location(9, 91), replace(ONE_BY_ONE, min_inliers=10), generator)

    assert report.status == "no_consensus"
    assert report.num_inliers == 9
    assert float(report.model[0]) == pytest.approx(5.0, abs=0.3)


def test_without_any_valid_model_there_is_no_consensus(make_location, generator):
    location = make_location(50, 50, answer=([5.0], [False]))

    report = ransac(location, replace(ONE_BY_ONE, max_samples=20), generator)

    assert (report.status, report.num_inliers, report.num_samples) == ("no_consensus", 0, 20)


def test_the_same_seed_gives_the_same_report(make_location):
    location = make_location(20, 80)

    one, two = (ransac(location, ONE_BY_ONE, torch.Generator().manual_seed(3)) for _ in range(2))

    assert (one.num_samples, one.score) == (two.num_samples, two.score)
    assert torch.equal(one.model, two.model)


@pytest.mark.parametrize("elements", [1, 700])
def test_scoring_models_in_chunks_changes_nothing(make_location, monkeypatch, elements):
    location = make_location(20, 80)
    options = replace(ONE_BY_ONE, batch_size=16)
    whole = ransac(location, options, torch.Generator().manual_seed(3))

    monkeypatch.setattr(msac, "SCORE_ELEMENTS", elements)
    chunked = ransac(location, options, torch.Generator().manual_seed(3))

    assert (chunked.num_samples, chunked.score) == (whole.num_samples, whole.score)
    assert torch.equal(chunked.model, whole.model)
    assert torch.equal(chunked.inliers, whole.inliers)


def test_a_model_that_explains_no_more_than_its_sample_is_not_refitted(make_location, generator):
    location = make_location(3, 40, sample_size=3, answer=([5.0], [True]))

    ransac(location, replace(ONE_BY_ONE, max_samples=5), generator)

    assert location.fitted == []
