"""Where the unknowns are, and what a step does to them."""

from itertools import product

import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.bundle.bundle_oracles import moved, num_unknowns
from tests.tolerances import assert_matches
from torchrefrac.bundle import KnownPoints
from torchrefrac.bundle.layout import WATER_WIDTH, Layout
from torchrefrac.bundle.rows import LENS

LENSES = ((), ("focal",), ("radial", "principal_point"), ("focal", "principal_point", "distortion"))
WATERS = ((), ("index_ratio",), ("plane_height",), ("plane_tilt", "index_ratio"), tuple(WATER_WIDTH))
every_refinement = pytest.mark.parametrize("refine", [(*lens, *water) for lens, water in product(LENSES, WATERS)])


@every_refinement
@pytest.mark.parametrize("kept", [False, True], ids=["points eliminated", "some points kept"])
def test_columns_are_a_bijection_of_all_that_varies(plant, refine, kept):
    planted = plant(lenses=2, planes=2)
    layout = planted.layout(refine, terms=_known(planted, 2, 11, 5) if kept else ())

    columns = torch.cat([part.flatten() for part in _columns(layout).values()])

    columns = columns[columns < layout.size]
    assert columns.sort().values.tolist() == list(range(layout.size))
    assert layout.size == planted.problem(refine=refine, terms=_known(planted, 2, 11, 5) if kept else ()).plan.size


@every_refinement
def test_the_columns_of_an_observation_are_those_that_the_solver_takes(plant, refine):
    planted = plant(lenses=2, planes=2)
    problem = planted.problem(refine=refine)
    layout, images = problem.layout, torch.arange(4)

    columns = [layout.pose_columns(images)]
    columns += [layout.lens_columns(name, planted.links.lens) for name in layout.lens]
    columns += [torch.full((4, 1), layout.index_column()), layout.plane_columns(planted.links.plane)]

    columns = torch.cat(columns, dim=1)
    varying = columns[0] < layout.size
    assert torch.equal(problem.plan.columns, columns[:, varying])
    assert problem.rows_of.layout.reduced.stop == int(varying.sum())


def test_what_is_held_is_found_in_the_one_column_behind_all_others(plant):
    planted = plant(planes=2)
    held = torch.zeros(4, 6, dtype=torch.bool)
    held[2, 3:], held[1, 0] = True, True

    layout = planted.layout(("plane_tilt",), held=held)

    columns = layout.pose_columns(torch.arange(4))
    assert torch.equal(columns == layout.size, held)
    assert (columns[~held] == torch.arange(24)[~held.flatten()]).all()
    assert (layout.plane_columns(torch.arange(2))[:, 2] == layout.size).all()
    assert layout.index_column() == layout.size


def test_held_poses_of_which_none_is_held_are_as_good_as_none(plant):
    assert plant().layout(held=torch.zeros(4, 6, dtype=torch.bool)).held is None


def test_a_step_of_zero_changes_nothing_to_the_last_bit(plant):
    planted = plant(lenses=2, planes=2)
    layout = planted.layout((*LENSES[-1], *WATERS[-1]), terms=_known(planted, 4))

    state = moved(layout, planted.truth, torch.zeros(num_unknowns(layout), dtype=torch.float64))

    for name in ("rotation", "center", "points", "index_ratio", "offset"):
        assert torch.equal(getattr(state, name), getattr(planted.truth, name)), name
    for name in ("focal", "principal_point", "distortion"):
        assert torch.equal(getattr(state.lens, name), getattr(planted.truth.lens, name)), name
    assert_matches(state.planes[0], planted.truth.planes[0])


def test_a_step_moves_each_unknown_as_its_columns_say(plant, draw):
    planted = plant(lenses=2, planes=2)
    layout = planted.layout((*LENSES[-1], *WATERS[-1]), terms=_known(planted, 7, 4))
    step = 0.1 * draw.normal(num_unknowns(layout))
    by = {name: step[columns] for name, columns in _columns(layout).items()}

    state, truth = moved(layout, planted.truth, step), planted.truth

    turn = torch.from_numpy(Rotation.from_rotvec(by["pose"][:, :3].numpy()).as_matrix())
    assert_matches(state.rotation, turn @ truth.rotation, slack=10.0)
    assert_matches(state.center, truth.center + by["pose"][:, 3:])
    assert_matches(state.lens.focal, truth.lens.focal * by["focal"].exp())
    assert_matches(state.lens.principal_point, truth.lens.principal_point + by["principal_point"])
    assert_matches(state.lens.distortion, truth.lens.distortion + by["distortion"])
    assert_matches(state.index_ratio, truth.index_ratio + by["index_ratio"][0])
    first, second = _tangents(truth)
    axis = by["plane"][:, :1] * first + by["plane"][:, 1:2] * second
    turn = torch.from_numpy(Rotation.from_rotvec(axis.numpy()).as_matrix())
    assert_matches(state.planes[0], (turn @ truth.planes[0][..., None])[..., 0], slack=10.0)
    assert_matches(state.planes[1], truth.planes[1] + by["plane"][:, 2])
    kept = torch.zeros(30, dtype=torch.bool)
    kept[[4, 7]] = True
    assert_matches(state.points[[4, 7]], truth.points[[4, 7]] + by["kept"])
    assert_matches(state.points[~kept], truth.points[~kept] + step[layout.size :].view(-1, 3))


def test_the_first_two_radial_terms_alone_move_where_radial_is_free(plant, draw):
    planted = plant(distortion=(-0.1, 0.03, 0.001, -0.002, 0.01))
    layout = planted.layout(("radial",))

    state = moved(layout, planted.truth, draw.normal(num_unknowns(layout)))

    assert torch.equal(state.lens.distortion[2:], planted.truth.lens.distortion[2:])
    assert (state.lens.distortion[:2] != planted.truth.lens.distortion[:2]).all()


def test_points_that_are_held_do_not_move(plant, draw):
    planted = plant()
    layout = Layout.create(planted.truth, planted.links, hold_points=True)

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
    lenses, planes = torch.arange(layout.num_lenses), torch.arange(layout.num_planes)
    columns = {"pose": layout.pose_columns(torch.arange(layout.num_cameras))}
    columns |= {name: layout.lens_columns(name, lenses) for name in LENS if name in layout.lens}
    columns |= {"index_ratio": torch.tensor([layout.index_column()]), "plane": layout.plane_columns(planes)}
    if layout.kept is not None:
        columns["kept"] = layout.point_columns(layout.kept.nonzero()[:, 0])
    return columns


def _known(planted, *points):
    index = torch.tensor(points)
    return [KnownPoints(index, planted.truth.points[index], torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3))]


def _tangents(state):
    """Unit vectors in the planes, right-handed with the normals: x and y turned by the least rotation from z (E, 3)."""
    axes = []
    for normal in state.planes[0]:
        axis = torch.linalg.cross(normal.new_tensor((0.0, 0.0, 1.0)), normal)
        angle = torch.atan2(axis.norm(), normal[2])
        turn = Rotation.from_rotvec((angle * torch.nn.functional.normalize(axis, dim=0)).numpy())
        axes.append(torch.from_numpy(turn.as_matrix()))
    turns = torch.stack(axes)
    return turns[..., 0], turns[..., 1]
