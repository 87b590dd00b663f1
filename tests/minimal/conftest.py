"""Pairs of cameras and single ones above a basin, as the solvers see them."""

import pytest


@pytest.fixture
def make_pair(make_basin, draw):
    """`make_pair(*shape, points=7, noise=0.0)`: level rays of both cameras, of pixels with that much noise, and the
    heading and centre of the second."""

    def make(*shape, points=7, noise=0.0):
        basin = make_basin(*shape, points=points)
        rays = basin.level_rays()
        if noise:
            pixels, _ = basin.project()
            rays = basin.level_rays_of(pixels + noise * draw.normal(*pixels.shape))
        return *rays.unbind(dim=-3), *basin.second_from_first()

    return make


@pytest.fixture
def make_view(make_basin):
    """`make_view(*shape, points=2, land=0, index_ratio=1.33)`: exact level rays, the points, and the heading and centre
    of the camera."""

    def make(*shape, points=2, land=0, index_ratio=1.33):
        basin = make_basin(*shape, cameras=1, points=points, land=land, index_ratio=index_ratio)
        return basin.level_rays()[..., 0, :, :], basin.points, basin.heading[..., 0], basin.center[..., 0, :]

    return make
