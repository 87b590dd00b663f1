"""Linear least-squares problems to eliminate points from."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch

from tests.optim.linear_problems import Linear, Term
from torchrefrac.optim import Family, covariance, elimination, normal_equations, ordering, plan


@pytest.fixture
def make_linear(draw, generator) -> Callable[..., Linear]:
    """`make_linear()`: 45 of the 60 pairs of 5 cameras and 12 points, in any order, with random derivatives. families:
    (size, count) of each. With `extra` unknowns come terms, which also depend on all others and on what is held."""

    def make(
        cameras: int = 5,
        points: int = 12,
        pairs: int = 45,
        families: Sequence[tuple[int, int]] = (),
        extra: int = 0,
    ) -> Linear:
        pair = torch.randperm(cameras * points, generator=generator)[:pairs]
        member = [torch.randperm(cameras, generator=generator) % count for _, count in families]
        shared = tuple(Family(size, of, count) for (size, count), of in zip(families, member, strict=True))
        size = 6 * cameras + sum(s * count for s, count in families) + extra
        terms = ()
        if extra:
            some = [torch.randperm(size - extra, generator=generator)[:4] for _ in range(3 * extra)]
            last = torch.arange(size - extra, size + 1)  # those beside cameras and families, and what is held
            columns = torch.stack([torch.cat((ids, last, last[-1:])) for ids in some])
            jacobian = draw.normal(*columns.shape[:1], 3, columns.shape[1])
            terms = (Term(columns, jacobian, draw.normal(len(columns), 3)),)
        return Linear(
            camera=pair % cameras,
            point=pair // cameras,
            residual=draw.normal(pairs, 2),
            by_reduced=draw.normal(pairs, 2, 6 + sum(s for s, _ in families)),
            by_eliminated=draw.normal(pairs, 2, 3),
            weight=draw.uniform(0.1, 1.0, pairs),
            num_reduced=cameras,
            num_eliminated=points,
            families=shared,
            num_extra=extra,
            terms=terms,
        )

    return make


@pytest.fixture
def make_chain(make_linear, draw, generator) -> Callable[..., Linear]:
    """`make_chain()`: 24 cameras in a row, numbered in any order, of which each of 150 points is seen by three that
    follow each other; `ends` sees every tenth besides. families and extra as of `make_linear`."""

    def make(
        cameras: int = 24,
        points: int = 150,
        families: Sequence[tuple[int, int]] = (),
        extra: int = 0,
        ends: bool = False,
    ) -> Linear:
        linear = make_linear(cameras, 2, cameras, families, extra)
        first = torch.arange(points) * (cameras - 2) // points
        camera = torch.randperm(cameras, generator=generator)[first[:, None] + torch.arange(3)].flatten()
        point = torch.arange(points).repeat_interleave(3)
        if ends:
            hub = camera[0]
            often = torch.arange(0, points, 10)
            often = often[~(camera.view(-1, 3)[often] == hub).any(dim=1)]
            camera, point = torch.cat((camera, hub.expand(len(often)))), torch.cat((point, often))
        size = len(camera), 2
        return replace(
            linear,
            camera=camera,
            point=point,
            residual=draw.normal(*size),
            by_reduced=draw.normal(*size, 6 + sum(s for s, _ in families)),
            by_eliminated=draw.normal(*size, 3),
            weight=draw.uniform(0.1, 1.0, len(camera)),
            num_eliminated=points,
        )

    return make


@pytest.fixture
def cut(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`cut(tile, elements, gram, cached, section)`: smaller portions of work from now on."""

    def portions(
        tile: int = 64, elements: int = 1 << 19, gram: int = 64, cached: int = 16384, section: int = 96
    ) -> None:
        monkeypatch.setattr(ordering, "SMALLEST_SECTION", section)
        for module in (plan, elimination, covariance):
            monkeypatch.setattr(module, "TILE", tile)
        monkeypatch.setattr(plan, "CHUNK_ELEMENTS", elements)
        monkeypatch.setattr(plan, "GRAM_ROWS", gram)
        for module in (plan, normal_equations):
            monkeypatch.setattr(module, "CACHED", cached)
        slices = normal_equations.in_cache
        for module in (normal_equations, elimination):
            monkeypatch.setattr(module, "in_cache", lambda count, size=cached: slices(count, min(size, cached)))

    return portions
