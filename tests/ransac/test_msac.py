"""The LO-MSAC loop, driven by estimators that know where numbers lie on a line."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.ransac import RansacOptions, msac, ransac

ONE_BY_ONE = RansacOptions(max_error=1.0, batch_size=1, max_batch_size=1, min_inliers=2)


class Location:
    """A model is a place (1); its error at a datum is the distance. Samples are answered with their mean.

    `answer` replaces the mean: the candidates of every sample (M) and which of them are valid (M). `better` moves a
    place when it is optimised. What was asked is kept in `samples`, `screened`, and `optimized` (places, rows, and
    whether thoroughly).
    """

    device = torch.device("cpu")

    def __init__(self, data, sample_size=1, answer=None, better=None, hits=1.0, reason="", is_promising=True):
        self.data, self.sample_size, self.num_data = data, sample_size, len(data)
        self.answer, self.better, self.samples_per_hit, self.reason = answer, better, hits, reason
        self.is_promising = is_promising
        self.samples, self.screened, self.optimized, self.judged = [], [], [], []

    def solve(self, samples):
        self.samples.append(samples)
        if self.answer is None:
            return self.data[samples].mean(dim=1)[:, None, None], torch.ones(len(samples), 1, dtype=torch.bool)
        places, valid = (torch.tensor(value).expand(len(samples), -1) for value in self.answer)
        return places[..., None].double(), valid

    def squared_errors(self, models, rows):
        if models.dtype == torch.float32:
            self.screened.append((len(models), rows))
        return (models - self._data(rows).to(models.dtype)).square()

    def optimize(self, models, max_error, rows, thorough):
        self.optimized.append(([float(place) for place in models[:, 0]], rows, thorough))
        if self.better is not None:
            models = models.clone().apply_(self.better)
        return models, (models - self._data(rows)).square().clamp(max=max_error**2).sum(dim=-1)

    def degeneracy(self, model, inliers):
        self.judged.append((float(model[0]), inliers))
        return self.reason

    def _data(self, rows):
        return self.data if rows is None else self.data[rows]


@pytest.fixture
def make_location(draw):
    """`make_location(inliers, outliers, ...)`: inliers within 0.3 of 5, outliers at 100 and far beyond."""

    def make(inliers, outliers, **scripted):
        far = 100.0 + 50.0 * torch.arange(outliers, dtype=torch.float64)
        return Location(torch.cat((5.0 + draw.uniform(-0.3, 0.3, inliers), far)), **scripted)

    return make


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("max_error", 0.0, "max_error is 0, but must be finite and above 0"),
        ("max_error", math.nan, "max_error is nan"),
        ("confidence", 1.0, "confidence is 1, but must be below 1"),
        ("batch_size", 0, "batch_size is 0, but must be finite and at least 1"),
        ("leaders", 0, "leaders is 0"),
        ("screening_factor", 0.5, "screening_factor is 0.5, but must be finite and at least 1"),
    ],
)
def test_options_that_cannot_work_are_refused(option, value, message):
    with pytest.raises(ValueError, match=message):
        RansacOptions(**{option: value})


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


def test_few_data_are_given_up_as_soon_as_no_model_can_have_enough_inliers(make_location, generator):
    """20 of 30 must agree: ln(1 - 0.9999) / ln(1 - (2/3)^4), rounded up; but no fewer than a batch."""
    location = make_location(0, 30, sample_size=4, answer=([5.0], [True]))
    options = RansacOptions(max_error=1.0, batch_size=1, max_batch_size=1, min_inliers=20)

    assert ransac(location, options, generator).num_samples == 42
    assert ransac(location, replace(options, batch_size=100, max_batch_size=100), generator).num_samples == 100


def test_data_that_do_not_look_promising_are_given_up_early(make_location, generator):
    """ln(0.01) / ln(1 - 0.4^4), rounded up; but no fewer than a batch."""
    location = make_location(0, 300, sample_size=4, answer=([5.0], [True]), is_promising=False)
    options = RansacOptions(max_error=1.0, batch_size=100, min_inliers=20)

    assert ransac(location, options, generator).num_samples == 178
    assert ransac(location, replace(options, batch_size=200), generator).num_samples == 200
    location.is_promising = True
    assert ransac(location, options, generator).num_samples == options.max_samples


def test_data_that_do_not_look_promising_are_given_up_only_where_nothing_is_found(make_location, generator):
    location = make_location(30, 70, sample_size=2, answer=([5.0], [True]), is_promising=False)

    report = ransac(location, replace(ONE_BY_ONE, batch_size=30), generator)

    assert (report.status, report.num_inliers) == ("success", 30)


def test_more_confidence_needs_more_samples(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]))

    report = ransac(location, replace(ONE_BY_ONE, confidence=1.0 - 1e-8), generator)

    assert report.num_samples == 65


def test_samples_of_which_only_some_are_good_enough_must_be_more(make_location, generator):
    """ln(1 - 0.9999) / ln(1 - 0.25 / 4)."""
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]), hits=4.0)

    assert ransac(location, ONE_BY_ONE, generator).num_samples == 143


def test_where_hardly_any_sample_is_good_enough_as_many_are_drawn_as_may_be(make_location, generator):
    options = RansacOptions(min_inliers=5, max_samples=500)

    report = ransac(make_location(20, 0, hits=math.inf), options, generator)

    assert report.num_samples == 500


def test_batches_double_up_to_their_limit_and_the_last_is_as_large_as_needed(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]))

    report = ransac(location, replace(ONE_BY_ONE, batch_size=4, max_batch_size=8), generator)

    assert report.num_samples == 33
    assert [tuple(batch.shape) for batch in location.samples] == [(4, 2), (8, 2), (8, 2), (8, 2), (5, 2)]


@pytest.mark.parametrize(("batch_size", "max_samples"), [(1, 7), (10, 50), (10, 45), (64, 10)])
def test_never_more_than_max_samples_are_drawn(make_location, generator, batch_size, max_samples):
    location = make_location(50, 50, answer=([5.0], [False]))
    options = replace(ONE_BY_ONE, batch_size=batch_size, max_batch_size=batch_size, max_samples=max_samples)

    report = ransac(location, options, generator)

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

    assert (report.status, report.detail, report.num_inliers) == ("success", "", 40)
    assert torch.equal(report.inliers, location.data < 50.0)
    assert float(report.model[0]) == pytest.approx(5.0, abs=0.3)


def test_the_cost_is_the_sum_of_squared_errors_truncated_at_max_error(make_location, generator):
    location = make_location(40, 60)

    report = ransac(location, replace(ONE_BY_ONE, max_error=1.5), generator)

    residual = (location.data - report.model).square().clamp(max=1.5**2)
    assert report.cost == pytest.approx(float(residual.sum()), rel=1e-12)


def test_the_nearer_of_two_models_with_the_same_inliers_wins(make_location, generator):
    location = make_location(40, 60, answer=([5.5, 5.01, 5.4], [True] * 3))

    report = ransac(location, ONE_BY_ONE, generator)

    assert float(report.model[0]) == pytest.approx(5.01)


def test_a_model_that_is_not_valid_never_wins(make_location, generator):
    location = make_location(40, 60, answer=([5.0, 5.2], [False, True]))

    report = ransac(location, ONE_BY_ONE, generator)

    assert float(report.model[0]) == pytest.approx(5.2)


def test_data_where_a_model_is_impossible_count_as_outliers(make_location, generator):
    location = make_location(40, 60, answer=([5.0], [True]))
    squared = location.squared_errors
    location.squared_errors = lambda models, rows: torch.where(
        torch.arange(100) < 30, torch.inf, squared(models, rows)
    ).to(models.dtype)

    report = ransac(location, ONE_BY_ONE, generator)

    assert report.num_inliers == 10
    assert math.isfinite(report.cost)


def test_the_leaders_of_every_batch_are_optimised_a_little_and_only_the_best_ever_thoroughly(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]))

    ransac(location, replace(ONE_BY_ONE, screening_size=50), generator)

    assert len(location.samples) == 33
    assert [thorough for *_, thorough in location.optimized] == [False, True] + 32 * [False]


def test_little_data_are_screened_whole(make_location, generator):
    location = make_location(50, 50, sample_size=2, answer=([5.0], [True]))

    ransac(location, replace(ONE_BY_ONE, screening_size=50), generator)

    assert all(rows is None for _, rows in location.screened)
    assert all(rows is None for _, rows, _ in location.optimized)


def test_many_data_are_screened_in_part_always_the_same(make_location, generator):
    location = make_location(50, 51, sample_size=2, answer=([5.0, 5.1], [True, True]))

    report = ransac(location, replace(ONE_BY_ONE, screening_size=50, batch_size=20, max_batch_size=20), generator)

    assert (report.num_samples, len(location.samples)) == (33, 2)
    assert [(count, len(rows)) for count, rows in location.screened] == [(40, 50), (26, 50)]
    assert all(torch.equal(rows, location.screened[0][1]) for _, rows in location.screened)
    on_part = [len(places) for places, rows, _ in location.optimized if rows is not None]
    assert on_part == [8, 8]
    assert [len(places) for places, rows, _ in location.optimized if rows is None] == [1]


@pytest.mark.parametrize("leaders", [1, 3])
def test_as_many_leaders_of_a_batch_are_optimised_as_asked_for_the_best_ones(make_location, generator, leaders):
    location = make_location(60, 40, answer=([5.6, 5.0, 5.4, 5.2], [True] * 4))

    ransac(location, replace(ONE_BY_ONE, leaders=leaders, max_samples=1), generator)

    places, _, thorough = location.optimized[0]
    assert not thorough
    assert places == pytest.approx([5.0, 5.2, 5.4][:leaders])


def test_what_the_optimisation_makes_of_a_leader_counts(make_location, generator):
    location = make_location(60, 40, answer=([5.6, 5.3], [True] * 2), better=lambda x: 5.0 if x > 5.5 else x)

    report = ransac(location, ONE_BY_ONE, generator)

    assert float(report.model[0]) == 5.0


def test_screening_is_more_lenient_than_the_verdict(make_location, generator):
    """At twice max_error a place beside 60 data beats one that 25 data lie on; at max_error it does not."""
    data = torch.cat((torch.zeros(60), 20.0 + torch.zeros(25))).double()
    location = Location(data, answer=([1.2, 20.0], [True] * 2))

    ransac(location, replace(ONE_BY_ONE, leaders=1, max_samples=1), generator)
    ransac(location, replace(ONE_BY_ONE, leaders=1, max_samples=1, screening_factor=1.0), generator)

    places = [places[0] for places, _, thorough in location.optimized if not thorough]
    assert places == pytest.approx([1.2, 20.0])


@pytest.mark.parametrize(("count", "sample_size", "min_inliers"), [(6, 2, 7), (6, 6, 1), (0, 1, 1)])
def test_too_few_data_are_reported_and_nothing_is_drawn(make_location, generator, count, sample_size, min_inliers):
    location = make_location(count, 0, sample_size=sample_size)

    report = ransac(location, replace(ONE_BY_ONE, min_inliers=min_inliers), generator)

    assert report.status == "too_few_data"
    assert f"only {count} data" in report.detail
    assert (report.num_samples, report.num_inliers, len(report.inliers), len(report.model)) == (0, 0, count, 0)
    assert not location.samples


def test_fewer_inliers_than_asked_for_are_no_consensus_and_no_model(make_location, generator):
    report = ransac(make_location(9, 91), replace(ONE_BY_ONE, min_inliers=10, max_samples=200), generator)

    assert (report.status, len(report.model), report.num_inliers) == ("no_consensus", 0, 9)
    assert report.detail == "only 9 of 100 data agree with the best model, but 10 must"


def test_without_any_valid_model_there_is_no_consensus(make_location, generator):
    location = make_location(50, 50, answer=([5.0], [False]))

    report = ransac(location, replace(ONE_BY_ONE, max_samples=20), generator)

    assert (report.status, report.num_inliers, report.num_samples) == ("no_consensus", 0, 20)


def test_a_model_that_its_inliers_do_not_determine_is_reported_and_not_returned(make_location, generator):
    location = make_location(40, 60, answer=([5.0], [True]), reason="all data lie on one point")

    report = ransac(location, ONE_BY_ONE, generator)

    assert (report.status, report.detail, len(report.model)) == ("degenerate", "all data lie on one point", 0)
    ((place, inliers),) = location.judged
    assert place == 5.0
    assert torch.equal(inliers, report.inliers)
    assert report.num_inliers == 40


def test_the_same_seed_gives_the_same_report(make_location):
    location = make_location(20, 80)

    one, two = (ransac(location, ONE_BY_ONE, torch.Generator().manual_seed(3)) for _ in range(2))

    assert (one.num_samples, one.cost) == (two.num_samples, two.cost)
    assert torch.equal(one.model, two.model)
    assert torch.equal(one.inliers, two.inliers)


@pytest.mark.parametrize("elements", [1, 700])
def test_scoring_models_in_chunks_changes_nothing(make_location, monkeypatch, elements):
    location = make_location(20, 80)
    options = replace(ONE_BY_ONE, batch_size=16)
    whole = ransac(location, options, torch.Generator().manual_seed(3))

    monkeypatch.setattr(msac, "SCORE_ELEMENTS", elements)
    chunked = ransac(location, options, torch.Generator().manual_seed(3))

    assert (chunked.num_samples, chunked.cost) == (whole.num_samples, whole.cost)
    assert torch.equal(chunked.model, whole.model)
    assert torch.equal(chunked.inliers, whole.inliers)
