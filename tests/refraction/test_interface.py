"""The flat layers between camera and scene."""

import math
from dataclasses import replace

import pytest
import torch

from tests.refraction.interfaces import INTERFACES, TILTED, WALL
from tests.tolerances import DTYPES, assert_matches
from torchrefrac.geometry import Plane
from torchrefrac.refraction import FRESH_WATER, FlatInterface, water_index

NOT_AN_INDEX = [0.9, 0.0, -1.333, math.nan, math.inf]


@pytest.mark.parametrize("bad", [*NOT_AN_INDEX, torch.tensor([1.333, 0.9])])
def test_an_index_ratio_that_is_not_finite_or_below_one_is_refused(bad):
    with pytest.raises(ValueError, match=r"index_ratio is .* must be finite and at least 1"):
        FlatInterface(bad)


@pytest.mark.parametrize("bad", [*NOT_AN_INDEX, torch.tensor([1.333, math.nan])])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_layer_whose_index_is_not_finite_or_below_one_is_refused(bad, place):
    layers = [1.0, 1.52, 1.333]
    layers[place] = bad

    with pytest.raises(ValueError, match=r"layers is .* must be finite and at least 1"):
        FlatInterface(layers=layers, thickness=(0.1,))


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf, torch.tensor([0.1, -0.1])])
def test_a_thickness_that_is_negative_or_not_finite_is_refused(bad):
    with pytest.raises(ValueError, match=r"thickness is .* must be finite and at least 0"):
        FlatInterface(layers=(1.0, 1.52, 1.333), thickness=(bad,))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("index_ratio", {"index_ratio": torch.tensor(2)}),
        ("layers", {"layers": (1.0, torch.tensor([2]))}),
        ("layers", {"layers": torch.tensor([1, 2])}),
        ("thickness", {"layers": (1.0, 1.5, 1.3), "thickness": (torch.tensor([1]),)}),
    ],
)
def test_an_integer_tensor_is_refused_by_name(name, values):
    with pytest.raises(ValueError, match=rf"^{name} has dtype torch.int64"):
        FlatInterface(**values)


@pytest.mark.parametrize("thickness", [(), (0.1, 0.2), torch.tensor([0.1, 0.2])])
def test_every_inner_layer_needs_its_thickness(thickness):
    with pytest.raises(ValueError, match=rf"^thickness has length {len(thickness)}, but must have 1"):
        FlatInterface(layers=(1.0, 1.52, 1.333), thickness=thickness)


def test_one_surface_has_no_thickness():
    with pytest.raises(ValueError, match=r"^thickness has length 1, but must have 0"):
        FlatInterface(1.333, thickness=(0.1,))


@pytest.mark.parametrize("layers", [(), (1.333,), torch.tensor([1.333])])
def test_one_medium_is_not_an_interface(layers):
    with pytest.raises(ValueError, match=rf"^layers has length {len(layers)}, but must have at least 2"):
        FlatInterface(layers=layers)


def test_an_index_ratio_beside_layers_that_say_otherwise_is_refused():
    with pytest.raises(ValueError, match="index_ratio and layers disagree"):
        FlatInterface(1.333, layers=(1.0, 1.34))
    with pytest.raises(ValueError, match="index_ratio and layers disagree"):
        FlatInterface(torch.tensor([1.333, 1.34]), layers=(1.0, 1.333))


def test_an_index_ratio_beside_layers_that_agree_is_accepted():
    assert FlatInterface(1.5 / 1.25, layers=(1.25, 1.5)).index_ratio == 1.5 / 1.25


def test_shapes_that_do_not_broadcast_are_listed():
    with pytest.raises(ValueError, match=r"indices\[1\] \(2,\), thickness\[0\] \(3,\)"):
        FlatInterface(layers=(1.0, torch.full((2,), 1.5), 1.3), thickness=(torch.full((3,), 0.1),))


@pytest.mark.parametrize("wrong", [{"index_ratio": True}, {"layers": (True, 1.333)}])
def test_true_is_no_index(wrong):
    with pytest.raises(ValueError, match=r"^(index_ratio|layers) is True, but must be a number$"):
        FlatInterface(**wrong)


def test_nothing_given_is_fresh_water_at_zero():
    interface = FlatInterface()

    assert interface.index_ratio == FRESH_WATER
    assert interface.indices == (1.0, FRESH_WATER)
    assert interface.plane.normal == (0.0, 0.0, 1.0)
    assert interface.plane.offset == 0.0


def test_the_index_of_water_makes_an_interface():
    assert float(FlatInterface(water_index()).index_ratio) == pytest.approx(FRESH_WATER, abs=1e-4)


