"""Reading `capture.json` and checking it before anything is computed."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrefrac.camera import Intrinsics
from torchrefrac.files.extent import read_extent
from torchrefrac.files.fields import Fields, different_names, read_json, write_json
from torchrefrac.files.georeference import GEOREFERENCE, read_georeference
from torchrefrac.files.interface import INTERFACE, INTERFACES, interface_content, interface_of_images, read_interfaces
from torchrefrac.files.intrinsics import camera_of_images, cameras_content, read_cameras_table, read_intrinsics
from torchrefrac.files.masks import IMAGES, Masks
from torchrefrac.files.measured import FIELDS as MEASURED
from torchrefrac.files.measured import read_measured, require_for_all
from torchrefrac.files.photographs import DamagedPhotographError, check_photograph, read_grey
from torchrefrac.scene import Cameras, Capture, CaptureError, Interfaces, WaterExtent
from torchrefrac.scene.interfaces import SURFACE

FORMAT = "torchrefrac-capture/1"
SEVERAL = "torchrefrac-capture/2"
"""The format with several cameras, positions, and gravity of some images only."""
PIXEL_SHIFT = {"center": 0.5, "corner": 0.0}
OF_SURFACE = ("format", "length_unit", "index_ratio", "pixel_origin", "down_in_cam_sigma_deg", "water_extent", "images")
OF_CAPTURE = (
    "folder",
    "interface",
    INTERFACES,
    "normal_sigma_deg",
    "cameras",
    "height_sigma",
    "position_sigma",
    GEOREFERENCE,
)


def load_capture(folder: str | Path, with_images: bool = True) -> Capture:
    """Read `folder`/capture.json; the images lie in `folder`/images unless it says where, and need not exist without
    `with_images`.

    Images that are damaged or cannot be read are left out and listed in `damaged`, where two or more others are left.
    Raises CaptureError with one sentence for anything else that cannot be right: a missing image, one of another size
    than its camera, a mask that fits no image or has another size, a missing or mistyped field, a camera that is not in
    the table, in format 1 gravity or headings of some images only, epochs of some images only, gravity that is no unit
    vector, a camera that looks at the sky, a position without a sigma, an index ratio below 1 or beyond any liquid, an
    extent of the water that is no polygon, fewer than two images, a name given twice.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder} is not a folder; give the folder that holds capture.json and images/")
    top = read_json(folder / "capture.json")
    several = top.must_be("format", FORMAT, SEVERAL) == SEVERAL
    top.only(*OF_SURFACE, *(OF_CAPTURE if several else ("intrinsics",)))
    cameras = read_capture_cameras(top)
    images = top.objects("images")
    if len(images) < 2:
        raise top.fail("images", f"lists {len(images)}, but a reconstruction needs at least 2")
    names = _names(images, several)
    if not several:
        require_for_all(images, "down_in_cam", "heading_deg")
    paths = tuple(folder / top.text("folder", IMAGES) / name for name in names)
    camera, interfaces = camera_of_images(images, cameras), read_interfaces(top)
    seen = camera if with_images else []
    places = [_where(cameras.names[i], several) for i in seen]
    damaged = _damaged(paths[: len(seen)], [cameras[i] for i in seen], places)
    capture = Capture(
        folder=folder,
        names=names,
        paths=paths,
        cameras=cameras,
        camera=torch.tensor(camera),
        interfaces=interfaces,
        interface=interface_of_images(top, images),
        length_unit=top.length_unit(),
        water_extent=_water_extent(top, images),
        georeference=read_georeference(top),
        **_epochs(images),
        **read_measured(top, images, may_be_level=interfaces.kinds != (SURFACE,)),
    )
    whole = [i for i, path in enumerate(paths) if path not in damaged]
    if len(whole) < 2:
        raise next(iter(damaged.values()))
    if damaged:
        reasons = {name: str(damaged[path]) for name, path in zip(names, paths, strict=True) if path in damaged}
        capture = replace(capture.of_views(whole), damaged=reasons)
    if with_images:
        Masks(capture).check()
    return capture


def stated_pixel_shift(folder: Path) -> float:
    """From pixels as `folder`/capture.json counts them to those of this package."""
    top = read_json(folder / "capture.json")
    return pixel_shift(top, top.text("pixel_origin"))


