"""Water under photographs that are reconstructed without refraction."""

from dataclasses import replace

import pytest

from tests.sfm.test_reconstruct_sparse import reconstruct
from torchrefrac.evaluate.consistency import contradictions
from torchrefrac.sfm import errors_in_air_and_water


@pytest.mark.parametrize(("index_ratio", "codes"), [(1.33, ["refraction_unmodelled"]), (1.0, [])])
def test_a_run_in_air_is_told_of_water_where_there_is_some(survey_of, index_ratio, codes):
    survey = survey_of(cameras=4, points=120, noise=0.1, gravity_error_deg=0.5, index_ratio=index_ratio)
    scene = reconstruct(replace(survey, basin=replace(survey.basin, index_ratio=1.0)))

    found = errors_in_air_and_water(scene, survey.capture)

    assert found is not None
    air, water = found
    assert water < 0.2 < air if codes else water > 0.8 * air
    scene = replace(scene, assessment=replace(scene.assessment, in_air_and_water=found))
    assert [str(finding.code) for finding in contradictions(scene, survey.capture)] == codes


def test_without_gravity_or_points_nobody_can_tell(survey_of):
    survey = survey_of()
    assert errors_in_air_and_water(survey.scene(with_points=True), replace(survey.capture, has_gravity=False)) is None
    assert errors_in_air_and_water(survey.tracks(), survey.capture) is None
