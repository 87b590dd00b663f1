"""One photograph, and what its file says of it."""

from dataclasses import dataclass
from pathlib import Path

from torchrefrac.files.metadata.attitude import Attitude
from torchrefrac.files.metadata.drones import attitude_of
from torchrefrac.files.metadata.exif import Exif
from torchrefrac.files.metadata.header import read_header
from torchrefrac.files.metadata.kinds import Kind, kind_of
from torchrefrac.files.metadata.lens import Lens, lens_of
from torchrefrac.files.metadata.phones import gravity_of
from torchrefrac.files.metadata.position import Fix, fix_of
from torchrefrac.files.metadata.xmp import Xmp
from torchrefrac.files.photographs import check_photograph

UPSIDE_DOWN = 135.0  # degrees of roll from which on a gimbal has gone past straight down; 90: a camera held upright


@dataclass(frozen=True)
class Photograph:
    """path, and size in pixels as stored; body: make, model and serial number of its camera, focal_mm: of its lens, as
    the file has it; time: "2024:05:17 11:02:33", empty where not said; is_past_nadir: its gimbal says that it was
    turned over. notes: what is odd about the file."""

    path: Path
    width: int
    height: int
    kind: Kind
    body: tuple[str, str, str]
    focal_mm: float | None
    time: str
    attitude: Attitude | None
    fix: Fix | None
    lens: Lens
    has_tags: bool
    is_past_nadir: bool = False
    notes: tuple[str, ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


def read_photograph(path: Path) -> Photograph:
    """What a file says. Raises DamagedPhotographError where it is not whole, CaptureError where it is no photograph."""
    header = read_header(path)
    check_photograph(path)
    exif, xmp = Exif(path), Xmp(header.packet)
    width, height = header.width, header.height
    make, model = (exif.text(f"Image {name}") or xmp.text(f"tiff:{name}") for name in ("Make", "Model"))
    serial = exif.text("EXIF BodySerialNumber") or xmp.text("drone-dji:CameraSerialNumber", "drone-dji:SerialNumber")
    return Photograph(
        path=path,
        width=width,
        height=height,
        kind=kind_of(path, width, height, xmp),
        body=(make, model, serial),
        focal_mm=exif.number("EXIF FocalLength"),
        time=exif.text("EXIF DateTimeOriginal") or exif.text("Image DateTime"),
        attitude=attitude_of(exif, xmp) or gravity_of(exif, width, height),
        fix=fix_of(exif, xmp),
        lens=lens_of(exif, xmp, width, height),
        has_tags=bool(exif) or bool(xmp),
        is_past_nadir=abs(xmp.number("drone-dji:GimbalRollDegree") or 0.0) > UPSIDE_DOWN,
        notes=(xmp.problem,) if xmp.problem else (),
    )
