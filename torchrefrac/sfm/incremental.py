"""The incremental order of the verbs (paper, section 3), once for all photographs that hang together."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from torchrefrac.features import Features
from torchrefrac.numerics import components
from torchrefrac.recorder import Recorder
from torchrefrac.scene import Capture, Scene, Survey
from torchrefrac.sfm.growth import Given, Growth, NoInitialPairError
from torchrefrac.sfm.join import join
from torchrefrac.sfm.outcome import Joining, Outcome
from torchrefrac.sfm.pose import PoseInitializer
from torchrefrac.sfm.rules import SfmOptions
from torchrefrac.sfm.verification import VerifiedPair

FEWEST_VIEWS = 3
"""Of a further reconstruction."""


def reconstruct_sparse(
    scene: Scene,
    capture: Capture,
    pairs: Sequence[VerifiedPair],
    initializer: PoseInitializer,
    options: SfmOptions,
    generator: torch.Generator,
    recorder: Recorder,
    water: float = 1.0,
    features: Sequence[Features] = (),
    survey: Survey | None = None,
) -> Scene:
    """Views and points from verified pairs and the tracks of `scene`, in which nothing has a place yet.

    Where the capture or the `survey` states positions the scene is adjusted with these and stands in their frame, but
    with the water at z = 0; what else the survey has besides gravity, which is that of the capture, takes part too.
    water: index ratio of that which may be beside the land, by which a scene without refraction is reconstructed
    at first. features: of each image, in which tracks are completed once poses are known; by default they stay as they
    are.

    Views that cannot be registered, but agree among each other, FEWEST_VIEWS or more, are reconstructed from the pairs
    among them. What anything ties to another reconstruction joins it (see `join`), and is adjusted with it as one; what
    nothing ties is in `further`, and the one with most views is the scene. Views that are not registered in it are
    listed in `failures` with the reason. Raises NoInitialPairError when there is nothing to start from.
    """
    stated = (survey or Survey.empty(capture.names)).beside(capture)
    seed = int(torch.randint(1 << 31, (), generator=generator))
    given = Given(capture, options, initializer, seed, recorder, water, features, stated)
    finished = [replace(one, scene=one.growth.finished(one.scene)) for one in _grown(scene, pairs, given)]
    first, *others = sorted(finished, key=_Grown.size, reverse=True)
    return _beside(first, others) if others else first.scene


@dataclass(frozen=True)
class _Grown:
    """A reconstruction that is not finished, and why the last other one that was tried did not join it."""

    growth: Growth
    scene: Scene
    apart: Outcome = field(default_factory=lambda: Outcome(Joining.NOTHING))

    @property
    def views(self) -> Bool[Tensor, " m"]:
        """Those that it has."""
        return self.scene.views.registered

    def size(self) -> int:
        """How many these are."""
        return self.scene.views.num_registered


def _grown(scene: Scene, pairs: Sequence[VerifiedPair], given: Given) -> list[_Grown]:
    """All reconstructions that the pairs carry, of which nothing ties any two."""
    among = torch.ones_like(scene.views.registered)
    growth = Growth(given)
    every = [_Grown(growth, growth.grow(scene, pairs, among))]
    among = ~every[0].views
    while left := _pairs_of_groups(pairs, among):
        growth = Growth(given)
        try:
            new = _Grown(growth, growth.grow(scene, left, among))
        except NoInitialPairError:
            break
        if new.size() >= FEWEST_VIEWS:
            every = _with(every, new, given)
        among = among & ~new.views & ~_any(scene, every)
    return every


def _pairs_of_groups(pairs: Sequence[VerifiedPair], among: Bool[Tensor, " m"]) -> list[VerifiedPair]:
    """Those of two views `among`, in groups of FEWEST_VIEWS or more that such pairs join."""
    left = [one for one in pairs if among[one.pair.first] and among[one.pair.second]]
    if len(left) < FEWEST_VIEWS - 1:
        return []
    ends = torch.tensor([(one.pair.first, one.pair.second) for one in left])
    group = components(ends[:, 0], ends[:, 1], len(among))
    large = (torch.bincount(group)[group] >= FEWEST_VIEWS).tolist()
    return [one for one in left if large[one.pair.first]]


def _with(every: list[_Grown], new: _Grown, given: Given) -> list[_Grown]:
    """With one more, joined with all that anything ties it to: the smaller one comes into the frame of the larger one,
    which then takes in what it can of the views that none has."""
    for i, other in enumerate(every):
        first, second = sorted((other, new), key=_Grown.size, reverse=True)
        scene, outcome = join(first.scene, second.scene, first.growth.rules, given.capture, given.survey)
        given.recorder.detail(f"a reconstruction of {second.size()} images beside one of {first.size()}: {outcome}")
        rest = every[:i] + every[i + 1 :]
        if outcome.done:
            joined = first.growth.take_in(scene, ~_any(scene, rest))
            return _with(rest, replace(first, scene=joined), given)
        every, new = [*every[:i], replace(other, apart=outcome), *every[i + 1 :]], replace(new, apart=outcome)
    return [*every, new]


def _any(scene: Scene, every: Sequence[_Grown]) -> Bool[Tensor, " m"]:
    """The views that any of some reconstructions of the scene's views have."""
    views = torch.zeros_like(scene.views.registered)
    for one in every:
        views = views | one.views
    return views


def _beside(first: _Grown, others: Sequence[_Grown]) -> Scene:
    """The scene of the first, with those of others that are large enough, and why views are not in it."""
    names, reasons, further = first.scene.views.names, dict[str, str](), list[Scene]()
    for one in (*others, first):
        reasons |= one.scene.failures
    for one in others:
        where = str(one.apart)
        if one.size() >= FEWEST_VIEWS:
            further.append(replace(one.scene, failures={}))
            where = f"is in a reconstruction of its own, the {len(further) + 1}.: {where}"
        reasons |= {names[view]: where for view in one.views.nonzero()[:, 0].tolist()}
    missing = {names[view] for view in (~first.views).nonzero()[:, 0].tolist()}
    reasons = {name: why for name, why in reasons.items() if name in missing}
    return replace(first.scene, failures=reasons, further=tuple(further))
