"""The growing model: its tables and its errors."""

from dataclasses import replace

import torch

from torchrefrac.sfm.model import SparseModel, pad_by_track


def test_observations_are_laid_out_with_one_line_a_track(survey_of):
    tracks = replace(survey_of().tracks, track=torch.tensor([0, 0, 2, 2, 2, 5]), num_tracks=6)

    ids, table, present = pad_by_track(tracks, torch.tensor([0, 2, 3, 4, 5]))

    assert ids.tolist() == [0, 2, 5]
    assert [row[mask].tolist() for row, mask in zip(table, present, strict=True)] == [[0], [2, 3, 4], [5]]


def test_no_observations_make_an_empty_table(survey_of):
    ids, table, present = pad_by_track(survey_of().tracks, torch.zeros(0, dtype=torch.long))

    assert len(ids) == len(table) == len(present) == 0


def test_at_the_truth_all_errors_are_those_of_the_observations(survey_of, draw):
    survey = survey_of()
    shift = draw.normal(len(survey.wrong), 2)
    model = survey.model(with_points=True)
    model = replace(model, tracks=replace(model.tracks, pixels=model.tracks.pixels + shift))

    torch.testing.assert_close(model.errors(), shift.norm(dim=-1), rtol=0.0, atol=1e-9)


def test_an_error_is_infinite_without_a_pose_without_a_point_and_behind_the_camera(survey_of):
    model = survey_of(cameras=3).model(with_points=True)
    points, has_point = model.points.clone(), torch.ones_like(model.has_point)
    points[0], has_point[1] = points.new_tensor((0.0, 0.0, 500.0)), False
    registered = torch.tensor([True, True, False])

    errors = replace(model, points=points, has_point=has_point, registered=registered).errors()

    impossible = (model.tracks.image == 2) | (model.tracks.track <= 1)
    assert torch.equal(errors == torch.inf, impossible)


def test_an_empty_model_has_no_images_no_points_and_infinite_errors(survey_of):
    survey = survey_of()

    model = SparseModel.empty(survey.tracks, 4, survey.capture.intrinsics, survey.index_ratio)

    assert model.num_registered == 0
    assert not model.has_point.any()
    assert (model.errors() == torch.inf).all()


def test_only_observations_of_registered_images_are_visible(survey_of):
    model = replace(survey_of(cameras=3).model(), registered=torch.tensor([True, False, True]))

    assert torch.equal(model.visible(), model.tracks.image != 1)
