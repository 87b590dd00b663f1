"""The paper's figures, of several models: what their panels hold."""

import numpy as np
import pytest
import torch

from tests.html.html_runs import Planted
from torchrefrac.figures.attitude import Angle, models_attitude_figure
from torchrefrac.figures.paper import paths_figure, photograph_and_models_figure, setup_figure
from torchrefrac.figures.side_views import side_view
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.scene.wording import OF_WATER

STYLES = {"one": {"color": "#d55e00", "marker": "o"}, "other": {"color": "#0072b2", "marker": "D"}}


@pytest.fixture
def scene(tmp_path, generator):
    return Planted(tmp_path, generator).scene(1.33)


@pytest.fixture(scope="module")
def truth():
    return load_truth(embedded_scene("tank_small"))


@pytest.fixture(scope="module")
def photograph():
    return load_capture(embedded_scene("tank_small")).paths[0]


def test_each_angle_has_all_models_and_the_imu_on_one_branch_in_one_plot():
    known = torch.tensor((10.0, 20.0, 30.0), dtype=torch.float64)
    images = torch.arange(3)
    found = {
        "one": (images, [Angle(name, known + 1.0, known, None) for name in ("roll", "pitch", "heading")]),
        "other": (images, [Angle(name, known - 358.0, known, None) for name in ("roll", "pitch", "heading")]),
    }

    figure = models_attitude_figure(found, STYLES, 3)

    assert len(figure.axes) == 6
    for values, errors in zip(figure.axes[::2], figure.axes[1::2], strict=True):
        drawn = [line.get_ydata() for line in values.get_lines()]
        assert np.allclose(drawn, [known + 1.0, known + 2.0, known])
        drawn = [line.get_ydata() for line in errors.get_lines()[1:]]
        assert np.allclose(drawn, [np.full(3, 1.0), np.full(3, 2.0)])
        assert "°" in values.get_ylabel()
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "other", "measured (IMU)"]


def test_a_photograph_and_all_models_have_a_letter_each_and_one_scale(scene, truth, photograph):
    views = [side_view(model, scene, None, {}) for model in ("none", "radial", "refractive")]

    figure = photograph_and_models_figure(photograph, views, truth)

    titles = [panel.get_title() for panel in figure.axes[:4]]
    assert titles == ["(a) A photograph", "(b) No refraction", "(c) Radial distortion", "(d) Refraction"]
    assert figure.axes[0].get_images()[0].get_array().shape == (480, 640, 3)
    assert len({(panel.get_xlim(), panel.get_ylim()) for panel in figure.axes[1:4]}) == 1
    assert all("(cm)" in panel.get_xlabel() for panel in figure.axes[1:4])


def test_the_setup_shows_every_plane_the_water_and_every_camera(scene, truth, photograph):
    figure = setup_figure(scene, truth, photograph, OF_WATER)

    setup, picture = figure.axes
    assert len(setup.patches) == len(truth.corner) + 1
    assert len(setup.collections[0].get_segments()) == 4 * scene.views.num_registered
    assert picture.get_title() == "(b) A photograph"


def test_paths_of_models_stand_side_by_side_on_one_scale(scene, truth):
    figure = paths_figure({"one": scene, "other": scene, "third": scene}, truth, OF_WATER)

    above, below = figure.axes[:3], figure.axes[3:6]
    assert [panel.get_title() for panel in above] == ["(a) one", "(b) other", "(c) third"]
    for row in (above, below):
        assert len({(panel.get_xlim(), panel.get_ylim()) for panel in row}) == 1
    assert all(panel.get_xlabel() == "horizontal (cm)" for panel in below)
