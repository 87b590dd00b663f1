"""Scalar products of unit descriptors from few bits of each, several times as fast as exact ones, and how far they err.

Descriptors are rounded to what the processor multiplies fastest: bytes on one with instructions for their products
(VNNI), half precision on a GPU, single precision on any other.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

LARGEST = 127.0
"""Of a byte."""
DEVIATIONS = 6.0
"""Rounding errors of single components are independent, so that next to no product errs by more times its standard
deviation."""
GROUPS = 128
"""Of columns, every so many-th in one: the second largest of a row is the largest of its group, or lies in the same
group as the largest of all. To look for two of few groups, and of one group, is cheaper than to look for two of all."""


class Kind(NamedTuple):
    """How descriptors are rounded. product: the type of their products; smallest: a value that none has; rounding: how
    far products err in units of one beside what descriptors do; rows, columns: how many (of columns twice GROUPS at
    least) are multiplied at a time, which are looked through while the processor's cache has them."""

    values: torch.dtype
    product: torch.dtype
    smallest: float
    rounding: float
    rows: int
    columns: int


BYTES = Kind(torch.int8, torch.int32, -(2.0**31), 0.0, 512, 1024)
HALF = Kind(torch.float16, torch.float16, -math.inf, 2.0**-11, 4096, 8192)
SINGLE = Kind(torch.float32, torch.float32, -math.inf, 1e-6, 512, 1024)


class RoughDescriptors(NamedTuple):
    """Rounded multiples of unit descriptors. error: length of what rounding took from each, in units of one."""

    kind: Kind
    values: Shaped[Tensor, "n d"]
    scale: Float[Tensor, ""]
    error: Float[Tensor, " n"]

    @classmethod
    def of(cls, descriptors: Float[Tensor, "n d"], kind: Kind | None = None) -> "RoughDescriptors":
        """By default of the kind that is fastest where the descriptors are."""
        kind = kind or _fastest(descriptors.device)
        scale = descriptors.new_ones(())
        values = descriptors
        if kind is BYTES:
            scale = LARGEST / descriptors.abs().amax().clamp(min=1e-12)
            values = (descriptors * scale).round_()
        values = values.to(kind.values)
        return cls(kind, values, scale, (descriptors - values / scale).norm(dim=1))

    def rows(self, rows: Int[Tensor, " some"]) -> "RoughDescriptors":
        return self._replace(values=self.values[rows], error=self.error[rows])


class Nearest(NamedTuple):
    """For each of some descriptors, of the others: which has the largest product, the two largest products, and how far
    each of these may err."""

    target: Int[Tensor, " n"]
    largest: Float[Tensor, " n"]
    second: Float[Tensor, " n"]
    error: Float[Tensor, " n"]

    @property
    def is_certain(self) -> Bool[Tensor, " n"]:
        """Whether no other can have a larger product than the target."""
        return self.largest - self.second > 2.0 * self.error


def nearest_of(some: RoughDescriptors, others: RoughDescriptors) -> Nearest:
    """The nearest of `others` (one at least) to each of `some`. One buffer serves all rows: new memory takes as long as
    what is computed."""
    kind, n, m = some.kind, len(some.values), len(others.values)
    tiles, groups = -(-m // kind.columns), kind.columns // GROUPS
    columns = torch.nn.functional.pad(others.values, (0, 0, 0, tiles * kind.columns - m)).unflatten(0, (tiles, -1))
    buffer = some.values.new_empty(tiles * min(kind.rows, n) * kind.columns, dtype=kind.product)
    two = some.values.new_empty(n, 2, dtype=kind.product)
    target = torch.empty(n, dtype=torch.long, device=two.device)
    for start in range(0, n, kind.rows):
        rows = some.values[start : start + kind.rows]
        products = buffer[: tiles * len(rows) * kind.columns].view(tiles, len(rows), kind.columns)
        of_groups = products.new_full((len(rows), GROUPS), kind.smallest)
        for number, part in enumerate(products):
            _multiply(rows, columns[number].T, part)
            part[:, m - number * kind.columns :] = kind.smallest  # of none but the last
            torch.maximum(of_groups, part.unflatten(1, (groups, GROUPS)).amax(dim=1), out=of_groups)
        best, group = of_groups.topk(2, dim=1)
        place = group[None, :, :1, None].expand(tiles, -1, groups, 1)
        of_group = products.unflatten(2, (groups, GROUPS)).gather(3, place)[..., 0].transpose(0, 1).flatten(1)
        inside, member = of_group.topk(2, dim=1)
        rows_done = slice(start, start + len(rows))
        two[rows_done, 0], two[rows_done, 1] = inside[:, 0], torch.maximum(inside[:, 1], best[:, 1])
        target[rows_done] = member[:, 0] * GROUPS + group[:, 0]
    largest, second = (two.to(some.error.dtype) / (some.scale * others.scale)).unbind(1)
    return Nearest(target, largest, second, _error(some, others))


def _error(some: RoughDescriptors, others: RoughDescriptors) -> Float[Tensor, " n"]:
    """Of products: e1 v + (u - e1) e2 for errors e1 and e2 of unit vectors u and v; in many dimensions by far less than
    the lengths of these allow."""
    one, other = some.error, others.error.amax()
    most = one + other * (1.0 + one)
    likely = DEVIATIONS * torch.hypot(one, other) / math.sqrt(some.values.shape[1])
    return torch.minimum(most, likely) + some.kind.rounding


def _multiply(rows: Shaped[Tensor, "n d"], columns: Shaped[Tensor, "d m"], out: Shaped[Tensor, "n m"]) -> None:
    if rows.dtype == torch.int8:
        torch.ops.aten._int_mm.out(rows, columns, out=out)
    else:
        torch.mm(rows, columns, out=out)


def _fastest(device: torch.device) -> Kind:
    if device.type != "cpu":
        return HALF
    return BYTES if torch.cpu._is_vnni_supported() else SINGLE
