"""Errors of points against what their pixels truly see, and flatness, on shifts and bends that were planted."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.evaluate.metrics import evaluate
from torchrefrac.evaluate.point_errors import TruePlaces, flatness, segment_median, true_places
from torchrefrac.evaluate.true_surface import TrueSurface
from torchrefrac.files.library import embedded_scene
from torchrefrac.files.truth import load_truth
from torchrefrac.geometry import Rigid, Similarity, heading_rotation, so3_exp
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.refraction import FlatInterface
from torchrefrac.scene import Cameras, Interfaces, Observations, Scene, Truth

DOUBLE = torch.float64
RADIUS = 40.0


def vector(*components):
    return torch.tensor(components, dtype=DOUBLE)


@pytest.fixture
def truth():
    return load_truth(embedded_scene("tank_small"))


@pytest.fixture
def perfect(truth: Truth):
    """Points over the three planes of the tank, each with an observation in every image that it is in."""
    s = torch.linspace(0.02, 0.98, 25, dtype=DOUBLE)
    grid = torch.cartesian_prod(s, s)
    points = truth.corner[:, None] + grid[:, :1] * truth.edge1[:, None] + grid[:, 1:] * truth.edge2[:, None]
    points = points.flatten(0, 1)
    cameras = RefractiveCamera(truth.intrinsics, truth.rotation, truth.center, FlatInterface(truth.index_ratio))
    pixels, visible = cameras[:, None].project(points, inside_image=True)
    which = torch.arange(len(truth.names))[:, None].expand(visible.shape)
    flat = (which.flatten(), pixels.flatten(0, 1))
    seen = TrueSurface(truth).cast(cameras[flat[0]], flat[1])
    unhidden = ((seen.points.view(len(cameras.center_in_world), -1, 3) - points).norm(dim=-1) < 1e-6) & visible
    kept = unhidden.sum(dim=0) >= 3
    points, pixels, unhidden = points[kept], pixels[:, kept], unhidden[:, kept]
    point, view = unhidden.mT.nonzero().unbind(dim=-1)
    return Scene.create(
        Rigid(truth.rotation, truth.center),
        truth.intrinsics,
        Interfaces.level(truth.index_ratio),
        points,
        Observations(view, point, pixels[view, point]),
        names=truth.names,
        length_unit="cm",
    )


def moved(scene, change):
    views = scene.views.at(change.apply_to_rotation(scene.views.rotation), change.apply(scene.views.center))
    return replace(scene, views=views, points=change.apply(scene.points))


def seen_at(scene, pixels):
    return replace(scene, observations=replace(scene.observations, pixels=pixels))


def in_another_frame(scene):
    """In a frame of another scale, heading and place along the water."""
    return moved(scene, Similarity(vector(0.3).squeeze(), heading_rotation(vector(1.1)[0]), vector(3.0, -7.0, 0.0)))


def on_a_disc(count):
    """Points (count, 2) spread evenly over a disc of RADIUS, on the spiral of a sunflower."""
    i = torch.arange(count, dtype=DOUBLE)
    r, angle = RADIUS * ((i + 0.5) / count).sqrt(), i * (math.pi * (3.0 - math.sqrt(5.0)))
    return torch.stack((r * angle.cos(), r * angle.sin()), dim=-1)


def rms_of_a_bowl(depth, kept=1.0):
    """z = depth (r / RADIUS)^2 over a disc, about its mean: uniform from -depth / 2 to depth / 2; its middle part."""
    return kept * depth / math.sqrt(12.0)


def test_the_truth_itself_has_no_error(perfect, truth):
    found, _ = evaluate(in_another_frame(perfect), truth)

    assert len(perfect.points) > 500
    assert found["true_index_ratio"] == 1.33
    for key in ("point_median_cm", "point_rms_cm", "flatness_cm", "surface_median_cm"):
        assert found[key] == pytest.approx(0.0, abs=1e-5), key


def test_points_beside_their_places_are_in_error_even_on_the_right_plane(perfect, truth):
    aside = replace(perfect, points=perfect.points + vector(0.3, 0.0, 0.4))

    found, _ = evaluate(in_another_frame(aside), truth)

    assert found["point_median_cm"] == pytest.approx(0.5, abs=1e-5)
    assert found["point_rms_cm"] == pytest.approx(0.5, abs=1e-5)
    assert found["flatness_cm"] == pytest.approx(0.0, abs=1e-5)
    assert 0.1 < found["surface_median_cm"] < 0.5


def test_a_similarity_is_no_error_without_refraction(perfect, truth):
    change = Similarity(vector(2.0).squeeze(), so3_exp(vector(0.4, -0.2, 1.0)), vector(1.0, 2.0, 3.0))

    found, _ = evaluate(replace(moved(perfect, change), interfaces=Interfaces.level(1.0)), truth)

    assert found["alignment"] == "similarity"
    assert found["point_rms_cm"] == pytest.approx(0.0, abs=1e-5)
    assert found["flatness_cm"] == pytest.approx(0.0, abs=1e-5)


def test_the_worst_twentieth_does_not_count_in_the_rms(perfect, truth):
    points = perfect.points.clone()
    few = len(points) // 20
    points[:: len(points) // few][:few] += vector(0.0, 0.0, 30.0)

    found, _ = evaluate(replace(perfect, points=points), truth)

    assert found["point_rms_cm"] == pytest.approx(0.0, abs=1e-5)
    assert found["surface_rms_cm"] > 1.0


def test_a_wrong_match_among_three_does_not_move_the_true_place(perfect, truth):
    seen = perfect.observations
    first = torch.cat((torch.ones(1, dtype=torch.bool), seen.point[1:] != seen.point[:-1]))
    pixels = torch.where(first[:, None], seen.pixels * 0.9 + 30.0, seen.pixels)

    places = true_places(seen_at(perfect, pixels), TrueSurface(truth))

    cast = TrueSurface(truth).cast(perfect.camera_of(seen.view), pixels)
    assert ((cast.points - perfect.points[seen.point]).norm(dim=-1)[first] > 1.0).double().mean() > 0.9
    torch.testing.assert_close(places.points, perfect.points, rtol=0.0, atol=1e-6)


def test_a_mismatch_of_two_images_is_an_error(perfect, truth):
    """The pixels of two points, which lie apart, as the observations of one."""
    a, b = 0, len(truth.names) - 1
    seen = perfect.observations
    of_a, of_b = seen.point[seen.view == a], seen.point[seen.view == b]
    first, second = int(of_a[0]), int(of_b[of_b != of_a[0]][-1])
    rows = [int(((seen.point == p) & (seen.view == i)).nonzero()[0]) for p, i in ((first, a), (second, b))]
    one = Observations(seen.view[rows], torch.zeros(2, dtype=torch.long), seen.pixels[rows])
    pair = perfect.with_points(perfect.points[first][None], perfect.colors[:1], one)

    found, _ = evaluate(pair, truth)

    apart = float((perfect.points[first] - perfect.points[second]).norm())
    assert found["point_median_cm"] == pytest.approx(0.5 * apart, abs=1e-5)
    assert "flatness_cm" not in found


def test_the_true_intrinsics_say_where_points_are_not_the_estimated_ones(perfect, truth):
    wrong = Intrinsics.create(640, 480, 390.0, distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    bent = replace(perfect, cameras=Cameras.of([wrong]))

    found, _ = evaluate(bent, truth)

    assert found["point_rms_cm"] == pytest.approx(0.0, abs=1e-5)


def test_only_registered_images_with_a_true_pose_take_part(perfect, truth):
    seen, registered = perfect.observations, perfect.views.registered.clone()
    registered[2] = False
    views = replace(perfect.views, names=("unknown", *truth.names[1:]), registered=registered)
    pixels = torch.where((seen.view == 0)[:, None] | (seen.view == 2)[:, None], 1.0, seen.pixels)

    places = true_places(replace(seen_at(perfect, pixels), views=views), TrueSurface(truth))

    takes_part = (seen.view != 0) & (seen.view != 2)
    assert torch.equal(places.known, torch.bincount(seen.point[takes_part], minlength=len(perfect.points)) > 0)
    torch.testing.assert_close(places.points[places.known], perfect.points[places.known], rtol=0.0, atol=1e-6)


def test_without_a_true_index_or_intrinsics_there_are_no_errors_of_points(perfect, truth):
    other = Intrinsics.create(320, 240, 200.0)
    for less in (
        replace(truth, interfaces=None),
        replace(truth, intrinsics=None),
        replace(truth, intrinsics=other),
    ):
        found, _ = evaluate(perfect, less)

        assert not {"point_median_cm", "point_rms_cm", "flatness_cm"} & set(found)
        assert "surface_rms_cm" in found
        assert ("true_index_ratio" in found) == (less.index_ratio is not None)


def test_a_scene_without_points_has_errors_of_cameras_only(perfect, truth):
    none = perfect.with_points(perfect.points[:0], perfect.colors[:0])

    found, alignment = evaluate(none, truth)

    assert alignment is not None
    assert not any(key.startswith(("point", "surface", "flatness")) for key in found)


def places_on(points, plane):
    return TruePlaces(points, plane, torch.ones(len(points), dtype=torch.bool))


@pytest.mark.parametrize("tilt", [0.0, 0.7])
def test_the_flatness_of_a_bowl_is_the_spread_of_its_depth(tilt):
    disc, depth = on_a_disc(20_000), 0.05
    level = torch.cat((disc, torch.zeros(len(disc), 1, dtype=DOUBLE)), dim=-1)
    bowl = torch.cat((disc, depth * disc.square().sum(dim=-1, keepdim=True) / RADIUS**2), dim=-1)
    turned = so3_exp(vector(tilt, 0.1 * tilt, 0.0))
    plane = torch.zeros(len(disc), dtype=torch.long)

    found = flatness(bowl @ turned.mT + vector(10.0, -3.0, -80.0), places_on(level, plane), 1)

    assert found == pytest.approx(rms_of_a_bowl(depth, kept=0.95), rel=1e-3)


def test_planes_count_by_their_points_and_those_with_few_do_not():
    depths = torch.tensor([0.1] * 2000 + [0.4] * 991 + [9.0] * 9, dtype=DOUBLE)
    plane = torch.tensor([0] * 2000 + [1] * 991 + [2] * 9)
    disc = torch.cat((on_a_disc(2000), on_a_disc(991), on_a_disc(9)))
    z = depths * disc.square().sum(dim=-1) / RADIUS**2 + 7.0 * plane
    points = torch.cat((disc, z[:, None]), dim=-1)

    found = flatness(points, places_on(points, plane), 3)

    expected = math.hypot(
        rms_of_a_bowl(0.1, 0.95) * math.sqrt(1900 / 2842), rms_of_a_bowl(0.4, 0.95) * math.sqrt(942 / 2842)
    )
    assert found == pytest.approx(expected, rel=5e-3)
    assert flatness(points[-9:], places_on(points[-9:], plane[-9:]), 3) is None


def test_without_planes_a_bowl_in_height_is_as_bent_and_a_tilt_is_not():
    disc, depth = on_a_disc(20_000), 0.05
    bed = torch.cat((disc, 4.0 * (disc[:, :1] / 9.0).sin() - 60.0), dim=-1)
    bowl = depth * disc.square().sum(dim=-1) / RADIUS**2
    tilt = 0.02 * disc[:, 0] - 0.03 * disc[:, 1] + 1.5
    none = torch.full((len(disc),), -1)

    found = flatness(bed + torch.stack((0 * bowl, 0 * bowl, bowl + tilt), dim=-1), places_on(bed, none), 0)

    assert found == pytest.approx(rms_of_a_bowl(depth, kept=0.95), rel=1e-3)


def test_a_bend_of_the_whole_tank_shows_in_its_planes(perfect, truth):
    """Against the same by NumPy: planes by SVD, points by where they were made."""
    bent = perfect.points + 1e-4 * perfect.points[:, :2].square().sum(dim=-1, keepdim=True) * vector(0.0, 0.0, 1.0)
    tilted = so3_exp(vector(0.02, -0.01, 0.0))
    frame = Similarity(vector(1.0).squeeze(), tilted, vector(0.0, 0.0, 0.0))
    bent = replace(moved(replace(perfect, points=bent), frame), interfaces=Interfaces.level(1.0))

    found, _ = evaluate(bent, truth)

    squares = []
    for corner, normal in zip(truth.corner, truth.normal, strict=True):
        group = bent.points[((perfect.points - corner) @ normal).abs() < 1e-6].numpy()
        for _ in range(2):
            center = group.mean(axis=0)
            distance = np.abs((group - center) @ np.linalg.svd(group - center)[2][2])
            kept = np.sort(distance.argsort()[: len(group) - len(group) // 20])
            last, group = distance, group[kept]
        squares.append(last**2)
    assert found["flatness_cm"] == pytest.approx(np.sqrt(np.concatenate(squares).mean()), rel=1e-6)
    assert found["flatness_cm"] > 0.05


def test_a_scene_of_triangles_only_has_all_figures(perfect, truth):
    """A dune instead of the planes: cast onto, then displaced."""
    side = torch.linspace(-150.0, 150.0, 121, dtype=DOUBLE)
    x, y = torch.meshgrid(side, side, indexing="xy")
    dune = torch.stack((x, y, 5.0 * (0.05 * x).sin() - 70.0), dim=-1).view(-1, 3)
    i = (torch.arange(120)[:, None] * 121 + torch.arange(120)).flatten()
    faces = torch.cat((torch.stack((i, i + 1, i + 122), dim=-1), torch.stack((i, i + 122, i + 121), dim=-1)))
    none = replace(truth, corner=truth.corner[:0], edge1=truth.edge1[:0], edge2=truth.edge2[:0])
    riverbed = replace(none, surface=TriangleMesh(dune, faces))
    places = true_places(perfect, TrueSurface(riverbed))
    aside = replace(perfect, points=places.points + vector(0.3, 0.0, 0.4))

    found, _ = evaluate(aside, riverbed)

    assert places.known.all()
    assert (places.plane == -1).all()
    assert found["point_median_cm"] == pytest.approx(0.5, abs=1e-6)
    assert found["flatness_cm"] == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < found["surface_median_cm"] < 0.5


def test_medians_of_groups_are_those_of_numpy(draw):
    segment = torch.randint(0, 60, (300,), generator=draw.generator)
    segment = segment[segment != 7]
    values = draw.normal(len(segment), 3)

    found = segment_median(values, segment, 60)

    assert not found[7].any()
    for group in segment.unique().tolist():
        expected = np.median(values[segment == group].numpy(), axis=0)
        assert found[group].tolist() == pytest.approx(expected.tolist())