def write_capture(
    source: Path, cameras: Cameras, interfaces: Interfaces, sigmas: Sequence[Mapping[str, float]], path: Path
) -> None:
    """Write the capture.json `source` with other cameras and interfaces, and what is not certain of the latter. Its
    images stay where they are."""
    content = json.loads(source.read_text(encoding="utf-8"))
    shift = PIXEL_SHIFT[content["pixel_origin"]]
    table = cameras_content(cameras)
    for camera in table.values():
        camera["cx"], camera["cy"] = camera["cx"] - shift, camera["cy"] - shift
    named = [*content.get(INTERFACES, {})]
    for name in ("intrinsics", "index_ratio", INTERFACE, INTERFACES):
        content.pop(name, None)
    for image in content["images"]:
        image.pop("center_prior", None)
    every = [interface_content(interfaces, row, sigmas[row]) for row in range(len(interfaces))]
    where = {INTERFACES: dict(zip(named, every, strict=True))} if named else {INTERFACE: every[0]}
    folder = str((source.parent / content.get("folder", IMAGES)).resolve())
    write_json(content | {"format": SEVERAL, "folder": folder, "cameras": table} | where, path)


def read_capture_cameras(top: Fields) -> Cameras:
    """The cameras that capture.json describes."""
    shift = pixel_shift(top, top.text("pixel_origin"))
    if "cameras" in top:
        cameras = top.members("cameras")
        if not cameras:
            raise top.fail("cameras", "is empty, but must describe at least one camera")
        return read_cameras_table(cameras, shift)
    if top.text("format") == SEVERAL:
        raise top.fail("cameras", "is missing, but must describe at least one camera")
    fields = top.object("intrinsics")
    fields.only("width", "height", "fx", "fy", "cx", "cy", "distortion")
    return Cameras.of([read_intrinsics(fields, shift, (5,))])


def pixel_shift(top: Fields, origin: str) -> float:
    """From pixels that are counted from `origin` to those of this package."""
    if origin not in PIXEL_SHIFT:
        raise top.fail("pixel_origin", f"is {origin!r}, but must be 'center' (OpenCV) or 'corner' (COLMAP)")
    return PIXEL_SHIFT[origin]


def _names(images: list[Fields], several: bool) -> tuple[str, ...]:
    """Those of the images, all of whose fields must be known."""
    known = (
        ("camera", "epoch", "interface", *MEASURED)
        if several
        else ("down_in_cam", "height", "heading_deg", "center_prior")
    )
    for image in images:
        image.only("name", *known, "water_extent")
        name = image.text("name")
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise image.fail("name", f"is {name!r}, but must name a file inside images/")
        if "center_prior" in image:
            image.position("center_prior")
    return different_names(images)


def _epochs(images: list[Fields]) -> dict[str, Any]:
    """The fields of a capture about them: nothing where all images are of one. The first is that of the first image."""
    require_for_all(images, "epoch")
    names = [image.text("epoch") for image in images if "epoch" in image]
    epochs = tuple(dict.fromkeys(names))
    if len(epochs) < 2:
        return {}
    return {"epochs": epochs, "epoch": torch.tensor([epochs.index(name) for name in names])}


def _where(camera: str, several: bool) -> str:
    """Where a file states the size of the images of a camera."""
    return f"cameras.{camera}" if several else "intrinsics"


def _water_extent(top: Fields, images: list[Fields]) -> WaterExtent | None:
    shift = pixel_shift(top, top.text("pixel_origin"))
    extent = WaterExtent(read_extent(top), tuple(read_extent(image, shift) for image in images))
    return extent if extent.from_above is not None or extent.is_drawn else None


def _damaged(
    paths: Sequence[Path], intrinsics: Sequence[Intrinsics], places: Sequence[str]
) -> dict[Path, DamagedPhotographError]:
    """What is wrong with those images that are not whole. places: where their sizes are stated."""
    damaged = {}
    for path, camera, place in zip(paths, intrinsics, places, strict=True):
        try:
            _check_image(path, camera, place)
        except DamagedPhotographError as error:
            damaged[path] = error
    return damaged


def _check_image(path: Path, intrinsics: Intrinsics, place: str) -> None:
    if not path.is_file():
        raise CaptureError(f"{path} does not exist, but capture.json lists it; add the image or remove its entry")
    check_photograph(path)
    pixels = read_grey(path)
    height, width = pixels.shape
    if (width, height) != (intrinsics.width, intrinsics.height):
        wanted = f"{intrinsics.width}x{intrinsics.height}"
        raise CaptureError(f"{path} is {width}x{height}, but {place}.width and height say {wanted}")
