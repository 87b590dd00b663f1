"""Any mesh under water: a file that trimesh reads, on a textured ground, photographed from all around."""

import hashlib
import math
import struct
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.checks import Range, require_ranges
from torchrefrac.synthetic.options import LONGEST, InterfaceOptions, SyntheticOptions, require_heights, require_images
from torchrefrac.synthetic.paths import look_at, ring, rolls
from torchrefrac.synthetic.patterns import sand
from torchrefrac.synthetic.scenes.mesh_colours import coloured
from torchrefrac.synthetic.scenes.shapes import level_rectangle
from torchrefrac.synthetic.stage import Piece, Stage, StageError
from torchrefrac.synthetic.textures import ImageTexture

if TYPE_CHECKING:
    import trimesh

UNREADABLE = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, RuntimeError, ImportError, OSError, EOFError,
    AssertionError, SyntaxError, struct.error, zipfile.BadZipFile,
)  # fmt: skip
"""What the readers of trimesh raise for files that are none; SyntaxError is that of XML."""
TILTS_DEG = (25.0, 35.0)
MARGIN = 1.15  # of the distance from which all of the mesh fits into an image
DEEPER = 1.3  # by default, than the mesh is high


@dataclass(frozen=True, kw_only=True)
class MeshOptions(SyntheticOptions):
    """A mesh from `file`, its coordinates times `scale`, the axis `up` upwards, its middle above the origin.

    depth: of its lowest point below the water, by default 1.3 times its height. allow_dry: it may reach out of the
    water. images cameras stand in a ring from which each sees all of it, at `heights` above the water in turn, by
    default so that they look down at 25 and 35 degrees from the vertical. ground: a sand bed lies beneath it. Lengths
    are in length_unit.
    """

    file: str
    scale: float = 1.0
    up: Literal["y", "z"] = "z"
    depth: float | None = None
    allow_dry: bool = False
    images: int = 16
    heights: tuple[float, ...] | None = None
    ground: bool = True
    length_unit: str = "m"
    interface: InterfaceOptions = field(default_factory=InterfaceOptions.in_metres)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file:
            raise ValueError("file is empty, but must be the path of a mesh")
        require_ranges(self, {"scale": Range(above=0.0, at_most=1e9), "depth": Range(above=0.0, at_most=LONGEST)})
        require_images(self.images)
        if self.heights is not None:
            require_heights(self.heights)
        if not self.length_unit:
            raise ValueError("length_unit is empty, but must be the name of a unit")

    def fingerprint(self) -> dict[str, Any]:
        """With what the file holds; not with other files that it may name, such as images.

        Raises StageError where it cannot be read.
        """
        try:
            content = hashlib.sha256(Path(self.file).read_bytes()).hexdigest()
        except OSError as error:
            raise StageError(f"scene.file: {self.file} cannot be read: {error.strerror}") from None
        return {**super().fingerprint(), "content": content}


def mesh_stage(options: MeshOptions) -> Stage:
    """The mesh under a lamp that stands to one side. Raises StageError for a file that holds no mesh, or one that
    cannot be placed as asked."""
    mesh = _load(Path(options.file))
    vertices, depth = _placed(torch.as_tensor(mesh.vertices.copy(), dtype=torch.float64), options)
    surface, texture = coloured(mesh, vertices, options.seed)
    low, high = vertices.amin(dim=0), vertices.amax(dim=0)
    radius, middle = 0.5 * float((high - low).norm()), 0.5 * (low + high)
    center = _cameras(options, radius, float(middle[2]))
    pieces = [Piece(Path(options.file).stem, surface, texture)]
    if options.ground:
        reach = _reach(options, center, depth, radius)
        bed = level_rectangle((-reach, -reach), (reach, reach), -depth - 1e-3 * radius)
        pieces.append(Piece("ground", bed, ImageTexture(sand((2048, 2048), 10 * options.seed)), is_plane=True))
    return Stage(
        pieces=tuple(pieces),
        rotation=look_at(center, middle, rolls(options.images, 4.0)),
        center=center,
        length_unit=options.length_unit,
        towards_light=(0.4, -0.5, 0.8),
        ambient=0.55,
        direct=0.5,
    )


