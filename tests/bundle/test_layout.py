"""Where the unknowns are, and what a step does to them."""

from itertools import product

import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.bundle.bundle_oracles import moved, num_unknowns
from tests.bundle.changes import tensor_of
from tests.tolerances import assert_matches
from torchrefrac.bundle import KnownPoints
from torchrefrac.bundle.layout import Layout
from torchrefrac.bundle.rows import INTRINSICS

OF_WATER = ("index_ratio", "plane_tilt", "plane_height")

SOME = ((), ("focal",), ("radial", "principal_point"), ("focal", "principal_point", "distortion"))
WATERS = ((), ("index_ratio",), ("plane_height",), ("plane_tilt", "index_ratio"), OF_WATER)
every_refinement = pytest.mark.parametrize(
    "refine", [(*intrinsics, *water) for intrinsics, water in product(SOME, WATERS)]
)


@every_refinement
@pytest.mark.parametrize("reduced", [False, True], ids=["points eliminated", "some points reduced"])
def test_columns_are_a_bijection_of_all_that_varies(plant, refine, reduced):
    planted = plant(cameras=2, interfaces=2)
    layout = planted.layout(refine, terms=_known(planted, 2, 11, 5) if reduced else ())

    columns = torch.cat([part.flatten() for part in _columns(layout).values()])

    columns = columns[columns < layout.size]
    assert columns.sort().values.tolist() == list(range(layout.size))
    assert layout.size == planted.problem(refine=refine, terms=_known(planted, 2, 11, 5) if reduced else ()).plan.size


@every_refinement
def test_the_columns_of_an_observation_are_those_that_the_solver_takes(plant, refine):
    planted = plant(cameras=2, interfaces=2)
    problem = planted.problem(refine=refine)
    layout, images = problem.layout, torch.arange(4)

    columns = [layout.pose_columns(images)]
    columns += [layout.intrinsics_columns(name, planted.truth.views.camera) for name in layout.intrinsics]
    columns += [
        torch.full((4, 1), layout.medium_column("index_ratio")),
        layout.plane_columns(planted.truth.views.interface),
    ]

    columns = torch.cat(columns, dim=1)
    varying = columns[0] < layout.size
    assert torch.equal(problem.plan.columns, columns[:, varying])
    assert problem.rows_of.layout.reduced.stop == int(varying.sum())


def test_what_is_fixed_is_found_in_the_one_column_behind_all_others(plant):
    planted = plant(interfaces=2)
    fixed = torch.zeros(4, 6, dtype=torch.bool)
    fixed[2, 3:], fixed[1, 0] = True, True

    layout = planted.layout(("plane_tilt",), fixed=fixed)

    columns = layout.pose_columns(torch.arange(4))
    assert torch.equal(columns == layout.size, fixed)
    assert (columns[~fixed] == torch.arange(24)[~fixed.flatten()]).all()
    assert (layout.plane_columns(torch.arange(2))[:, 2] == layout.size).all()
    assert layout.medium_column("index_ratio") == layout.size


def test_fixed_poses_of_which_none_is_fixed_are_as_good_as_none(plant):
    assert plant().layout(fixed=torch.zeros(4, 6, dtype=torch.bool)).fixed is None


def test_a_step_of_zero_changes_nothing_to_the_last_bit(plant):
    planted = plant(cameras=2, interfaces=2)
    layout = planted.layout((*SOME[-1], *WATERS[-1]), terms=_known(planted, 4))

    state = moved(layout, planted.truth, torch.zeros(num_unknowns(layout), dtype=torch.float64))

    for name in ("rotation", "center", "points", "index_ratio", "offset"):
        assert torch.equal(tensor_of(state, name), tensor_of(planted.truth, name)), name
    for name in ("focal", "principal_point", "distortion"):
        assert torch.equal(tensor_of(state, name), tensor_of(planted.truth, name)), name
    assert_matches(state.interfaces.normal, planted.truth.interfaces.normal)


