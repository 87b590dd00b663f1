"""How the steps of a reconstruction end: enums whose values are sentences, filled with what was counted."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from torchrefrac.bundle import BundleReport
from torchrefrac.scene import Survey


class Start(Enum):
    """Of the first pair of views."""

    DONE = "{points} points are placed from the first two views"
    NO_POSE = "the matches of the pair do not determine its pose"
    FEW_POINTS = "only {points} points can be placed from the pair, of which a start needs {needed}"


class Registration(Enum):
    """Of one more view."""

    DONE = "{agreeing} of the {seen} reconstructed points that it sees agree with its pose"
    FEW_POINTS = "sees only {seen} reconstructed points, of which a pose needs {needed}"
    NO_POSE = "no pose agrees with more than {agreeing} of the {seen} reconstructed points that it sees"


class Joining(Enum):
    """Of two reconstructions of different views."""

    DONE = "{views} images join by {common} images, {points} points and {positions} stated positions known in both"
    NOTHING = "nothing joins it with the others"
    DISAGREEING = (
        "{common} images and {points} points are known in it and in the others, but no more than {agreeing} agree on "
        "how these lie to each other"
    )
    SCALE_OPEN = (
        "{common} image sees points of it and of the others, which leaves open how large these are to each other"
    )
    UNDETERMINED = (
        "{positions} stated positions of it, or those of the others, are too few or too close together to say where it "
        "is: state two in each that are apart"
    )
    OTHER_LEVEL = (
        "by {positions} stated positions of it the water stands {apart:.3g} higher or lower than for the others, under "
        "cameras {height:.3g} above it"
    )


class Triangulation(Enum):
    """Of points that had no position."""

    DONE = "{points} points are placed"
    NOTHING = "no point is seen by two registered views"


class Filtering(Enum):
    """Of observations, points and views."""

    DONE = "{points} points stay"
    LOST_VIEWS = "{points} points stay, but some views are left with next to none"


class Adjustment(Enum):
    """Of everything together (see `optim.minimize`)."""

    CONVERGED = "the adjustment converged"
    STOPPED = "the adjustment stopped before it converged"


@dataclass(frozen=True)
class Outcome:
    """How a step ended, and with what.

    kind: how it ended, its numbers the ones in its sentence. views: those that were lost. report: of an
    adjustment. survey: what of a survey was used.
    """

    kind: Enum
    numbers: Mapping[str, float] = field(default_factory=dict)
    views: tuple[int, ...] = ()
    report: BundleReport | None = None
    survey: Survey | None = None

    def __str__(self) -> str:
        return str(self.kind.value).format(**self.numbers)

    @property
    def done(self) -> bool:
        """Whether the step did what it is for."""
        return self.kind.name in ("DONE", "CONVERGED")
