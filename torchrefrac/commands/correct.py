"""The cloud of another program, corrected point by point for refraction, into files."""

import math
import time
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.atomic import replacing
from torchrefrac.camera import Intrinsics
from torchrefrac.commands.results import OutRefusedError, require_replaceable
from torchrefrac.config.build import OptionError
from torchrefrac.config.clouds import CorrectOptions
from torchrefrac.correction import Correction, Forecast, Totals, correct_points, forecast_errors
from torchrefrac.errors import TorchrefracError
from torchrefrac.files.clouds import Changed, open_cloud
from torchrefrac.files.metadata.camera_file import read_camera
from torchrefrac.files.paths import real_path
from torchrefrac.files.run import RunRecord
from torchrefrac.files.swap import alone
from torchrefrac.files.systems import length_unit, map_name, same_map
from torchrefrac.files.viewpoints import read_viewpoints
from torchrefrac.files.water_surface import read_water_surface
from torchrefrac.numerics import thin
from torchrefrac.recorder import Advance, Recorder
from torchrefrac.scene import LevelWater, Viewpoints, WaterHeights

STEM = "corrected"
SAMPLE = 4000  # points of which the error that is left is estimated
FIELDS = {
    "depth": "below the water's surface",
    "apparent_depth": "before the correction",
    "views": "cameras, 0: not corrected",
    "incidence": "mean of rays in air (degree)",
    "sigma": "standard deviation",
}


class CorrectionError(TorchrefracError, ValueError):
    """There is nothing to correct, or nothing to correct it by; the message says what does not fit."""


def correct_cloud(options: CorrectOptions, recorder: Recorder) -> dict[str, Any]:
    """Write corrected.EXT, in the format of the cloud, and metrics.json into the folder `out`; returns the metrics.

    Raises CloudError, SceneError, CaptureError, OptionError or CorrectionError, each one sentence, and leaves
    everything as it is then.
    """
    start, folder, path = time.perf_counter(), Path(options.out), Path(options.cloud)
    cloud = open_cloud(path)
    target = folder / f"{STEM}{path.suffix.lower()}"
    if real_path(target) == real_path(path):
        raise OutRefusedError(f"out is {folder}, where the cloud lies, but it must stay; name another folder")
    crs = options.crs or cloud.crs
    viewpoints = read_viewpoints(Path(options.cameras), _lens(options), crs)
    water, water_crs = _water(options)
    systems = {"crs": options.crs, "the cloud": cloud.crs, "cameras": viewpoints.crs, "water.surface": water_crs}
    _require_one_map({name: system for name, system in systems.items() if system is not None})
    _require_above(viewpoints, water)
    folder.mkdir(parents=True, exist_ok=True)
    with alone(folder):
        require_replaceable(folder, "correct", (target.name,))
        with replacing(target) as temporary:
            with recorder.meter(cloud.count, "correcting", "point") as advance:
                work = _Work(water, viewpoints, options, advance)
                cloud.rewrite(temporary, work.change, FIELDS)
            work.require_something(path)
        about = {"status": "complete", "stages": [], "command": "correct", "cloud": str(real_path(path)),
                 "cameras": str(real_path(options.cameras)), "method": options.method}  # fmt: skip
        unit = length_unit(crs)
        metrics = about | {"index_ratio": options.index_ratio, "length_unit": unit, "images": len(viewpoints)}
        metrics |= total_metrics(work.totals, unit) | work.missing
        RunRecord.of(folder, metrics).write()  # the cloud is complete, whatever becomes of what is said of it
        if options.forecast:
            metrics |= forecast_metrics(work.forecast(recorder), unit)
        metrics["seconds_total"] = round(time.perf_counter() - start, 3)
        RunRecord.of(folder, metrics).write()
    return metrics


def total_metrics(totals: Totals, unit: str) -> dict[str, Any]:
    """Counts, and means and root mean squares of corrected points."""
    count = totals.corrected

    def rms(square: float) -> float:
        return math.sqrt(square / count)

    misfit, depth = rms(totals.misfit_sq), rms(totals.depth_sq)
    return {
        "points": totals.points,
        "points_below_water": totals.below,
        "points_corrected": count,
        "points_not_corrected": totals.below - count,
        "points_without_water": totals.without_water,
        "views_mean": totals.views / count,
        "incidence_mean_deg": math.degrees(totals.incidence / count),
        f"depth_mean_{unit}": totals.depth / count,
        f"depth_max_{unit}": totals.deepest,
        "depth_over_apparent": totals.depth / totals.apparent_depth,
        f"ray_misfit_rms_{unit}": misfit,
        "ray_misfit_percent_of_depth": 100.0 * misfit / depth,
        f"sigma_rms_{unit}": rms(totals.sigma_sq),
    }


def forecast_metrics(found: Forecast | None, unit: str) -> dict[str, Any]:
    """Errors that are expected to be left, and that the cloud as it was is expected to have."""
    if found is None:
        return {}
    return {
        f"error_left_rms_{unit}": found.left,
        "error_left_percent_of_depth": 100.0 * found.left / found.depth,
        f"error_uncorrected_rms_{unit}": found.before,
    }


