"""Photographs that nothing joins with the others are a reconstruction of their own."""

from dataclasses import replace

import pytest
import torch

from torchrefrac.commands.results import further_results
from torchrefrac.commands.run_folder import RunFolder
from torchrefrac.commands.sparse import SparseStage
from torchrefrac.commands.verification import Verification, Verified
from torchrefrac.config import Options
from torchrefrac.features import MatchOptions
from torchrefrac.files.cameras import read_cameras
from torchrefrac.files.work import Work
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Survey, WarningCode
from torchrefrac.sfm import RefractiveInitializer, verify_pairs


@pytest.fixture
def stage_of(survey_of):
    """`stage_of(groups)`: the sparse stage of photographs of which only those of one group are matched."""

    def make(groups):
        survey, options = survey_of(cameras=len(groups), points=120), Options(matching=MatchOptions(pairs="sequence"))
        group, features, recorder = torch.tensor(groups), survey.features(), SilentRecorder()
        pairs = [pair for pair in survey.pairs() if group[pair.first] == group[pair.second]]
        capture, ratio, generator = survey.capture, survey.basin.index_ratio, torch.Generator().manual_seed(1)
        initializer = RefractiveInitializer(capture, ratio, options.sfm)
        verified = verify_pairs(pairs, features, initializer, 20, generator, recorder)
        verify = Verification(survey.pairs(), features, ratio, options, generator, recorder, Work())
        found = Verified(capture, initializer, options.sfm, verified)
        return SparseStage(verify, found, capture, capture, Survey.empty(capture.names)), survey

    return make


def test_each_group_is_reconstructed_and_the_largest_is_that_of_the_run(stage_of, tmp_path):
    stage, survey = stage_of([0, 1, 0, 1, 1, 0, 0, 2])

    scene = stage()

    (other,) = scene.further
    assert scene.views.registered.tolist() == [True, False, True, False, False, True, True, False]
    assert other.views.names == tuple(survey.capture.names[i] for i in (1, 3, 4))
    assert {name for name, why in scene.failures.items() if "of its own, the 2." in why} == set(other.views.names)
    (apart,) = (finding for finding in scene.findings if finding.code is WarningCode.SEVERAL_RECONSTRUCTIONS)
    assert apart.images == other.views.names
    true = survey.basin.center[[1, 3, 4]]
    scale = float(other.views.center[:, 2].mean() / true[:, 2].mean())
    found, wanted = (torch.cdist(center, center) for center in (other.views.center, scale * true))
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)

    files = RunFolder(tmp_path)
    files.metrics = {"status": "running", "stages": []}
    files.stage_done("sparse", scene, 1.0)
    assert files.metrics["reconstructions"] == {"reconstruction_2": 3}
    assert read_cameras(tmp_path / "reconstruction_2" / "cameras.json").views.names == other.views.names
    assert len(further_results(tmp_path)) == 3
    with files.recording():
        assert not (tmp_path / "reconstruction_2").exists()


def test_photographs_that_all_hang_together_are_one_reconstruction(stage_of):
    stage, _ = stage_of([0, 0, 0, 0])

    scene = stage()

    assert scene.further == ()
    assert replace(scene, further=()).views.registered.all()