def test_a_step_moves_each_unknown_as_its_columns_say(plant, draw):
    planted = plant(cameras=2, interfaces=2)
    layout = planted.layout((*SOME[-1], *WATERS[-1]), terms=_known(planted, 7, 4))
    step = 0.1 * draw.normal(num_unknowns(layout))
    by = {name: step[columns] for name, columns in _columns(layout).items()}

    state, truth = moved(layout, planted.truth, step), planted.truth

    turn = torch.from_numpy(Rotation.from_rotvec(by["pose"][:, :3].numpy()).as_matrix())
    assert_matches(state.views.rotation, turn @ truth.views.rotation, slack=10.0)
    assert_matches(state.views.center, truth.views.center + by["pose"][:, 3:])
    assert_matches(state.cameras.focal, truth.cameras.focal * by["focal"].exp())
    assert_matches(state.cameras.principal_point, truth.cameras.principal_point + by["principal_point"])
    assert_matches(state.cameras.distortion[:, :5], truth.cameras.distortion[:, :5] + by["distortion"])
    assert not state.cameras.distortion[:, 5:].any()
    assert_matches(state.interfaces.index_ratio, truth.interfaces.index_ratio + by["index_ratio"][0])
    first, second = _tangents(truth)
    axis = by["plane"][:, :1] * first + by["plane"][:, 1:2] * second
    turn = torch.from_numpy(Rotation.from_rotvec(axis.numpy()).as_matrix())
    assert_matches(state.interfaces.normal, (turn @ truth.interfaces.normal[..., None])[..., 0], slack=10.0)
    assert_matches(state.interfaces.offset, truth.interfaces.offset + by["plane"][:, 2])
    reduced = torch.zeros(30, dtype=torch.bool)
    reduced[[4, 7]] = True
    assert_matches(state.points[[4, 7]], truth.points[[4, 7]] + by["points"])
    assert_matches(state.points[~reduced], truth.points[~reduced] + step[layout.size :].view(-1, 3))


def test_the_first_two_radial_terms_alone_move_where_radial_is_free(plant, draw):
    planted = plant(distortion=(-0.1, 0.03, 0.001, -0.002, 0.01))
    layout = planted.layout(("radial",))

    state = moved(layout, planted.truth, draw.normal(num_unknowns(layout)))

    assert torch.equal(state.cameras.distortion[:, 2:], planted.truth.cameras.distortion[:, 2:])
    assert (state.cameras.distortion[:, :2] != planted.truth.cameras.distortion[:, :2]).all()


def test_points_that_are_fixed_do_not_move(plant, draw):
    planted = plant()
    layout = Layout.create(planted.truth, fix_points=True)

    state = moved(layout, planted.truth, draw.normal(num_unknowns(layout)))

    assert state.points is planted.truth.points


def test_a_name_that_is_not_known_is_refused(plant):
    with pytest.raises(
        ValueError, match="refine has 'zoom', but knows focal, principal_point, radial, distortion, ind"
    ):
        plant().layout(("focal", "zoom"))


def test_radial_beside_distortion_is_refused(plant):
    with pytest.raises(ValueError, match="refine has radial and distortion, but the first is part of the second"):
        plant().layout(("radial", "distortion"))


def _columns(layout):
    columns = {"pose": layout.pose_columns(torch.arange(layout.num_views))}
    columns |= {
        name: layout.intrinsics_columns(name, layout.cameras) for name in INTRINSICS if name in layout.intrinsics
    }
    columns |= {
        "index_ratio": torch.tensor([layout.medium_column("index_ratio")]),
        "plane": layout.plane_columns(layout.interfaces),
    }
    if layout.reduced is not None:
        columns["points"] = layout.point_columns(layout.reduced.nonzero()[:, 0])
    return columns


def _known(planted, *points):
    index = torch.tensor(points)
    return [KnownPoints(index, planted.truth.points[index], torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3))]


def _tangents(state):
    """Unit vectors in the planes, right-handed with the normals: x and y turned by the least rotation from z (E, 3)."""
    axes = []
    for normal in state.interfaces.normal:
        axis = torch.linalg.cross(normal.new_tensor((0.0, 0.0, 1.0)), normal)
        angle = torch.atan2(axis.norm(), normal[2])
        turn = Rotation.from_rotvec((angle * torch.nn.functional.normalize(axis, dim=0)).numpy())
        axes.append(torch.from_numpy(turn.as_matrix()))
    turns = torch.stack(axes)
    return turns[..., 0], turns[..., 1]
