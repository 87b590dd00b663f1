"""`tracks.npz`: the tie points of a run beside its `cameras.json`; the two together are a scene."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchrefrac.files.cameras import CAMERAS, read_cameras
from torchrefrac.files.colmap.model import find_colmap, read_colmap
from torchrefrac.files.npz import read_arrays, write_arrays
from torchrefrac.files.swap import settle
from torchrefrac.scene import Observations, Scene, SceneError
from torchrefrac.scene.scene import require_index

TRACKS = "tracks.npz"
ARRAYS = {"names": "U:m", "image": "i:k", "point": "i:k", "pixels": "n:k2", "points": "n:n3", "colors": "c:n3"}
DRY, NOISE = "dry", "noise"
COVARIANCES = ("point_covariance", "relative_covariance")


def write_tracks(scene: Scene, path: str | Path) -> None:
    """Write the points of a finished scene, their colours and observations, and the names of its views, as a NumPy
    archive; which points are dry, where any are; the relative noise of pixels and the covariances of points, where they
    are known (float32)."""
    seen = scene.observations
    tensors = (seen.view, seen.point, seen.pixels, scene.points, scene.colors)
    arrays = (np.array(scene.views.names, dtype=np.str_), *(value.detach().cpu().numpy() for value in tensors))
    dry = {} if scene.dry is None else {DRY: scene.dry.cpu().numpy()}
    known = {name: getattr(scene.assessment, name) for name in COVARIANCES} | {NOISE: seen.noise}
    floats = {name: value.float().cpu().numpy() for name, value in known.items() if value is not None}
    write_arrays(dict(zip(ARRAYS, arrays, strict=True)) | dry | floats, path)


def read_scene(folder: str | Path) -> Scene:
    """The registered views and their points of the run (`read_run`) or the COLMAP model (`read_colmap`) in `folder`: a
    run where it holds cameras.json and tracks.npz. Raises SceneError, and says what it looked for, where there is
    neither."""
    folder = Path(folder)
    settle(folder)
    if not folder.is_dir():
        raise SceneError(f"{folder} is not a folder; give that of a run or of a COLMAP model")
    has = {name: (folder / name).is_file() for name in (CAMERAS, TRACKS)}
    is_model = find_colmap(folder) is not None
    if all(has.values()) or (any(has.values()) and not is_model):
        run = read_run(folder)
        return run.of_views(run.views.registered)
    try:
        return read_colmap(folder)
    except SceneError as error:
        if is_model:
            raise
        raise SceneError(f"{folder} holds no run: looked for {CAMERAS} and {TRACKS}; {error}") from None


def read_run(folder: str | Path) -> Scene:
    """Read the views of a run and the tie points of those that are registered from cameras.json and tracks.npz.

    Points that fewer than two registered views see are left out. The frame is that of the run: z up, the water surface
    at z = 0. Raises SceneError, with the file and the field, for anything that cannot be right.
    """
    folder = Path(folder)
    settle(folder)
    for name in (CAMERAS, TRACKS):
        if not (folder / name).is_file():
            raise SceneError(f"{folder} holds no {name}, which a run has; reconstruct again, or name its run folder")
    cameras, path = read_cameras(folder / CAMERAS), folder / TRACKS
    optional = {DRY: "b:n", NOISE: "n:k", **dict.fromkeys(COVARIANCES, "n:n33")}
    wanted = {**ARRAYS, **optional}
    found = read_arrays(path, wanted, lambda problem: SceneError(f"{problem}; reconstruct again"), optional=optional)
    names = found.pop("names").tolist()
    if not names or len(set(names)) != len(names):
        raise SceneError(f"{path}: names must be a list of different texts, at least one; reconstruct again")
    for name in ("pixels", "points"):
        if not np.isfinite(found[name]).all():
            raise SceneError(f"{path}: {name} has a number that is not finite; reconstruct again")
    image, point, pixels, points, colors = (torch.from_numpy(found[name]) for name in ARRAYS if name != "names")
    views, number = cameras.views, {name: row for row, name in enumerate(cameras.views.names)}
    lacking = [name for name, row in number.items() if bool(views.registered[row]) and name not in names]
    if lacking:
        raise SceneError(f"{path} lacks {lacking[0]}, which {CAMERAS} has registered; take both from one run")
    row = torch.tensor([number.get(name, -1) for name in names])
    try:
        require_index(image, "image", len(names))
        noise = torch.from_numpy(found[NOISE]) if NOISE in found else None
        scene = cameras.with_points(points, colors, Observations(row[image].clamp(min=0), point, pixels, noise=noise))
        known = {name: torch.from_numpy(found[name]) for name in COVARIANCES if name in found}
        dry = torch.from_numpy(found[DRY]) if DRY in found else None
        scene = replace(scene, dry=dry, assessment=replace(scene.assessment, **known))
        scene.check()
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
    if noise is not None and not bool((noise.isfinite() & (noise > 0.0)).all()):
        raise SceneError(f"{path}: noise must be finite and above 0; reconstruct again")
    unknown = image[row[image] < 0]
    if len(unknown):
        name = names[int(unknown[0])]
        raise SceneError(f"{path} has observations in {name}, which {CAMERAS} lacks; take both from one run")
    posed = views.registered[scene.observations.view]
    return replace(scene, observations=scene.observations[posed], accepted=scene.accepted[posed]).cleaned()
