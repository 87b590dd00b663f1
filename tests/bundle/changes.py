"""The tensors of a scene by their names."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchrefrac.scene import Observations, Scene

TABLES = {
    "pose": ("rotation", "center"),
    "cameras": ("focal", "principal_point", "distortion"),
    "interfaces": ("normal", "offset", "index_ratio", "layers", "thickness"),
}


def tensor_of(scene: Scene, name: str) -> Tensor:
    """One of a scene's tensors: of the poses, the cameras, the interfaces, or the points."""
    if name == "points":
        return scene.points
    table = next(table for table, names in TABLES.items() if name in names)
    return getattr(scene.views.pose if table == "pose" else getattr(scene, table), name)


def changed(scene: Scene, *, observations: Observations | None = None, **tensors: Any) -> Scene:
    """The scene with other tensors and observations; a single index ratio is that of all interfaces. All points are
    placed and white, all observations accepted."""
    if "index_ratio" in tensors:
        ratio = torch.as_tensor(tensors["index_ratio"], dtype=torch.float64)
        tensors["index_ratio"] = ratio.expand(len(tensors.get("offset", scene.interfaces)))
    tables: dict[str, Any] = {name: tensors.pop(name) for name in ("points",) if name in tensors}
    for table, names in TABLES.items():
        some = {name: tensors.pop(name) for name in names if name in tensors}
        if table == "pose":
            tables["views"] = replace(scene.views, pose=replace(scene.views.pose, **some))
        else:
            tables[table] = replace(getattr(scene, table), **some) if some else getattr(scene, table)
    assert not tensors, f"a scene has no {', '.join(tensors)}"
    seen = scene.observations if observations is None else observations
    count = len(tables.get("points", scene.points))
    return replace(
        scene,
        **tables,
        colors=torch.full((count, 3), 255, dtype=torch.uint8),
        placed=torch.ones(count, dtype=torch.bool),
        observations=seen,
        accepted=torch.ones(len(seen), dtype=torch.bool),
    )
