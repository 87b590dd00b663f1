"""Pose problems with truth for the estimators."""

import math

import pytest
import torch

from torchrefrac.camera import Intrinsics, RefractiveCamera
from torchrefrac.geometry import heading_rotation, level_rotation, rotate, so3_exp
from torchrefrac.ransac import AbsolutePoseEstimator, RelativePoseEstimator
from torchrefrac.refinement import OneView, TwoViews, tilt_and_heading
from torchrefrac.refraction import FlatInterface

HEIGHT = 30.0  # of the first camera of a basin


@pytest.fixture
def make_problem(make_basin, draw):
    """`make_problem(kind, ...)`: an estimator, its true model, which matches are right, and the basin. noise in pixels;
    the last `outliers` matches have a random pixel in the last image; every vertical is off by gravity_error_deg."""

    def make(kind, *, points=200, noise=0.0, outliers=0, gravity_error_deg=0.0, known_heading=False, **scene):
        basin = make_basin(cameras=2 if kind == "relative" else 1, points=points, **scene)
        pixels, _ = basin.project()
        pixels = pixels + noise * draw.normal(*pixels.shape)
        if outliers:
            pixels[-1, -outliers:] = draw.uniform(0.0, 1.0, outliers, 2) * pixels.new_tensor((1024.0, 768.0))
        sideways = torch.nn.functional.normalize(torch.linalg.cross(basin.down_in_cam, draw.directions(len(pixels))))
        down = rotate(so3_exp(math.radians(gravity_error_deg) * sideways), basin.down_in_cam)
        return (
            *make_estimator(basin, pixels, down, gravity_error_deg, known_heading),
            torch.arange(points) < points - outliers,
            basin,
        )

    return make


def make_estimator(basin, pixels, down, gravity_error_deg, known_heading):
    plane, level = basin.lens.plane_from_pixels(pixels), level_rotation(down)
    index = torch.tensor(basin.index_ratio, dtype=torch.float64)
    tilt, heading = tilt_and_heading(level, basin.rotation)
    shared = {"focal": basin.lens.focal, "index_ratio": index, "gravity_sigma": math.radians(gravity_error_deg)}
    if len(plane) == 1:
        truth = torch.cat((tilt[0], heading, basin.center[0]))
        shared["known_heading"] = float(heading[0]) if known_heading else None
        return AbsolutePoseEstimator(OneView(plane[0], basin.points, level[0], **shared)), truth
    center = basin.center[1] - basin.center[0] * basin.center.new_tensor((1.0, 1.0, 0.0))
    turned = heading[1] - heading[0]
    truth = torch.cat((tilt.flatten(), turned[None], rotate(heading_rotation(heading[0]), center)))
    shared["known_heading"] = float(turned) if known_heading else None
    return RelativePoseEstimator(TwoViews(*plane, level, height=HEIGHT, **shared)), truth


@pytest.fixture
def make_degenerate(draw):
    """`make_degenerate(where, noise)`: 100 points in the vertical plane "along" the baseline, or "across" its middle,
    or "thin": anywhere under a millimetre of water."""

    def make(where, noise):
        half = 18.0
        center = torch.tensor([[-half, 0.0, 30.0], [half, 0.0, 30.0]], dtype=torch.float64)
        down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
        spread, depth = draw.uniform(-40.0, 40.0, 100), draw.uniform(-80.0, -20.0, 100)
        zero = torch.zeros_like(spread)
        places = {
            "along": (spread, zero, depth),
            "across": (zero, spread, depth),
            "thin": (spread, draw.uniform(-30.0, 30.0, 100), 0.0015 * depth),
        }
        points = torch.stack(places[where], dim=-1)
        lens = Intrinsics.create(1024, 768, 667.0)
        pixels, _ = RefractiveCamera(lens, down, center, FlatInterface(1.33))[:, None].project(points)
        plane = lens.plane_from_pixels(pixels + noise * draw.normal(*pixels.shape))
        level = level_rotation(torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64))
        index = torch.tensor(1.33, dtype=torch.float64)
        estimator = RelativePoseEstimator(TwoViews(*plane, level, lens.focal, index, 30.0, math.radians(0.5)))
        estimator.truth = center.new_tensor((0.0, 0.0, 0.0, 0.0, 0.0, 2.0 * half, 0.0, 30.0))
        return estimator

    return make
