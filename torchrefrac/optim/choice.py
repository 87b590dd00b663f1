"""By which method the reduced system is solved."""

from typing import Literal, NamedTuple

from torchrefrac.optim.banded import BandedFactor
from torchrefrac.optim.dense import DenseFactor
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.factor import Factor
from torchrefrac.optim.normal_equations import NormalEquations
from torchrefrac.optim.ordering import BandedOrder

ReducedSolver = Literal["auto", "dense", "banded", "iterative"]
SMALL, MAX_DENSE = 1440, 7200
"""Unknowns up to which a dense matrix costs next to nothing, and up to which it is affordable."""
MAX_FLOPS, MAX_NUMBERS = 2e12, 5e8
"""Of a banded factorisation that is affordable: about two minutes of a core, and 4 GB."""


class Method(NamedTuple):
    """The method, never "auto", and of the banded one the order of the unknowns."""

    name: ReducedSolver
    order: BandedOrder | None = None

    def factor(self, elimination: Elimination) -> Factor:
        """By one of the direct methods."""
        return DenseFactor.of(elimination) if self.order is None else BandedFactor.of(elimination, self.order)


def choose(system: NormalEquations, solver: ReducedSolver = "auto", max_dense: int | None = None) -> Method:
    """What is named, or the cheapest that fits: dense up to SMALL unknowns; beyond, the banded one where it needs less
    than half the operations of the dense one, which is left out beyond max_dense (MAX_DENSE) unknowns; the iterative
    one where neither is affordable. On a GPU, which would wait for the order, dense or iterative by their number."""
    max_dense = MAX_DENSE if max_dense is None else max_dense
    if solver not in ("auto", "banded"):
        return Method(solver)
    size = system.plan.size
    if solver == "auto" and (size <= SMALL or system.rows.device.type != "cpu"):
        return Method("dense" if size <= max_dense else "iterative")
    order = BandedOrder.of(system)
    affordable = order.flops <= MAX_FLOPS and order.elements <= MAX_NUMBERS
    if solver == "banded" or (affordable and (size > max_dense or 2.0 * order.flops < size**3 / 3)):
        return Method("banded", order)
    return Method("dense" if size <= max_dense else "iterative")
