"""What a drone would write into the photographs of a made scene: where in the world it lies is made up."""

import math
from collections.abc import Sequence
from datetime import datetime, timedelta

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.files.metadata.attitude import angles_of
from torchrefrac.files.metadata.dji_tags import DroneTags
from torchrefrac.files.metadata.local_frame import REMEDY, Grid, has_projections
from torchrefrac.geometry import so3_exp
from torchrefrac.scene import Georeference
from torchrefrac.synthetic.options import SyntheticOptions, seeded
from torchrefrac.synthetic.stage import Stage, StageError

CRS, ORIGIN = "EPSG:32633", (412_345.0, 5_312_345.0, 431.0)
"""Where the origin of every made scene lies: east, north, and the water above the ellipsoid."""
TAKE_OFF = 1.5  # m; of the place of the take-off above the water
START, SECONDS = datetime(2024, 5, 17, 11, 0, 0), 2  # time of the first photograph, and from each to the next


def drone_tags(stage: Stage, intrinsics: Sequence[Intrinsics], options: SyntheticOptions) -> list[DroneTags]:
    """Of each photograph, with errors of satellites and gimbal. intrinsics: of the cameras that take them in turn.

    Raises StageError where lengths are not in m, or pyproj is missing.
    """
    if stage.length_unit != "m":
        raise StageError(f"scene {options.name} is measured in {stage.length_unit}; metadata=drone needs a scene in m")
    if not has_projections():
        raise StageError(f"metadata=drone needs pyproj: {REMEDY}")
    sigma = options.drone.position_sigma
    error = torch.randn(stage.center.shape, generator=seeded(options.seed, "satellites"), dtype=torch.float64)
    spread = error.new_tensor((sigma[0], sigma[0], sigma[1]))
    grid = Grid(CRS)
    slope_east, slope_north, _ = (_world_from_level(options)[:, 2] / _world_from_level(options)[2, 2]).tolist()
    place = Georeference(CRS, ORIGIN, scale=grid.scale_at(ORIGIN, ORIGIN[2]), slope=(slope_east, slope_north))
    position = place.coordinates(stage.center + spread * error)
    latitude, longitude, north = grid.degrees(position[:, :2].numpy())
    yaw, pitch, roll = (angle.rad2deg() for angle in _gimbal(stage.rotation, options))
    rows = zip(
        latitude, longitude, position[:, 2].tolist(), (yaw - torch.from_numpy(north)).tolist(), pitch.tolist(),
        roll.tolist(), strict=True,
    )  # fmt: skip
    return [
        DroneTags(
            latitude=place[0],
            longitude=place[1],
            altitude=altitude,
            above_take_off=altitude - ORIGIN[2] - TAKE_OFF,
            sigma=(sigma[0], sigma[1]),
            yaw=(turn + 180.0) % 360.0 - 180.0,
            pitch=tilt,
            roll=(side + 180.0) % 360.0 - 180.0,
            camera=i % len(intrinsics),
            intrinsics=intrinsics[i % len(intrinsics)],
            time=(START + timedelta(seconds=SECONDS * i)).strftime("%Y:%m:%d %H:%M:%S"),
        )
        for i, (*place, altitude, turn, tilt, side) in enumerate(rows)
    ]


def _world_from_level(options: SyntheticOptions) -> Float[Tensor, "3 3"]:
    """Into the frame of the water, which true gravity may not be perpendicular to, as on a river."""
    return so3_exp(torch.tensor((*options.plane_tilt_deg, 0.0), dtype=torch.float64).deg2rad())


def _gimbal(
    rotation: Float[Tensor, "m 3 3"], options: SyntheticOptions
) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"], Float[Tensor, " m"]]:
    """Yaw from the grid's north, pitch and roll, radians, of cameras with `cam_from_world` rotation: true gravity may
    depart from the perpendicular of the water, and the gimbal from what it says."""
    tilt = _world_from_level(options)
    shaken = torch.randn(len(rotation), 3, generator=seeded(options.seed, "gimbal"), dtype=torch.float64)
    yaw, pitch, roll = angles_of(so3_exp(math.radians(options.drone.gimbal_sigma_deg) * shaken) @ rotation @ tilt)
    past = roll.abs() > 0.75 * math.pi  # straight down, which this gimbal says by a pitch below -90 degrees
    return (
        torch.where(past, yaw + math.pi, yaw),
        torch.where(past, -math.pi - pitch, pitch),
        torch.where(past, roll + math.pi, roll),
    )
