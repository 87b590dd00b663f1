"""Cameras as Metashape exports them (XML).

A camera has world_from_cam in the frame of its chunk (axes x right, y down, z forward), the chunk or its component a
similarity from there to the world. Where the chunk has a geographic reference system, that world is geocentric.
"""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.files.fields import MEGABYTE, MOST_MEGABYTES_OF_A_SCENE
from torchrefrac.files.plausible import implausible
from torchrefrac.files.systems import horizontal_part
from torchrefrac.geometry import Similarity, nearest_rotation
from torchrefrac.scene import Cameras, SceneError, Viewpoints, field_of_view

LOCAL = ("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")
STEP = 1.0  # m, along the axes of a camera, to see which way they run on the map
NO_LENS = (-torch.inf, torch.inf, -torch.inf, torch.inf)


def read_metashape(path: Path, crs: str | None = None) -> Viewpoints:
    """The cameras of the first chunk that are enabled and aligned.

    crs: what a chunk with a reference system is put into (None: its own). Raises SceneError, with the file, for
    anything that cannot be right.
    """
    chunk = _chunk(path)
    lenses = {sensor.get("id", ""): _lens(sensor, path) for sensor in chunk.iterfind("sensors/sensor")}
    frames = {part.get("id", ""): _similarity(part, path) for part in chunk.iterfind("components/component")}
    whole = _similarity(chunk, path)
    names, fields, rotations, centers = [], [], [], []
    for camera in chunk.iterfind("cameras//camera"):
        pose = _numbers(camera, "transform", 16, path)
        if pose is None or camera.get("enabled", "true").lower() in ("false", "0"):
            continue
        frame = frames.get(camera.get("component_id", ""), whole)
        world_from_cam = torch.tensor(pose, dtype=torch.float64).reshape(4, 4)
        rotations.append(frame.apply_to_rotation(world_from_cam[:3, :3].mT))
        centers.append(frame.apply(world_from_cam[:3, 3]))
        fields.append(lenses.get(camera.get("sensor_id", "")))
        names.append(camera.get("label", ""))
    if not names:
        raise SceneError(f"{path} has no aligned camera; export it after the alignment")
    unknown = torch.tensor(NO_LENS, dtype=torch.float64)
    field = torch.stack([unknown if found is None else found for found in fields])
    found = Viewpoints(tuple(names), torch.stack(centers), torch.stack(rotations), field)
    reference = (chunk.findtext("reference") or "").strip()
    if not reference or reference.upper().startswith(LOCAL):
        return found
    return _on_map(found, reference, crs, path)


def _chunk(path: Path) -> Element:
    if not path.is_file():
        raise SceneError(f"{path} does not exist, but cameras must be a folder, an XML file or a table")
    if path.stat().st_size > MOST_MEGABYTES_OF_A_SCENE * MEGABYTE:
        raise SceneError(f"{path} has more than {MOST_MEGABYTES_OF_A_SCENE} MB; is it the right file?")
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise SceneError(f"{path} is not valid XML: {error}") from None
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise SceneError(f"{path} has no chunk; export the cameras from Metashape as XML")
    return chunk


def _similarity(part: Element, path: Path) -> Similarity:
    """`world_from_chunk`; what is not stated is that of frames that are the same."""
    place = part.find("transform")
    place = Element("transform") if place is None else place
    rotation = _numbers(place, "rotation", 9, path) or np.eye(3).ravel().tolist()
    translation = _numbers(place, "translation", 3, path) or [0.0] * 3
    scale = _numbers(place, "scale", 1, path) or [1.0]
    turn, shift, factor = (torch.tensor(values, dtype=torch.float64) for values in (rotation, translation, scale))
    return Similarity(factor[0], turn.reshape(3, 3), shift)


def _lens(sensor: Element, path: Path) -> Float[Tensor, " 4"] | None:
    """`Viewpoints.field` of a frame camera; None of others, and of those without a calibration."""
    every = sensor.findall("calibration")
    adjusted = [one for one in every if one.get("class") == "adjusted"] or every
    if not adjusted or adjusted[0].get("type", sensor.get("type", "frame")) != "frame":
        return None
    calibration = adjusted[0]
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    focal = _numbers(calibration, "f", 1, path)
    if size is None or focal is None:
        return None
    values = {name: (_numbers(calibration, name, 1, path) or [0.0])[0] for name in
              ("cx", "cy", "b1", "k1", "k2", "k3", "p1", "p2")}  # fmt: skip
    try:
        width, height = (int(size.get(side, "")) for side in ("width", "height"))
        middle = width / 2 + values["cx"], height / 2 + values["cy"]
        distortion = [values[name] for name in ("k1", "k2", "p2", "p1", "k3")]
        lens = Intrinsics.create(width, height, (focal[0] + values["b1"], focal[0]), middle, distortion)
    except ValueError as error:
        raise SceneError(f"{path}: sensor {sensor.get('label')!r} cannot be right: {error}") from None
    if (wrong := implausible(lens)) is not None:
        raise SceneError(f"{path}: sensor {sensor.get('label')!r}: {' '.join(wrong)}")
    return field_of_view(Cameras.of([lens]), torch.zeros(1, dtype=torch.long))[0]


def _numbers(part: Element, name: str, count: int, path: Path) -> list[float] | None:
    """Those in an element of some name; None where there is none."""
    text = part.findtext(name)
    if text is None or not text.strip():
        return None
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise SceneError(f"{path}: {name} of {part.tag} {part.get('label', '')!r} must be {count} finite numbers")
    return values


def _on_map(found: Viewpoints, reference: str, crs: str | None, path: Path) -> Viewpoints:
    """From geocentric coordinates of the datum of `reference` into a projected system."""
    try:
        from pyproj import CRS, Transformer  # noqa: PLC0415 - of an extra
        from pyproj.crs import GeocentricCRS  # noqa: PLC0415
        from pyproj.exceptions import CRSError  # noqa: PLC0415
    except ImportError:
        raise SceneError(f"{path} has cameras on Earth, which needs pyproj: pip install torchrefrac[geo]") from None
    try:
        own, target = CRS.from_user_input(reference), CRS.from_user_input(crs or reference)
        flat = horizontal_part(target)
        if not flat.is_projected:
            remedy = "give the projected one of the cloud, such as crs=EPSG:32633"
            raise SceneError(f"{path} has cameras in {flat.name}, which is no map; {remedy}")
        geocentric = GeocentricCRS(datum=horizontal_part(own).geodetic_crs.datum)
        onto = Transformer.from_crs(geocentric, target if target.is_compound else target.to_3d(), always_xy=True)
    except CRSError as error:
        raise SceneError(f"{path}: a reference system is not known: {error}") from None
    axes = found.rotation
    assert axes is not None
    center = _moved(onto, found.center)
    steps = torch.stack([_moved(onto, found.center + STEP * axes[:, i]) - center for i in range(3)], dim=1)
    if not bool(center.isfinite().all()):
        raise SceneError(f"{path} has cameras that do not lie on the map {crs or reference}")
    return Viewpoints(found.names, center, nearest_rotation(steps), found.field, target.to_wkt())


def _moved(onto: Any, points: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    return torch.from_numpy(np.stack(onto.transform(*points.T.numpy()), axis=-1))
