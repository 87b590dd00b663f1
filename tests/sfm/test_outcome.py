"""How steps end: enums whose values are sentences."""

from string import Formatter

import pytest

from torchrefrac.sfm import Adjustment, Filtering, Outcome, Registration, Start, Triangulation

KINDS = [*Start, *Registration, *Triangulation, *Filtering, *Adjustment]


SENTENCES = [
    (Start.DONE, {"points": 40}, "40 points are placed from the first two views"),
    (Start.NO_POSE, {}, "the matches of the pair do not determine its pose"),
    (
        Start.FEW_POINTS,
        {"points": 3, "needed": 12},
        "only 3 points can be placed from the pair, of which a start needs 12",
    ),
    (
        Registration.DONE,
        {"agreeing": 25, "seen": 30},
        "25 of the 30 reconstructed points that it sees agree with its pose",
    ),
    (
        Registration.FEW_POINTS,
        {"seen": 3, "needed": 20},
        "sees only 3 reconstructed points, of which a pose needs 20",
    ),
    (
        Registration.NO_POSE,
        {"agreeing": 2, "seen": 30},
        "no pose agrees with more than 2 of the 30 reconstructed points that it sees",
    ),
    (Triangulation.DONE, {"points": 5}, "5 points are placed"),
    (Triangulation.NOTHING, {}, "no point is seen by two registered views"),
    (Filtering.DONE, {"points": 5}, "5 points stay"),
    (Filtering.LOST_VIEWS, {"points": 5}, "5 points stay, but some views are left with next to none"),
    (Adjustment.CONVERGED, {}, "the adjustment converged"),
    (Adjustment.STOPPED, {}, "the adjustment stopped before it converged"),
]


@pytest.mark.parametrize(("kind", "numbers", "sentence"), SENTENCES)
def test_the_sentence_of_an_outcome_has_the_numbers_in_it(kind, numbers, sentence):
    assert str(Outcome(kind, numbers)) == sentence
    assert {name for _, name, _, _ in Formatter().parse(kind.value) if name} == set(numbers)


def test_every_kind_has_a_sentence_of_its_own():
    assert [kind for kind, _, _ in SENTENCES] == KINDS
    assert len({kind.value for kind in KINDS}) == len(KINDS)


def test_numbers_that_no_sentence_asks_for_do_no_harm():
    assert str(Outcome(Triangulation.DONE, {"points": 5, "seen": 9})) == "5 points are placed"


def test_a_step_is_done_where_it_did_what_it_is_for():
    done = [kind for kind in KINDS if Outcome(kind).done]

    assert done == [Start.DONE, Registration.DONE, Triangulation.DONE, Filtering.DONE, Adjustment.CONVERGED]