def test_a_glass_wall_is_air_glass_and_water():
    wall = FlatInterface.glass_wall(WALL, 0.01, index_ratio=1.34, glass_index=1.5)

    assert wall.indices == (1.0, 1.5, 1.34)
    assert wall.thickness == (0.01,)
    assert wall.index_ratio == 1.34
    assert wall.plane is WALL
    assert not wall.moves_with_camera


def test_a_flat_port_stands_before_the_camera_and_moves_with_it():
    port = FlatInterface.flat_port(0.05, 0.008)
    center, ahead = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.2, 0.05]], dtype=torch.float64)

    assert port.moves_with_camera
    assert port.indices == (1.0, 1.52, FRESH_WATER)
    assert_matches(port.plane.signed_distance(center), torch.tensor(0.05, dtype=torch.float64))
    assert_matches(port.plane.signed_distance(ahead), torch.tensor(0.0, dtype=torch.float64))


def test_a_slab_has_the_same_medium_on_both_sides():
    slab = FlatInterface.slab(TILTED, 0.2, index_ratio=1.5)

    assert slab.indices == (1.0, 1.5, 1.0)
    assert slab.thickness == (0.2,)
    assert slab.index_ratio == 1.0
    assert not slab.is_absent


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_index_ratio_follows_the_dtype_of_what_it_meets(dtype):
    index = FlatInterface(1.34).index_like(torch.zeros(3, dtype=dtype))

    assert index.dtype == dtype
    assert_matches(index, torch.tensor(1.34, dtype=dtype))


def test_the_gradient_reaches_an_index_ratio_that_is_estimated():
    ratio = torch.tensor(1.333, dtype=torch.float64, requires_grad=True)

    FlatInterface(ratio).index_like(torch.zeros(1, dtype=torch.float64)).backward()

    assert ratio.grad == 1.0


def test_another_index_ratio_changes_the_last_medium_and_nothing_else():
    port = FlatInterface(layers=(1.2, 1.52, 1.333), thickness=(0.1,), plane=TILTED, moves_with_camera=True)

    other = port.with_index_ratio(1.25)

    assert other.indices == (1.2, 1.52, 1.25 * 1.2)
    assert other.index_ratio == 1.25 * 1.2 / 1.2
    assert other.thickness == port.thickness
    assert other.plane is TILTED
    assert other.moves_with_camera
    assert FlatInterface(1.333, plane=TILTED).with_index_ratio(1.25).indices == (1.0, 1.25)


def test_layers_in_one_tensor_are_unbound_along_its_last_dimension(draw):
    index, thickness = draw.uniform(1.0, 1.5, 2, 3, 4), draw.uniform(0.1, 0.2, 3, 2)

    interface = FlatInterface(layers=index, thickness=thickness)

    assert interface.shape == (2, 3)
    assert torch.equal(interface.indices[1], index[..., 1])
    assert torch.equal(interface.thickness[1], thickness[..., 1])


def test_the_shape_is_what_everything_broadcasts_to(draw):
    plane = Plane(draw.normal(4, 1, 3), draw.normal(2))

    assert FlatInterface().shape == ()
    assert FlatInterface(draw.uniform(1.0, 1.5, 3)).shape == (3,)
    assert FlatInterface(draw.uniform(1.0, 1.5, 5, 1, 1), plane=plane).shape == (5, 4, 2)


@pytest.mark.parametrize(
    "index", [2, slice(1, 3), (0, 1), (slice(None), 0), ..., (..., 1), None, torch.tensor([3, 0, 3])], ids=str
)
def test_some_of_a_batch_are_those_that_indexing_each_value_gives(draw, index):
    batch = (4, 2)
    first, glass, thickness = draw.uniform(1.0, 1.5, 4, 1), draw.uniform(1.0, 1.5, 2), draw.uniform(0.1, 0.2, 4, 2)
    interface = FlatInterface(
        layers=(first, glass, 1.333), thickness=(thickness,), plane=Plane(draw.normal(4, 2, 3), 0.5)
    )

    some = interface.indexed(index, batch)

    assert torch.equal(some.indices[0], first.expand(batch)[index])
    assert torch.equal(some.indices[1], glass.expand(batch)[index])
    assert some.indices[2] == 1.333
    assert torch.equal(some.thickness[0], thickness[index])
    assert_matches(some.plane.normal[..., 1], interface.plane.normal[..., 1][index])
    assert some.plane.offset == 0.5


