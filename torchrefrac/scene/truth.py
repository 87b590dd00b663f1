"""`truth.json`: where a scene was made, the true cameras and planes. For evaluation only."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchrefrac.scene.fields import read_json


@dataclass(frozen=True)
class Truth:
    """names and poses of the true cameras; planes as rectangles.

    rotation (m, 3, 3), center (m, 3); corner, edge1, edge2 (k, 3): a plane is corner + s edge1 + t edge2 with
    s and t from 0 to 1.
    """

    names: tuple[str, ...]
    rotation: Tensor
    center: Tensor
    corner: Tensor
    edge1: Tensor
    edge2: Tensor
    length_unit: str

    @property
    def normal(self) -> Tensor:
        """Unit normals (k, 3)."""
        return torch.nn.functional.normalize(torch.linalg.cross(self.edge1, self.edge2), dim=-1)


def load_truth(folder: Path) -> Truth | None:
    """Read `folder`/truth.json; None where there is none."""
    path = folder / "truth.json"
    if not path.is_file():
        return None
    top = read_json(path)
    images = top.objects("images")
    planes = top.objects("planes") if "planes" in top else []

    def table(rows: list[list[float]]) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)

    return Truth(
        names=tuple(image.text("name") for image in images),
        rotation=torch.tensor([image.matrix("cam_from_world_rotation") for image in images], dtype=torch.float64),
        center=table([image.numbers("center_in_world", 3) for image in images]),
        corner=table([plane.numbers("origin", 3) for plane in planes]),
        edge1=table([plane.numbers("e1", 3) for plane in planes]),
        edge2=table([plane.numbers("e2", 3) for plane in planes]),
        length_unit=top.text("length_unit"),
    )
