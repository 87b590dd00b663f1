"""A scene of two cameras with tracks of several lengths, and what it means for two scenes to be the same."""

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry import Rigid
from torchrefrac.scene import Interfaces, Observations, Scene

PLAIN = Intrinsics.create(640, 480, (500.0, 501.0), (321.5, 239.25))
BENT = Intrinsics.create(800, 600, (700.0, 699.0), (400.5, 301.0), (0.1, -0.02, 1e-3, -2e-3, 0.003))


def two_camera_scene(draw, views=5, points=40):
    """Each point is seen by 2 to `views` views, in an order of their own; there is no water."""
    tracks = [torch.randperm(views, generator=draw.generator)[: 2 + i % (views - 1)] for i in range(points)]
    view = torch.cat(tracks)
    pose = Rigid(draw.rotations(views), 10.0 * draw.normal(views, 3))
    positions = draw.normal(points, 3)
    colors = torch.randint(256, (points, 3), dtype=torch.uint8, generator=draw.generator)
    point = torch.arange(points).repeat_interleave(torch.tensor([len(track) for track in tracks]))
    return Scene.create(
        pose,
        (PLAIN, BENT),
        Interfaces.level(1.0),
        positions,
        Observations(view, point, draw.uniform(0.0, 480.0, len(view), 2)),
        names=[f"left/{i}.jpg" for i in range(views)],
        camera=torch.arange(views) % 2,
        colors=colors,
    )


def assert_same_intrinsics(intrinsics, wanted):
    assert (intrinsics.width, intrinsics.height) == (wanted.width, wanted.height)
    for name in ("focal", "principal_point", "distortion"):
        assert torch.equal(getattr(intrinsics, name), getattr(wanted, name)), name


def assert_same(scene, wanted, poses_exact=True):
    """To the last bit; poses up to the rounding of a quaternion unless poses_exact."""
    assert scene.views.names == wanted.views.names
    assert scene.length_unit == wanted.length_unit
    assert len(scene.cameras) == len(wanted.cameras)
    for i in range(len(wanted.cameras)):
        assert_same_intrinsics(scene.cameras[i], wanted.cameras[i])
    for name in ("normal", "offset", "index_ratio"):
        assert torch.equal(getattr(scene.interfaces, name), getattr(wanted.interfaces, name)), name
    for name in ("camera", "interface", "registered", *(("rotation", "center") if poses_exact else ())):
        assert torch.equal(getattr(scene.views, name), getattr(wanted.views, name)), name
    for name in ("points", "colors", "placed", "accepted"):
        assert torch.equal(getattr(scene, name), getattr(wanted, name)), name
    for name in ("view", "point", "pixels"):
        assert torch.equal(getattr(scene.observations, name), getattr(wanted.observations, name)), name
    torch.testing.assert_close(scene.views.rotation, wanted.views.rotation, rtol=0.0, atol=4e-15)
    torch.testing.assert_close(scene.views.center, wanted.views.center, rtol=4e-15, atol=4e-14)