@pytest.mark.parametrize("interface", INTERFACES.values(), ids=INTERFACES.keys())
def test_numbers_belong_to_every_element_and_fit_every_dtype(interface):
    for same in (interface.indexed(3, (7,)), interface.to(dtype=torch.float32), interface.to(device="cpu")):
        assert same.indices == interface.indices
        assert same.thickness == interface.thickness
        assert same.plane.normal == pytest.approx(interface.plane.normal, abs=1e-15)
        assert same.plane.offset == interface.plane.offset
        assert same.moves_with_camera == interface.moves_with_camera


def test_tensors_are_moved_to_another_dtype(draw):
    ratio = FlatInterface(draw.uniform(1.0, 1.5, 3), plane=Plane(draw.normal(3), draw.normal(3)))
    layered = FlatInterface(layers=draw.uniform(1.0, 1.5, 3), thickness=draw.uniform(0.0, 1.0, 1))

    for interface in (ratio, layered):
        for value in interface.to(dtype=torch.float32).parameters(torch.zeros(1, dtype=torch.float32)):
            assert value.dtype == torch.float32
    assert ratio.to(dtype=torch.float32).index_ratio.dtype == torch.float32
    assert ratio.to(dtype=torch.float32).plane.normal.dtype == torch.float32
    assert layered.to(dtype=torch.float32).thickness[0].dtype == torch.float32


@pytest.mark.parametrize(
    ("interface", "absent"),
    [
        (FlatInterface(1.0), True),
        (FlatInterface(1), True),
        (FlatInterface(layers=(1.2, 1.2)), True),
        (FlatInterface(layers=(1.2, 1.2, 1.2), thickness=(0.1,)), True),
        (FlatInterface(1.333), False),
        (FlatInterface(layers=(1.0, 1.5, 1.0), thickness=(0.1,)), False),
        (FlatInterface(torch.tensor(1.0)), False),
        (FlatInterface(layers=(1.0, torch.tensor(1.0))), False),
    ],
)
def test_an_interface_is_known_to_be_absent_if_all_its_media_are_the_same_number(interface, absent):
    assert interface.is_absent == absent


def test_it_refracts_where_any_medium_differs_from_the_first():
    one, other = torch.tensor([[1.25, 1.25, 1.5], [1.25, 1.5, 1.25]])

    assert FlatInterface(torch.tensor([1.0, 1.333])).refracts().tolist() == [False, True]
    assert FlatInterface(layers=(1.25, one, other), thickness=(0.1,)).refracts().tolist() == [False, True, True]
    assert not FlatInterface(1.0).refracts()
    assert FlatInterface(layers=(1.0, 1.5, 1.0), thickness=(0.1,)).refracts()


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_number_is_the_same_index_as_that_number_in_a_tensor(dtype):
    index = torch.tensor([1.2, 1.333], dtype=dtype)

    assert FlatInterface(layers=(1.2, index)).refracts().tolist() == [False, True]
    assert FlatInterface(layers=(index, 1.333)).refracts().tolist() == [True, False]


@pytest.mark.parametrize(
    ("interface", "known"),
    [
        (FlatInterface(1.333), True),
        (FlatInterface(torch.tensor(1.333)), True),
        (FlatInterface(layers=(1.0, 1.52, 1.0), thickness=(0.1,)), True),
        (FlatInterface(layers=(1.2, 1.2)), True),
        (FlatInterface(layers=(1.333, 1.0)), False),
        (FlatInterface(layers=(1.333, 1.0, 1.333), thickness=(0.1,)), False),
        (FlatInterface(layers=(1.0, torch.tensor(1.333))), True),
        (FlatInterface(layers=(torch.tensor(1.0), 1.333)), False),
    ],
)
def test_the_camera_is_known_to_be_in_the_rarest_medium_if_numbers_say_so(interface, known):
    assert interface.camera_in_rarest == known


def test_parameters_are_the_plane_the_indices_and_the_thicknesses(draw):
    reference = torch.zeros(2, 3, dtype=torch.float32)

    normal, offset, air, glass, water, thickness = FlatInterface.glass_wall(WALL, 0.1).parameters(reference)

    assert_matches(normal, torch.tensor(WALL.normal))
    values = torch.stack((offset, air, glass, water, thickness))
    assert_matches(values, torch.tensor([-0.3, 1.0, 1.52, 1.333, 0.1]))


def test_a_copy_in_another_dtype_can_be_changed_further():
    for first in torch.linspace(1.0, 2.0, 50, dtype=torch.float64):
        single = FlatInterface(layers=(first, torch.tensor(1.333, dtype=torch.float64))).to(dtype=torch.float32)

        assert replace(single, plane=Plane((0.1, 0.0, 1.0))).index_ratio == single.index_ratio
