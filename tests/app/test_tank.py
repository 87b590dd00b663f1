"""The paper's synthetic experiment in full: twelve ray-traced photographs against the truth (Table 1)."""

import math
from dataclasses import replace

import pytest
import torch

import torchrefrac as tr
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import rotate, so3_exp

MINIMUM_RATIO = 50.0


@pytest.fixture
def run_tank(torchrefrac, shared_data, metrics, tmp_path):
    def run(model, *more):
        folder = shared_data("tank")
        assert torchrefrac("scene=capture", f"scene.path={folder}", f"model={model}", *more, f"out={model}").status == 0
        return metrics(tmp_path / model)

    return run


@pytest.mark.slow
def test_refraction_places_the_cameras_better_than_the_paper_and_the_other_models_far_worse(run_tank):
    refractive, none, radial = (run_tank(model) for model in ("refractive", "none", "radial"))
    assert refractive["registered_images"] == 12
    assert refractive["camera_rms_cm"] <= 0.02
    assert refractive["surface_median_cm"] <= 0.05
    for other in (none, radial):
        assert other["registered_images"] == 12
        assert other["camera_rms_cm"] >= MINIMUM_RATIO * refractive["camera_rms_cm"]


@pytest.mark.slow
def test_an_index_ratio_that_starts_at_1_25_is_found_with_the_cameras(torchrefrac, shared_data, metrics, tmp_path):
    folder = shared_data("tank")
    options = ("water.index_ratio=1.25", "sfm.bundle.refine=[index_ratio]")
    assert torchrefrac("scene=capture", f"scene.path={folder}", *options, "out=free").status == 0
    found = metrics(tmp_path / "free")
    assert abs(found["index_ratio"] - 1.33) <= 0.003
    assert abs(found["index_ratio"] - 1.33) <= 3.0 * found["index_ratio_sigma"]
    assert found["registered_images"] == 12
    assert found["camera_rms_cm"] <= 0.02


@pytest.mark.slow
def test_gravity_that_is_four_degrees_off_costs_no_accuracy(shared_data, draw):
    folder = shared_data("tank")
    capture, truth = tr.load_capture(folder), load_truth(folder)
    sideways = torch.linalg.cross(-truth.rotation[..., 2], draw.directions(12))
    tilt = so3_exp(math.radians(4.0) * torch.nn.functional.normalize(sideways, dim=-1))
    wrong = replace(
        capture,
        down_in_cam=rotate(tilt, -truth.rotation[..., 2]),
        down_sigma=torch.full_like(capture.height, math.radians(4.0)),
    )
    found, _ = evaluate(tr.reconstruct(wrong), truth)
    assert found["camera_rms_cm"] <= 0.02


@pytest.mark.slow
def test_the_dense_surface_is_accurate_complete_and_flat_and_without_refraction_it_is_not(run_tank):
    refractive, none = (run_tank(model, "dense=patch") for model in ("refractive", "none"))
    assert refractive["dense_accuracy_within_0.2_cm"] >= 0.99
    assert refractive["dense_completeness_within_0.5_cm"] >= 0.95
    assert refractive["dense_plane_rms_cm"] <= 0.04
    assert 0.5 <= refractive["dense_error_over_sigma"] <= 1.5
    assert none["dense_plane_rms_cm"] >= MINIMUM_RATIO * refractive["dense_plane_rms_cm"]
