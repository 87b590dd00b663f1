"""Figures of what was seen through walls and ports: which way is up in them, and what lies where."""

import math
from dataclasses import replace

import pytest
import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.figures.attitude import attitudes
from torchrefrac.figures.panels import from_side, oblique
from torchrefrac.figures.shift import shift_map, typical_range
from torchrefrac.figures.side_views import side_view, side_views_figure
from torchrefrac.files.capture import load_capture
from torchrefrac.files.library import embedded_scene
from torchrefrac.geometry import Rigid, so3_exp
from torchrefrac.scene import Interfaces, Observations, Scene
from torchrefrac.scene.wording import wording

DOUBLE = torch.float64
TOWARDS_WALL = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=DOUBLE))  # x right, y down is -y, z forward is -z


def _table(*rows):
    return torch.tensor(rows, dtype=DOUBLE)


def _scene(kind, rotation, center, points):
    towards = -1.0 if kind == "port" else 1.0
    one = (_table((0.0, 0.0, towards)), _table(-2.0 if kind == "port" else 0.0), _table(1.333))
    interfaces = Interfaces(*one, _table((1.52,)), _table((0.8,)), kinds=(kind,))
    count = len(points)
    seen = Observations(torch.zeros(count, dtype=torch.long), torch.arange(count), torch.zeros(count, 2, dtype=DOUBLE))
    lens = Intrinsics.create(640, 480, 400.0)
    return Scene.create(Rigid(rotation, center), lens, interfaces, points, seen, length_unit="cm")


def test_from_the_side_a_tank_lies_left_of_its_glass_and_the_cameras_right_with_up_upwards():
    points = _table((0.0, -20.0, -40.0), (5.0, 10.0, -1.0))
    scene = _scene("wall", TOWARDS_WALL[None], _table((0.0, 3.0, 50.0)), points)

    figure = side_views_figure([side_view("refractive", scene, None, {"gravity": "measured"})], None)

    panel = figure.axes[0]
    assert panel.collections[0].get_offsets().tolist() == [[-40.0, -20.0], [-1.0, 10.0]]
    marks = {line.get_marker(): line.get_xydata().tolist() for line in panel.lines}
    assert marks["^"] == [[50.0, 3.0]]
    assert marks["None"] == [[0.0, 0.0], [0.0, 1.0]]  # the glass, from the bottom of the panel to its top
    assert (panel.get_xlabel().split("\n")[0], panel.get_ylabel()) == ("before the glass (cm)", "up (cm)")
    assert [text.get_text() for text in figure.legends[0].texts] == ["cameras", "glass"]


def test_no_line_stands_for_a_port():
    scene = _scene("port", torch.eye(3, dtype=DOUBLE)[None], _table((0.0, 0.0, 1.0)), _table((0.0, 0.0, 60.0)))

    figure = side_views_figure([side_view("refractive", scene, None, {"gravity": "unknown"})], None)

    assert [line.get_marker() for line in figure.axes[0].lines] == ["^"]
    assert [text.get_text() for text in figure.legends[0].texts] == ["cameras"]
    assert figure.axes[0].get_ylabel() == "z (cm)"


def test_obliquely_a_tank_is_seen_from_above_and_from_its_front():
    side = from_side(None, wording("wall", upright=True))

    for frame in (side, oblique(side, -55.0)):
        torch.testing.assert_close(frame @ frame.mT, torch.eye(3, dtype=DOUBLE))
        assert float(torch.linalg.det(frame)) == pytest.approx(1.0)
        assert frame[1, 1] > 0.8  # y is upright
    towards = oblique(side, -55.0)[2]
    assert towards[1] > 0.4
    assert towards[2] > 0.4


def test_before_a_wall_roll_and_pitch_are_those_of_a_level_camera(generator):
    """A camera that looks at the wall, turned about its optical axis and down by known angles."""
    roll, pitch = math.radians(3.0), math.radians(10.0)
    turn = so3_exp(_table(0.0, 0.0, -roll)) @ so3_exp(_table(pitch, 0.0, 0.0))
    scene = _scene("wall", (turn @ TOWARDS_WALL)[None], _table((0.0, 0.0, 50.0)), _table((0.0, 0.0, -10.0)))
    capture = load_capture(embedded_scene("tank_small")).of_views([0])
    down = (turn @ TOWARDS_WALL @ _table(0.0, -1.0, 0.0))[None]
    known = {"gravity_in_cam": down, "down_in_cam": down, "gravity_sigma": capture.down_sigma}
    capture = replace(capture, names=scene.views.names, interfaces=scene.interfaces, **known)

    _, (rolls, pitches) = attitudes(scene, capture, None)

    for angle, axis in ((rolls, 0), (pitches, 2)):
        expected = math.degrees(math.asin(float(down[0, axis])))
        assert float(angle.estimated) == pytest.approx(expected, abs=1e-9)
        assert float(angle.measured) == pytest.approx(expected, abs=1e-9)
    assert abs(float(pitches.estimated)) == pytest.approx(10.0, abs=0.2)
    assert abs(float(rolls.estimated)) == pytest.approx(3.0, abs=0.2)


def test_the_shift_behind_a_port_is_that_of_points_at_their_median_distance_in_any_pose():
    points = _table((0.0, 0.0, 42.0), (1.0, 2.0, 82.0), (-3.0, 1.0, 62.0))
    turn, center = so3_exp(_table(0.3, -1.2, 0.7)), _table(10.0, -20.0, 5.0)
    at_rest = _scene("port", torch.eye(3, dtype=DOUBLE)[None], _table((0.0, 0.0, 0.0)), points)
    moved = _scene("port", turn.mT[None], center[None], points @ turn.mT + center)

    depth = typical_range(moved)
    assert depth == pytest.approx(60.0)
    pixels, shift, valid = shift_map(moved, 0, depth)
    assert valid.all()
    torch.testing.assert_close(shift, shift_map(at_rest, 0, depth)[1], rtol=0.0, atol=1e-8)
    radius = (pixels - _table(320.0, 240.0)).norm(dim=-1)
    # by Snell's law along one ray: through air, glass and water to the plane at that distance
    air = torch.atan(radius / 400.0)
    glass, water = torch.asin(air.sin() / 1.52), torch.asin(air.sin() / 1.333)
    across = 2.0 * air.tan() + 0.8 * glass.tan() + (depth - 0.8) * water.tan()
    straight = 400.0 * across / (2.0 + depth)
    torch.testing.assert_close(shift.norm(dim=-1), radius - straight, rtol=0.0, atol=1e-6)
