"""Ground control, check points and epochs on the made riverbed, clicked along the renderer's own rays.

    python tools/bench/ground_control.py clicks FLIGHT   # control.csv and clicks.csv in an imported flight's folder
    python tools/bench/ground_control.py epochs

clicks: the flight is one of `torchrefrac scene=riverbed scene.metadata=drone`, imported (docs/survey.md has the
commands); four control points and four check points on the bed, stated to 0.5 cm and clicked to 0.3 px. epochs:
tracks to 0.3 px of two flights, between which the water rose by 30 cm, RTK positions to 2 and 3 cm, the four
control points and ten points on the waterline of each; how well the levels and the bed are found.
"""

import argparse
import csv
import math
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.evaluate.metrics import summarize
from torchrefrac.features import Features, PairMatches, build_tracks
from torchrefrac.files.capture import load_capture
from torchrefrac.geometry import so3_exp
from torchrefrac.geometry.surfaces import Surface, nearest
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.recorder import SilentRecorder
from torchrefrac.scene import Cameras, Capture, Georeference, Interfaces, Scene, Survey
from torchrefrac.scene.survey import ControlPoint, resolve
from torchrefrac.sfm import RefractiveInitializer, SfmOptions, reconstruct_sparse, verify_pairs
from torchrefrac.synthetic.drone import CRS, ORIGIN
from torchrefrac.synthetic.options import CameraOptions
from torchrefrac.synthetic.photograph import Photographer
from torchrefrac.synthetic.scenes import RiverbedOptions, stage_of

OPTIONS = RiverbedOptions(name="riverbed", camera=CameraOptions(fov_deg=65.0))
NOISE, STATED = 0.3, 0.005  # px of clicks and keypoints; m of stated points
CONTROL = 4
RISE, POSITION, WATERLINE = 0.3, (0.02, 0.02, 0.03), 0.01  # m
LINES = (-13.0, -10.0, -7.0, -4.0, -1.0, 2.0, 5.0, 8.0, 11.0, 14.0)  # across the river, m east of the middle
STEPS, CLOSE, STEP = 12, 1e-3, 0.05  # of Newton's method; m; px
PLACES = {
    "P1": (-11.0, -9.0), "P2": (11.0, -8.0), "P3": (10.0, 9.0), "P4": (-10.0, 10.0),
    "check1": (-5.0, 0.0), "check2": (4.0, -5.0), "check3": (6.0, 5.0), "check4": (-3.0, 7.0),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description="Ground control on the made riverbed.")
    parser.add_argument("what", choices=("clicks", "epochs"))
    parser.add_argument("flight", nargs="?", type=Path)
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    chance = torch.Generator().manual_seed(arguments.seed)
    if arguments.what == "clicks":
        write_clicks(arguments.flight, chance)
    else:
        epochs(chance)


