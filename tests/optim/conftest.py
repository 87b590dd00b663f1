"""Linear least-squares problems to eliminate points from."""

from collections.abc import Callable, Sequence

import pytest
import torch

from tests.optim.linear_problems import Linear, Term
from torchrefrac.optim import Family, covariance, elimination, normal_equations, plan


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
def cut(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`cut(tile, elements, gram, cached)`: smaller portions of work from now on."""

    def portions(tile: int = 64, elements: int = 1 << 19, gram: int = 64, cached: int = 16384) -> None:
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
