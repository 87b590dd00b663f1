"""The examples that come with the package, run as a reader would."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchrefrac
from torchrefrac.files.library import embedded_scene

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
RATIO = 1.33  # of the embedded scene, whose water level is 0


def _module(name):
    """That of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def example():
    """The module of examples/learn_water.py."""
    return _module("learn_water")


def test_a_few_steps_move_the_guess_of_the_index_ratio_towards_the_truth(example, monkeypatch, capsys):
    monkeypatch.setattr(example, "BLURS", (12.0,))
    monkeypatch.setattr(example, "PIXELS", 500)
    images, cameras, boards, _ = example.load()
    guess = torchrefrac.FlatInterface(1.25, plane=torchrefrac.Plane(offset=3.0))
    model = torchrefrac.LearnableCamera(replace(cameras, interface=guess), learn=example.LEARNT)

    example.learn_water(model, images, boards, steps=20)

    reports = _reports(capsys.readouterr().out)
    assert reports[0][:2] == (1.25, 3.0)
    assert abs(reports[-1][0] - RATIO) < 0.7 * abs(1.25 - RATIO)


@pytest.mark.slow
def test_water_and_focal_length_are_learnt_from_images(example, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["learn_water.py"])

    example.main()

    *_, learnt, truth = _reports(capsys.readouterr().out)
    assert truth[:2] == (RATIO, 0.0)
    assert abs(learnt[0] - RATIO) < 0.002
    assert abs(learnt[1]) < 0.1
    assert abs(learnt[2] / truth[2] - 1.0) < 0.0005


def test_what_a_match_is_worth_is_learnt_through_the_adjustment():
    example = _module("learn_match_weights")
    generator = torch.Generator().manual_seed(1)

    network = example.learn_weights("squared", 25, generator, triples=16)

    batch = example.draw_problems(100, generator)
    equal, _ = example.camera_errors(batch, batch.problems.weights, "squared")
    learnt, _ = example.camera_errors(batch, example.weights_of(network, batch.features), "squared")
    assert learnt.median() < 0.6 * equal.median()


@pytest.mark.slow
def test_learnt_weights_are_better_than_robust_losses_alone(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["learn_match_weights.py"])

    _module("learn_match_weights").main()

    median = {
        words[0]: float(words[1].split()[0])
        for line in capsys.readouterr().out.splitlines()
        if " mm" in line and (words := line.split("  ", 1))
    }
    assert median["learnt weights, squared"] < 0.4 * median["equal weights, squared"]
    assert median["learnt weights, cauchy"] < 0.95 * median["equal weights, cauchy"]


def test_own_ransac_finds_the_second_camera():
    example = _module("own_ransac")
    folder = torchrefrac.embedded_scene("tank_small")
    truth = torchrefrac.load_truth(folder)
    true_pose = example.relative(truth.rotation[:2], truth.center[:2])
    pair = example.matched(torchrefrac.load_capture(folder))

    pose, agrees = example.ransac(pair, 200, 3.0, torch.Generator().manual_seed(0))

    assert 0.8 < agrees.double().mean() < 0.95
    found = example.adjusted(pair, pose, agrees)
    rough, fine = ((each.center[1] - true_pose.center[1]).norm() for each in (pose, found))
    assert rough < 20.0  # cm, of a baseline of 30 above verticals half a degree off
    assert fine < 1.5


@torch.no_grad()
def test_a_gaussian_is_drawn_where_the_water_shows_it():
    example, capture = _module("gaussians"), torchrefrac.load_capture(embedded_scene("tank_small"))
    truth, water = torchrefrac.load_truth(embedded_scene("tank_small")), torchrefrac.FlatInterface(RATIO)
    camera = torchrefrac.RefractiveCamera(capture.cameras[0], truth.rotation[0], truth.center[0], water)
    camera = example.smaller(camera)
    off_middle = torch.tensor([10.3, -5.2], dtype=torch.float64)
    origin, direction, _ = camera.cast_rays(camera.intrinsics.principal_point + off_middle)
    point, lengths, color = origin + 30.0 * direction, torch.tensor([1.0, 0.5, 0.7]), torch.tensor([0.2, 0.5, 0.9])

    picture, cover = example.Gaussians(point[None].float(), torch.eye(3)[None], lengths[None], color[None])(camera)

    at, by, _ = camera.project_with_jacobians(point)
    covariance = by.point @ torch.diag(lengths.double().square()) @ by.point.mT + 0.3 * torch.eye(2).double()
    off = at.floor() + 0.5 - at
    opacity = torch.sigmoid(torch.tensor(2.0)) * torch.exp(-0.5 * off @ torch.linalg.solve(covariance, off))
    column, row = at.long().tolist()
    assert float(cover[row, column]) == float(cover.max()) == pytest.approx(float(opacity), rel=1e-4)
    torch.testing.assert_close(picture[row, column], opacity.float() * color, rtol=1e-4, atol=0.0)


def test_a_field_of_a_level_surface_is_seen_where_rays_meet_it(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    example = _module("radiance_field")
    points = torch.cat((400.0 * torch.rand(100, 2) - 200.0, torch.full((100, 1), -50.0)), dim=1)
    field = example.Field(points).eval()
    direction = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, -1.0], [0.3, -0.2, -1.0]]), dim=1)
    rays = example.Lines(torch.zeros(2, 3), direction, torch.zeros(2, 3))

    color, end = field.rendered(rays, 0.3)

    torch.testing.assert_close(end, direction * (-50.0 / direction[:, 2:]), rtol=0.0, atol=0.2)
    torch.testing.assert_close(color, torch.full((2, 3), 0.5))


@pytest.mark.slow
def test_refraction_is_worth_decibels_to_a_radiance_field(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.setattr(sys, "argv", ["radiance_field.py", "--out", str(tmp_path)])

    _module("radiance_field").main()

    _, *lines = capsys.readouterr().out.splitlines()
    with_it, without, wrong = ([float(word) for word in line[24:].split()[::2]] for line in lines)
    assert with_it[0] > without[0] + 1.5  # dB
    assert with_it[0] > wrong[0] + 6.0
    assert with_it[1] < 0.3  # cm, median of heights
    assert min(without[1], wrong[1]) > 5.0
    assert (tmp_path / "radiance_field.jpg").stat().st_size < 200_000


def _reports(printed):
    """Index ratio, water level and focal length of every line."""
    return [(float(words[-5]), float(words[-2]), float(words[-9])) for words in map(str.split, printed.splitlines())]
