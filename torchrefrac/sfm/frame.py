"""Where the finished scene stands: what images leave open is fixed by convention and measured heights."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import Similarity, heading_rotation, levelling, split_heading
from torchrefrac.scene import Capture, Scene
from torchrefrac.sfm.heights import fit_heights
from torchrefrac.sfm.walls import gravity_in_world


def fix_frame(scene: Scene, capture: Capture, has_scale: bool = False) -> Scene:
    """The scene in its final frame; see `final_frame`."""
    if not scene.views.num_registered:
        return scene
    change = final_frame(scene, capture, has_scale)
    together = len(scene.interfaces) == 1 or scene.interfaces.move_with_camera
    return (transformed if together else moved)(scene, change)


def final_frame(scene: Scene, capture: Capture, has_scale: bool = False) -> Similarity:
    """What puts the first registered view at x = y = 0 with heading 0, and scales to the measured heights. Before a
    wall, where gravity is known, y points up instead.

    Through water the scale is that of the measured camera heights which agree, see `fit_heights` (or makes the first
    height 1), unless the scene has one, as by layers of known thickness; plane and vertical stay. Without refraction
    neither can be seen: the frame is levelled by the mean of the gravity vectors, the first camera put at its height
    (or 1), and the scale left as it is.
    """
    views = scene.views
    registered = views.registered.nonzero()[:, 0]
    refractive = scene.interfaces.stand_in_world
    level = torch.eye(3, dtype=torch.float64) if refractive else mean_level(scene, capture)
    first, gravity = registered[0], gravity_in_world(scene, capture)
    if gravity is None:
        _, heading = split_heading(views.rotation[first] @ level.T)
    else:
        heading = torch.atan2(-gravity[0][0], -gravity[0][1])
    rotation = heading_rotation(heading) @ level
    center = views.center[registered] @ rotation.T
    measured = capture.has_height[registered]
    scale, lift = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    if refractive and not has_scale and not scene.interfaces.has_layers:
        rows = registered[measured]
        stated = capture.height[rows], capture.height_sigma[rows]
        scale = fit_heights(center[measured, 2], *stated).scale if len(rows) else 1.0 / center[0, 2]
    elif not refractive:
        lift = torch.where(measured[0], capture.height[first], 1.0) - center[0, 2]
    shift = torch.stack((-center[0, 0], -center[0, 1], lift))
    return Similarity(scale, rotation, scale * shift)


def transformed(scene: Scene, change: Similarity) -> Scene:
    """Registered views and points in another frame; interfaces stay as they are."""
    which, views = scene.views.registered.nonzero()[:, 0], scene.views
    rotation, center = change.apply_to_rotation(views.rotation[which]), change.apply(views.center[which])
    return replace(scene, views=views.at(rotation, center, which), points=change.apply(scene.points))


def moved(scene: Scene, change: Similarity) -> Scene:
    """Registered views, points and interfaces in another frame."""
    normal = scene.interfaces.normal @ change.rotation.mT
    offset = change.scale * scene.interfaces.offset + normal @ change.translation
    return replace(transformed(scene, change), interfaces=replace(scene.interfaces, normal=normal, offset=offset))


def with_water_at_zero(scene: Scene) -> tuple[Scene, float]:
    """The scene, whose level surfaces stand at any height, with the first at z = 0; and by how much it came down."""
    offset = scene.interfaces.offset[0]
    one, none = torch.ones_like(offset), torch.zeros_like(offset)
    lowered = transformed(scene, Similarity(one, torch.eye(3).to(offset), torch.stack((none, none, -offset))))
    surfaces = replace(scene.interfaces, offset=scene.interfaces.offset - offset)
    return replace(lowered, interfaces=surfaces), float(offset)


def mean_level(scene: Scene, capture: Capture) -> Float[Tensor, "3 3"]:
    """Rotation of the world that takes the mean measured gravity (the mean optical axis, where none of the registered
    views has any) to (0, 0, -1): the shortest, after half a turn about x where the world stands on its head.
    """
    registered = scene.views.registered.nonzero()[:, 0]
    known = registered[capture.down_sigma[registered].isfinite()]
    registered = known if len(known) else registered
    rotation = scene.views.rotation[registered]
    down = (rotation.mT @ capture.down_in_cam[registered][..., None])[..., 0].mean(dim=0)
    return levelling(down / down.norm())