def _load(path: Path) -> "trimesh.Trimesh":
    import trimesh  # noqa: PLC0415 - slow to import

    if not path.is_file():
        raise StageError(f"scene.file is {path}, but there is no such file")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except UNREADABLE as error:
        problem = " ".join(str(error).split()) or type(error).__name__
        raise StageError(f"scene.file: {path} cannot be read as a mesh: {problem}") from None
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise StageError(f"scene.file: {path} holds no triangles, but must be a mesh")
    if int(mesh.faces.max()) >= len(mesh.vertices) or int(mesh.faces.min()) < 0:
        raise StageError(f"scene.file: {path} has triangles of vertices that it does not have")
    used = mesh.vertices[mesh.faces.ravel()]
    if not bool(torch.isfinite(torch.as_tensor(used.copy())).all()):
        raise StageError(f"scene.file: {path} has coordinates that are not finite")
    mesh.remove_unreferenced_vertices()
    return mesh


def _placed(vertices: Float[Tensor, "v 3"], options: MeshOptions) -> tuple[Float[Tensor, "v 3"], float]:
    """Vertices in the world frame, and the depth of the lowest."""
    if options.up == "y":
        vertices = torch.stack((vertices[:, 0], -vertices[:, 2], vertices[:, 1]), dim=-1)
    vertices = options.scale * vertices
    low, high = vertices.amin(dim=0), vertices.amax(dim=0)
    size = high - low
    if float(size.norm()) == 0.0 or not math.isfinite(float(size.norm())):
        raise StageError(f"scene.file: {options.file} has an extent of {float(size.norm()):g}; scene.scale changes it")
    height = float(size[2])
    depth = options.depth if options.depth is not None else DEEPER * max(height, 0.25 * float(size.max()))
    above = height - depth
    if above >= 0.0 and not options.allow_dry:
        raise StageError(
            f"the mesh reaches {above:g} {options.length_unit} above the water: a scene.depth of more than {height:g} "
            f"or a scene.scale of less than {options.scale * depth / height:g} puts it under water, and "
            "scene.allow_dry=true leaves it there"
        )
    middle = 0.5 * (low + high)
    return vertices - torch.stack((middle[0], middle[1], low[2] + depth)), depth


def _cameras(options: MeshOptions, radius: float, middle: float) -> Float[Tensor, "m 3"]:
    """Centres from which the sphere about the mesh fits into the image."""
    small = min(options.camera.width, options.camera.height) / (2.0 * options.camera.focal)
    distance = MARGIN * radius / math.sin(math.atan(small))
    if options.heights is None:
        tilts = [math.radians(tilt) for tilt in TILTS_DEG]
        heights = [max(distance * math.cos(tilt) + 0.75 * middle, 0.3 * radius) for tilt in tilts]
        heights = [max(height, middle + 1.5 * radius) for height in heights]
        radii = [math.tan(tilt) * (height - middle) for tilt, height in zip(tilts, heights, strict=True)]
    else:
        heights, steepest = list(options.heights), math.tan(math.radians(TILTS_DEG[0]))
        above = [height - middle for height in heights]
        radii = [max(math.sqrt(max(distance**2 - h**2, 0.0)), steepest * h) for h in above]
    center = ring(options.images, 1.0, heights, (0.0, 360.0))
    each = torch.tensor([radii[i % len(radii)] for i in range(options.images)], dtype=torch.float64)
    return center * torch.stack((each, each, torch.ones_like(each)), dim=-1)


def _reach(options: MeshOptions, center: Float[Tensor, "m 3"], depth: float, radius: float) -> float:
    """Half the side of a ground that fills the images, but for what lies near the horizon."""
    out = center[:, :2].norm(dim=-1)
    tilt = torch.atan2(out, center[:, 2] + 0.5 * depth)
    top = (tilt + math.atan(0.5 * options.camera.height / options.camera.focal)).clamp(max=math.radians(68.0))
    beyond = (center[:, 2] + depth) * top.tan() - out
    return max(1.15 * float(beyond.max()), 2.0 * radius)
