from torchrefrac.geometry import so3_exp
import sys

sys.path[:0] = ["/work/main/tests", "/work/main/tests/sfm"]
import test_readjust as T, torch
from dataclasses import replace


def test_x(make_basin, draw):
    for seed in range(3):
        basin = make_basin(cameras=6, points=150, seen_by=3)
        planted = T.plant_alignment(basin, draw, 0.2)
        off = planted.truth.image == 4
        pixels = torch.where(off[:, None], draw.uniform(0.0, 768.0, len(off), 2), planted.truth.pixels)
        a = planted.as_of_a_pinhole(draw)
        f = T.readjust(replace(a, pixels=pixels), planted.water, options=T.options())
        print(
            "garbage",
            float(planted.off(f.alignment).max()),
            f.lost_images,
            len(f.alignment.points),
            float(f.errors_before.median()),
        )
        rot = a.rotation.clone()
        rot[4] = so3_exp(torch.deg2rad(15.0 * draw.directions())) @ rot[4]
        f = T.readjust(replace(a, rotation=rot), planted.water, options=T.options())
        print(
            "pose",
            float(planted.off(f.alignment).max()),
            f.lost_images,
            len(f.alignment.points),
            float(f.errors_before.median()),
        )
