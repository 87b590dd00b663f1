"""Measurements besides the pixels: residuals by their definition, derivatives by autograd."""

import pytest
import torch

from tests.bundle.bundle_oracles import jacobian_of, moved, num_unknowns
from tests.bundle.changes import changed
from tests.tolerances import assert_matches
from torchrefrac.bundle import (
    CenterPrior,
    Expectations,
    GravityPrior,
    HeightPrior,
    KnownPoints,
    ScaleBars,
    WaterLevels,
    Waterline,
    WaterSlope,
)
from torchrefrac.bundle.rows import INTRINSICS
from torchrefrac.bundle.terms import GlobalPrior, concerned_points

INTRINSICS_NAMES = ("focal", "principal_point", "distortion")
WATER = ("index_ratio", "plane_tilt", "plane_height")
LAYERS = ("layer_index", "layer_thickness")
TWO = torch.tensor((2, 0))
SIGMA = torch.tensor((0.5, 2.0), dtype=torch.float64)
UP = torch.nn.functional.normalize(torch.tensor((0.1, -0.2, 1.0), dtype=torch.float64), dim=0)
AXES = torch.nn.functional.normalize(torch.tensor(((2.0, 1.0, 0.0), (-1.0, 2.0, 0.5)), dtype=torch.float64), dim=1)
MEASURED = (
    "gravity", "gravity of some", "gravity in a frame that slopes", "centre", "height", "known points", "scale bars",
    "waterline", "levels", "slope",
)  # fmt: skip
every_measurement = pytest.mark.parametrize("name", MEASURED)


@pytest.fixture
def measure(draw):
    """`measure(name, planted)`: that measurement of the planted scene with an error, its definition as a function of
    the state and how often it varies."""

    def make(name, planted):
        truth, error = planted.truth, draw.normal(2)
        spread = draw.normal(2, 3, 3)
        information = spread @ spread.mT + torch.eye(3, dtype=torch.float64)
        position = draw.normal(2, 3)
        down, some = (
            planted.down_in_cam,
            torch.nn.functional.normalize(planted.down_in_cam[TWO] + 0.1 * position, dim=1),
        )
        one = torch.tensor((4, 9)), torch.tensor((9, 1))
        world_down = torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64)
        on = planted.truth.views.interface[TWO]

        def above(state, places, plane):
            return (places * state.interfaces.normal[plane]).sum(dim=1) - state.interfaces.offset[plane]

        return (
            {
                "gravity": (GravityPrior(down, 0.02), lambda s: (s.views.rotation @ world_down - down) / 0.02),
                "gravity of some": (
                    GravityPrior(some, SIGMA, TWO),
                    lambda s: (s.views.rotation[TWO] @ world_down - some) / SIGMA[:, None],
                ),
                "gravity in a frame that slopes": (
                    GravityPrior(some, SIGMA, TWO, UP),
                    lambda s: (-s.views.rotation[TWO] @ UP - some) / SIGMA[:, None],
                ),
                "slope": (
                    WaterSlope(AXES, SIGMA),
                    lambda s: (s.interfaces.normal[:, None] * AXES).sum(dim=-1) / SIGMA,
                ),
                "centre": (CenterPrior(TWO, position, information), lambda s: s.views.center[TWO] - position),
                "height": (
                    HeightPrior(TWO, 30.0 + error, SIGMA),
                    lambda s: (above(s, s.views.center[TWO], on) - 30.0 - error) / SIGMA,
                ),
                "known points": (KnownPoints(TWO, position, information), lambda s: s.points[TWO] - position),
                "scale bars": (
                    ScaleBars(*one, 20.0 + error, SIGMA),
                    lambda s: ((s.points[one[0]] - s.points[one[1]]).norm(dim=1) - 20.0 - error) / SIGMA,
                ),
                "waterline": (Waterline(TWO, on, SIGMA), lambda s: above(s, s.points[TWO], on) / SIGMA),
                "levels": (WaterLevels(on, position, SIGMA), lambda s: above(s, position, on) / SIGMA),
            }[name],
            information,
            truth,
        )

    return make


@every_measurement
def test_the_residuals_are_those_of_the_definition_in_standard_deviations(plant, disturb, measure, name):
    planted = plant(cameras=2, interfaces=2)
    (term, definition), information, _ = measure(name, planted)
    layout, state = planted.layout(WATER, terms=[term]), disturb(planted.truth)

    value = term.residuals(state, layout).value

    if name in ("centre", "known points"):
        off = definition(state)
        expected = torch.einsum("ki,kij,kj->k", off, information, off)
        assert_matches(value.square().sum(dim=1), expected, slack=10.0)
    else:
        assert_matches(value.flatten(), definition(state).flatten(), slack=100.0)


@every_measurement
@pytest.mark.parametrize("water", [WATER, ("plane_height",), ()], ids=["free water", "free level", "fixed water"])
def test_the_derivatives_are_those_of_autograd_through_the_retraction(plant, disturb, measure, name, water):
    planted = plant(cameras=2, interfaces=2)
    (term, _), *_ = measure(name, planted)

    _assert_jacobian_of_autograd(planted, term, disturb(planted.truth), (*INTRINSICS_NAMES, *water))


@every_measurement
def test_what_is_fixed_has_no_derivative(plant, measure, name):
    planted = plant(interfaces=2)
    (term, _), *_ = measure(name, planted)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[0], fixed[2, 1], fixed[2, 5] = True, True, True

    _assert_jacobian_of_autograd(planted, term, planted.truth, WATER, fixed)