def ground(photographer: Photographer, xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """What lies below places: a plumb line is not bent."""
    above = torch.cat((xy, torch.full_like(xy[:, :1], 99.0)), dim=-1)
    met = nearest([piece.surface for piece in photographer.stage.pieces], above, -_up(1.0).expand(len(xy), 3))
    return above - met.length[:, None] * _up(1.0)


def clicks(
    photographer: Photographer, image: int, points: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"]]:
    """The pixels whose rays end on points, by Newton's method along the renderer's rays, and where these are found."""
    stage, lens = photographer.stage, photographer.intrinsics
    in_cam = (points - stage.center[image]) @ stage.rotation[image].mT
    pixels = in_cam[:, :2] / in_cam[:, 2:] * lens.focal + lens.principal_point

    def off(at: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
        return photographer.look(image, at).points - points

    for _ in range(STEPS):
        now = off(pixels)[:, :2]
        slopes = [(off(pixels + by)[:, :2] - now) / STEP for by in STEP * torch.eye(2, dtype=torch.float64)]
        jacobian = torch.stack(slopes, dim=-1)
        usable = jacobian.isfinite().all(dim=-1).all(dim=-1) & now.isfinite().all(dim=-1)
        usable &= torch.linalg.det(torch.where(usable[:, None, None], jacobian, 0.0)).abs() > 1e-12
        safe = torch.where(usable[:, None, None], jacobian, torch.eye(2, dtype=torch.float64))
        step = torch.linalg.solve(safe, torch.where(usable[:, None], now, 0.0)[..., None])[..., 0]
        pixels = pixels - step.clamp(-50.0, 50.0)
    size = pixels.new_tensor((lens.width, lens.height))
    inside = ((pixels > 4.0) & (pixels < size - 4.0)).all(dim=-1)
    return pixels, inside & (off(pixels).norm(dim=-1) < CLOSE)


def write_clicks(flight: Path, chance: torch.Generator) -> None:
    """Both tables, in the reference system in which the drone says that it was."""
    photographer = Photographer.of(stage_of(OPTIONS), OPTIONS)
    points = ground(photographer, torch.tensor([*PLACES.values()], dtype=torch.float64))
    stated = _place().coordinates(points + STATED * _normal(chance, *points.shape))
    with (flight / "control.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        file.write(f"# {CRS}\n")
        table.writerow(("name", "x", "y", "z", "sigma"))
        table.writerows((name, *at, STATED) for name, at in zip(PLACES, stated.tolist(), strict=True))
    with (flight / "clicks.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(("image", "name", "px", "py"))
        for image, name in enumerate(sorted(load_capture(flight).names)):
            pixels, seen = clicks(photographer, image, points)
            pixels = pixels + NOISE * _normal(chance, *pixels.shape)
            rows = zip(PLACES, pixels.tolist(), seen.tolist(), strict=True)
            table.writerows((name, point, *at) for point, at, there in rows if there)
    print(f"points at {[[round(x, 2) for x in point] for point in points.tolist()]}")


def _place() -> Georeference:
    from torchrefrac.files.metadata.local_frame import Grid  # noqa: PLC0415

    return Georeference(CRS, ORIGIN, scale=Grid(CRS).scale_at(ORIGIN, ORIGIN[2]))


def epochs(chance: torch.Generator) -> None:
    """Both flights in one adjustment, and what is found of the water and of the bed."""

    first = Photographer.of(stage_of(OPTIONS), OPTIONS)
    flights = first, _under_higher_water(first)
    count = len(first.stage.center)
    epoch = torch.arange(count) % 2
    xy = 17.0 * (2.0 * torch.rand(1200, 2, generator=chance, dtype=torch.float64) - 1.0)
    shore = [_shore(first, level) for level in (0.0, RISE)]
    control = ground(first, torch.tensor([*PLACES.values()], dtype=torch.float64)[:CONTROL])
    points = torch.cat((ground(first, xy), *shore, control))
    found = [clicks(flights[epoch[i]], i, points - _up(RISE * float(epoch[i]))) for i in range(count)]
    pixels = torch.stack([at for at, _ in found]) + NOISE * _normal(chance, count, len(points), 2)
    seen = torch.stack([there for _, there in found])
    capture = _capture(first, chance, epoch)
    ties = len(xy)
    controls = {}
    for i in range(ties, len(points) - CONTROL):
        of = (i - ties) // len(shore[0])
        views = (seen[:, i] & (epoch == of)).nonzero()[:, 0].tolist()
        controls[f"W{i}"] = ControlPoint({capture.names[v]: pixels[v, i].tolist() for v in views}, waterline=WATERLINE)
    stated = control + _up(ORIGIN[2]) + STATED * _normal(chance, CONTROL, 3)
    for i, position in zip(range(len(points) - CONTROL, len(points)), stated.tolist(), strict=True):
        views = seen[:, i].nonzero()[:, 0].tolist()
        known = position, (torch.eye(3) / STATED**2).tolist()
        controls[f"P{i}"] = ControlPoint({capture.names[v]: pixels[v, i].tolist() for v in views}, known)
    survey = resolve({}, controls, [], capture.names)
    scene = _reconstructed(capture, seen[:, :ties], pixels[:, :ties], survey)
    levels = summarize(scene)["water_levels_m"]
    for (name, level), true in zip(levels.items(), (ORIGIN[2], ORIGIN[2] + RISE), strict=True):
        print(f"{name}: {level['height']:.4f} m +- {level['sigma']:.4f}, off by {level['height'] - true:+.4f} m")
    lowered = scene.assessment.lowered_by or 0.0
    number = scene.colors[:, 0].long() + 256 * scene.colors[:, 1].long()
    off = scene.points[:, 2] + lowered - ORIGIN[2] - points[number, 2]
    of_point = torch.zeros(len(scene.points), 2).double()
    of_point.index_put_((scene.observations.point, epoch[scene.observations.view]), torch.ones(()).double())
    for name, rows in (("both", of_point.all(dim=1)), ("may", of_point[:, 1] == 0.0), ("june", of_point[:, 0] == 0.0)):
        if bool(rows.any()):
            print(f"bed seen in {name}: {int(rows.sum())} points, {float(off[rows].median()):+.4f} m (median) too high")
    shown = (
        "" if scene.assessment.surveyed is None else f"{int(scene.assessment.surveyed.placed.sum())} control points, "
    )
    print(f"{len(scene.points)} points, {shown}warnings: {summarize(scene)['warnings']}")


def _up(by: float) -> Float[Tensor, " 3"]:
    return torch.tensor((0.0, 0.0, by), dtype=torch.float64)


def _under_higher_water(photographer: Photographer) -> Photographer:
    """The same with ground and cameras lower by RISE: the renderer's water is z = 0."""
    stage, scenery = photographer.stage, photographer.scenery
    lower = tuple(replace(one, surface=_lower(one.surface)) for one in stage.pieces)
    stage = replace(stage, pieces=lower, center=stage.center - _up(RISE))
    return replace(photographer, stage=stage, scenery=replace(scenery, pieces=stage.pieces))


def _lower(surface: Surface) -> TriangleMesh:
    vertices, faces = surface.triangles()
    return TriangleMesh(vertices - _up(RISE), faces)


def _shore(photographer: Photographer, level: float) -> Float[Tensor, "n 3"]:
    """Where the ground is at a level, on lines across the river."""
    y = torch.linspace(-19.0, 19.0, 4001, dtype=torch.float64)
    found = []
    for x in LINES:
        line = ground(photographer, torch.stack((torch.full_like(y, x), y), dim=-1))
        crossing = ((line[:-1, 2] - level) * (line[1:, 2] - level) < 0.0).nonzero()[:, 0]
        before, after = line[crossing[-1]], line[crossing[-1] + 1]
        found.append(before + (level - before[2]) / (after[2] - before[2]) * (after - before))
    return torch.stack(found)


def _capture(photographer: Photographer, chance: torch.Generator, epoch: Int[Tensor, " m"]) -> Capture:
    """What a drone says of the photographs of both flights."""
    stage, count = photographer.stage, len(epoch)
    sigma = torch.tensor(POSITION, dtype=torch.float64).expand(count, 3)
    tilt = so3_exp(math.radians(0.3) * _normal(chance, count, 3))
    names = tuple(f"cam{i:02d}.jpg" for i in range(count))
    return Capture(
        folder=Path(),
        names=names,
        paths=tuple(map(Path, names)),
        cameras=Cameras.of([photographer.intrinsics]),
        interfaces=Interfaces.level(OPTIONS.index_ratio),
        down_in_cam=(tilt @ -stage.rotation[:, :, 2:])[..., 0],
        down_sigma=torch.full((count,), math.radians(0.3)).double(),
        height=torch.ones(count).double(),
        has_height=torch.zeros(count, dtype=torch.bool),
        length_unit="m",
        position=stage.center + _up(ORIGIN[2]) + sigma * _normal(chance, count, 3),
        position_sigma=sigma,
        epochs=("may", "june"),
        epoch=epoch,
    )


def _reconstructed(
    capture: Capture, seen: Bool[Tensor, "m n"], pixels: Float[Tensor, "m n 2"], survey: Survey
) -> Scene:
    """From tracks, whose points have their numbers for colours."""
    number = torch.arange(seen.shape[1])
    colors = torch.stack((number % 256, number // 256, 0 * number), dim=-1).to(torch.uint8)
    of = [there.nonzero()[:, 0] for there in seen]
    features = [
        Features(pixels[i, rows], torch.zeros(len(rows), 128), colors[rows], torch.ones(len(rows)).double())
        for i, rows in enumerate(of)
    ]
    matches = [PairMatches(i, j, (of[i][:, None] == of[j]).nonzero()) for i, j in combinations(range(len(capture)), 2)]
    options, chance, recorder = SfmOptions(), torch.Generator().manual_seed(1), SilentRecorder()
    initializer = RefractiveInitializer(capture, capture.index_ratio, options)
    pairs = verify_pairs(matches, features, initializer, options.min_pair_inliers, chance, recorder)
    tracks, colors = build_tracks(features, [pair.pair for pair in pairs])
    scene = Scene.of_capture(capture, tracks, colors, capture.index_ratio)
    return reconstruct_sparse(scene, capture, pairs, initializer, options, chance, recorder, survey=survey)


def _normal(chance: torch.Generator, *shape: int) -> Float[Tensor, "..."]:
    return torch.randn(shape, generator=chance, dtype=torch.float64)


if __name__ == "__main__":
    main()
