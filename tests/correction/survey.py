"""Cameras over water, and slow scalar corrections of single points."""

import math

import numpy as np
import torch

from torchrefrac.scene import Viewpoints

DOWN = torch.diag(torch.tensor((1.0, -1.0, -1.0), dtype=torch.float64))


def looking_down(center, half=1.2, **others):
    """Cameras at these places that look straight down, with fields of +- half in x/z and y/z."""
    m = len(center)
    field = center.new_tensor((-half, half, -half, half)).expand(m, 4)
    return Viewpoints(tuple(f"{i}.jpg" for i in range(m)), center, DOWN.expand(m, 3, 3), field, **others)


def ring(point, radius, height, count=6):
    """Places around a point, all as far away and as high."""
    angle = torch.arange(count, dtype=torch.float64) * (2.0 * math.pi / count)
    x, y = point[0] + radius * angle.cos(), point[1] + radius * angle.sin()
    return torch.stack((x, y, torch.full_like(angle, height)), dim=-1)


def bent_ray(camera, point, level, n):
    """Where the straight line enters the water, and which way its light goes on: Snell's law in angles."""
    way = point - camera
    entry = camera + way * (level - camera[2]) / way[2]
    across = math.hypot(way[0], way[1])
    in_air = math.atan2(across, -way[2])
    in_water = math.asin(math.sin(in_air) / n)
    to = way[:2] / across if across else np.zeros(2)
    return entry, np.array((*(math.sin(in_water) * to), -math.cos(in_water)))


def met_by_rays(cameras, point, level, n):
    """The point nearest to all bent rays, each over the way from its camera: a dense least-squares solve."""
    rows, rhs = [], []
    for camera in cameras:
        entry, along = bent_ray(camera, point, level, n)
        across = (np.eye(3) - np.outer(along, along)) / np.linalg.norm(point - camera)
        rows.append(across)
        rhs.append(across @ entry)
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(rhs), rcond=None)[0]


def mean_of_dietrich(cameras, point, level, n):
    """Dietrich (2017), as pyBathySfM computes it: h = h_a tan(r) / tan(i), r in air and i in the water."""
    depths = []
    for camera in cameras:
        r = math.atan(math.hypot(point[0] - camera[0], point[1] - camera[1]) / (camera[2] - point[2]))
        i = math.asin(math.sin(r) / n)
        x = (level - point[2]) * math.tan(r)
        depths.append(x / math.tan(i))
    return np.array((point[0], point[1], level - sum(depths) / len(depths)))