@pytest.mark.parametrize("name", [*INTRINSICS, *WATER])
@pytest.mark.parametrize(("cameras", "interfaces"), [(1, 1), (2, 2)], ids=["one camera", "two cameras and waters"])
def test_the_derivatives_of_what_is_expected_are_those_of_autograd(plant, draw, name, cameras, interfaces):
    planted = plant(cameras=cameras, interfaces=interfaces)
    refine = ("radial" if name == "radial" else "distortion", "focal", "principal_point", *WATER)
    layout = planted.layout(refine)
    state = moved(layout, planted.truth, 0.05 * draw.normal(num_unknowns(layout)))

    _assert_jacobian_of_autograd(planted, GlobalPrior(name, planted.truth, 0.3), state, refine)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("focal", 0.05),
        ("principal_point", 7.0),
        ("radial", 0.02),
        ("distortion", 0.02),
        ("index_ratio", 0.01),
        ("plane_tilt", 0.03),
        ("plane_height", 2.5),
    ],
)
def test_what_is_expected_counts_how_many_standard_deviations_the_start_is_away(plant, name, expected):
    """Each changed by `expected`, which is also its standard deviation: relative, in pixels, radians or centimetres."""
    planted = plant(cameras=2, interfaces=2)
    truth, layout = (
        planted.truth,
        planted.layout(("radial" if name == "radial" else "distortion", "focal", "principal_point", *WATER)),
    )
    step = torch.zeros(num_unknowns(layout), dtype=torch.float64)
    both = torch.arange(2)
    if name in INTRINSICS:
        columns = layout.intrinsics_columns(name, both)
    elif name == "index_ratio":
        columns = torch.tensor([layout.medium_column("index_ratio")])
    else:
        columns = layout.plane_columns(both)[:, :1] if name == "plane_tilt" else layout.plane_columns(both)[:, 2:]
    step[columns] = expected

    value = GlobalPrior(name, truth, expected).residuals(moved(layout, truth, step), layout).value

    counted = value[..., 0] if name == "plane_tilt" else value
    torch.testing.assert_close(counted, torch.ones_like(counted), rtol=1e-3, atol=0.0)
    assert name != "plane_tilt" or value[..., 1].abs().amax() < 1e-12


def test_the_standard_deviation_of_each_kind_of_unknown_is_that_of_its_field():
    expected = Expectations(0.1, 2.0, 0.03, 0.004, 3.0, 0.6, 0.02, 0.05)

    sigmas = {name: expected.sigma_of(name) for name in (*INTRINSICS, *WATER, *LAYERS)}

    tilt = sigmas.pop("plane_tilt")
    assert sigmas == {
        "focal": 0.1,
        "principal_point": 2.0,
        "radial": 0.03,
        "distortion": 0.03,
        "index_ratio": 0.004,
        "plane_height": 0.6,
        "layer_index": 0.02,
        "layer_thickness": 0.05,
    }
    assert tilt == pytest.approx(3.0 * torch.pi / 180.0)


@pytest.mark.parametrize("name", [*INTRINSICS, *WATER])
def test_nothing_is_expected_of_what_is_not_named(name):
    assert Expectations().sigma_of(name) is None


def test_points_that_measurements_concern_are_those_of_control_points_bars_and_waterlines(plant):
    planted = plant(points=9)
    one = torch.ones(1, dtype=torch.float64)
    index = {k: torch.tensor([k]) for k in (1, 4, 5, 8)}
    terms = [
        planted.gravity,
        HeightPrior(index[1], 30.0 * one, one),
        KnownPoints(index[4], planted.truth.points[4:5], torch.eye(3, dtype=torch.float64)[None]),
        ScaleBars(index[5], index[4], one, one),
        Waterline(index[8], torch.zeros(1, dtype=torch.long), one),
    ]

    mask = concerned_points(terms, planted.truth.points)

    assert mask.nonzero()[:, 0].tolist() == [4, 5, 8]
    assert concerned_points(terms[:2], planted.truth.points) is None


def test_a_bar_of_no_length_is_finite(plant):
    planted = plant()
    one = torch.ones(1, dtype=torch.float64)
    term = ScaleBars(torch.tensor([3]), torch.tensor([4]), one, one)
    points = planted.truth.points.clone()
    points[3] = points[4]

    residuals = term.residuals(changed(planted.truth, points=points), planted.layout(terms=[term]))

    assert residuals.value.tolist() == [[-1.0]]
    assert residuals.jacobian.isfinite().all()


def _assert_jacobian_of_autograd(planted, term, state, refine, fixed=None):
    layout = planted.layout(refine, terms=[term], fixed=fixed)

    value, jacobian, columns = term.residuals(state, layout)

    width = num_unknowns(layout)
    across = torch.zeros(len(value), value.shape[1], max(layout.size, width) + 1, dtype=torch.float64)
    across.scatter_add_(2, columns[:, None].expand_as(jacobian), jacobian)
    across[..., layout.size] = 0.0  # what is fixed, whose column is the first point's
    expected = jacobian_of(lambda at: term.residuals(at, layout).value.flatten(), layout, state)
    size = expected.abs().amax().clamp(min=1.0)
    assert_matches(across.flatten(0, 1)[:, :width] / size, expected / size, slack=100.0)