class _Work:
    """Corrects a cloud part by part, and keeps what is said of the whole."""

    def __init__(self, water: WaterHeights, viewpoints: Viewpoints, options: CorrectOptions, advance: Advance) -> None:
        self.totals = Totals()
        self._water, self._viewpoints, self._rules, self._advance = water, viewpoints, options, advance
        self._sample: list[Float[Tensor, "k 3"]] = []
        self._left_out: list[Float[Tensor, "2 3"]] = []

    def change(self, points: Float[Tensor, "n 3"]) -> Changed:
        """The points of one part, corrected."""
        level, wet = self._water.at(points[:, :2])
        found = correct_points(points, level, wet, self._viewpoints, self._rules)
        self.totals += Totals.of(found, points, wet)
        self._sample.append(thin(points[points.isfinite().all(dim=-1)], SAMPLE))
        self._note_left_out(points, found)
        self._advance(len(points), "")
        sigma = torch.where(found.sigma.isfinite(), found.sigma, torch.nan)
        values = (found.depth, found.apparent_depth, found.views.double(), found.incidence.rad2deg(), sigma)
        return Changed(found.points, found.corrected, dict(zip(FIELDS, values, strict=True)))

    def _note_left_out(self, points: Float[Tensor, "n 3"], found: Correction) -> None:
        rows = points[found.below & ~found.corrected]
        if len(rows):
            self._left_out.append(torch.stack(torch.aminmax(rows, dim=0)))

    @property
    def missing(self) -> dict[str, Any]:
        """The box around points below the water that were not corrected, as west, south, east and north."""
        if not self._left_out:
            return {}
        boxes = torch.stack(self._left_out)
        west, south = boxes[:, 0, :2].amin(dim=0).tolist()
        east, north = boxes[:, 1, :2].amax(dim=0).tolist()
        return {"not_corrected_extent": [west, south, east, north]}

    def require_something(self, path: Path) -> None:
        """Raise CorrectionError where nothing was corrected."""
        if not self.totals.below:
            above = f"the lowest lies {self.totals.lowest:g} above it" if math.isfinite(self.totals.lowest) else ""
            where = above or "there is no water where the points are"
            raise CorrectionError(
                f"no point of {path} lies below the water: {where}; give the water's height in the frame of the cloud"
            )
        if not self.totals.corrected:
            rules = self._rules
            raise CorrectionError(
                f"none of {self.totals.below} points below the water is seen by {rules.min_views} cameras within "
                f"max_angle_deg={rules.max_angle_deg:g}: cameras stand in {_box(self._viewpoints.center)}, points in "
                f"{_box(torch.cat(self._sample))}; are both in one frame?"
            )

    def forecast(self, recorder: Recorder) -> Forecast | None:
        """The error that is expected to be left, from a sample of all parts."""
        points = thin(torch.cat(self._sample), SAMPLE)
        with recorder.meter(1, "estimating", "") as advance:
            found = forecast_errors(points, *self._water.at(points[:, :2]), self._viewpoints, self._rules)
            advance(1, "")
        return found


def _box(points: Float[Tensor, "n 3"]) -> str:
    low, high = (values.tolist() for values in torch.aminmax(points, dim=0))
    return ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in zip("xyz", low, high, strict=True))


def _lens(options: CorrectOptions) -> Intrinsics | None:
    if options.camera is not None:
        known = read_camera(Path(options.camera))
        lens = known.lens
        return Intrinsics.create(*known.size, lens.focal, lens.principal_point, lens.distortion, model=lens.model)
    if options.focal_px is None or options.size is None:
        return None
    width, height = options.size
    return Intrinsics.create(width, height, options.focal_px)


def _water(options: CorrectOptions) -> tuple[WaterHeights, str | None]:
    if options.water.surface is not None:
        return read_water_surface(Path(options.water.surface))
    assert options.water.level is not None
    return LevelWater(options.water.level), None


def _require_one_map(systems: dict[str, str]) -> None:
    """Raise OptionError where files are in several reference systems; what does not say one counts as in that of the
    others."""
    try:
        names = {name: map_name(system) for name, system in systems.items()}
        differing = [name for name, system in systems.items() if not same_map(next(iter(systems.values())), system)]
    except ValueError as error:
        raise OptionError(str(error)) from None
    except ImportError:
        raise OptionError("reference systems are given, which need pyproj: pip install torchrefrac[geo]") from None
    for name in differing:
        first, own = next(iter(names.items()))
        raise OptionError(f"{first} is in {own}, but {name} in {names[name]}; bring both into one system")


def _require_above(viewpoints: Viewpoints, water: WaterHeights) -> None:
    """Raise CorrectionError where no camera stands above the water."""
    height, known = water.at(viewpoints.center[:, :2])
    z = viewpoints.center[:, 2]
    if bool((known & (z <= height)).all()):
        raise CorrectionError(
            f"the water stands at {float(height.max()):g}, but all {len(viewpoints)} cameras are below it (the highest "
            f"at {float(z.max()):g}); give its height in the frame of the cloud and cameras"
        )
