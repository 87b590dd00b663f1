"""Photographs that look alike: first as a whole, by vectors of locally aggregated descriptors (VLAD; Jégou et al., CVPR
2010; normalised as Arandjelović & Zisserman, CVPR 2013) with words that are learnt from these photographs; those that
are the most alike so by their first keypoints, which are matched (as Wu, 3DV 2013)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchrefrac.features.pairs import best_partners, pairs_of
from torchrefrac.features.sift import Features
from torchrefrac.numerics import segment_sum

WORDS = 256
SAMPLE = 65_536
"""Descriptors of all photographs together that words are learnt from."""
ROUNDS = 12
FIRST = 256
"""Keypoints of a photograph that are matched first: the strongest, or the largest, which others show most often, too.
That takes 0.4 ms a pair, and all of 8192 keypoints 250."""
TRIED = 100  # partners of each photograph whose first keypoints are matched
BATCH = 64  # pairs at a time
COSINE = 1e-3
"""Of the whole photographs, times which it counts beside the share of first keypoints that match."""


def likeness(features: Sequence[Features], ratio: float, seed: int = 0) -> Float[Tensor, "m m"]:
    """How much alike photographs are: the share of their first keypoints that match, of those that are the most alike
    as a whole, and a little for how alike these are. From -COSINE to 1 + COSINE.

    ratio: see `MatchOptions`. A photograph without descriptors is like no other. Deterministic for a seed.
    """
    if not any(map(len, features)):
        return torch.zeros(len(features), len(features))
    words = learn_words(features, seed)
    vectors = torch.stack([aggregated(of_image.unit(), words) for of_image in features])
    cosine = vectors @ vectors.T
    first, second = pairs_of(best_partners(cosine, TRIED)).T
    share = share_of_first(features, first, second, ratio)
    alike = COSINE * cosine
    return alike.index_put((first, second), share, accumulate=True).index_put((second, first), share, accumulate=True)


def share_of_first(
    features: Sequence[Features], first: Int[Tensor, " p"], second: Int[Tensor, " p"], ratio: float
) -> Float[Tensor, " p"]:
    """Of pairs of photographs, the share of FIRST keypoints of the first that match some of the second."""
    chosen = [of_image.unit(slice(FIRST)) for of_image in features]
    most = max(2, *map(len, chosen))
    some = torch.stack([pad(of_image, (0, 0, 0, most - len(of_image))) for of_image in chosen])
    batches = zip(first.split(BATCH), second.split(BATCH), strict=True)
    return torch.cat([_matching(some[i] @ some[j].mT, ratio) for i, j in batches]) / FIRST


def _matching(similarity: Float[Tensor, "p n n"], ratio: float) -> Float[Tensor, " p"]:
    """How many rows have a match (see `match`) in each pair."""
    two, nearest = similarity.topk(2, dim=-1)
    squared = (2.0 - 2.0 * two).clamp(min=0.0)
    distinct = squared[..., 0] < ratio**2 * squared[..., 1]
    mutual = two[..., 0] >= similarity.amax(dim=-2).gather(-1, nearest[..., 0])
    return (distinct & mutual).to(similarity).sum(dim=-1)


def learn_words(features: Sequence[Features], seed: int) -> Float[Tensor, "words d"]:
    """Centres of clusters, by k-means on a sample of all descriptors; fewer than WORDS where there are as few."""
    generator = torch.Generator().manual_seed(seed)
    share = max(SAMPLE // len(features), 1)
    chosen = [torch.randperm(len(of_image), generator=generator)[:share] for of_image in features]
    some = torch.cat([of_image.unit(rows) for of_image, rows in zip(features, chosen, strict=True)])
    words = some[torch.randperm(len(some), generator=generator)[:WORDS]]
    for _ in range(ROUNDS):
        word = nearest_word(some, words)
        count = torch.bincount(word, minlength=len(words))
        mean = segment_sum(some, word, len(words)) / count.clamp(min=1)[:, None]
        words = torch.where(count[:, None] > 0, mean, words)
    return words


def nearest_word(descriptors: Float[Tensor, "k d"], words: Float[Tensor, "words d"]) -> Int[Tensor, " k"]:
    """By Euclidean distance."""
    return (descriptors @ words.T - 0.5 * words.square().sum(dim=1)).argmax(dim=1)


def aggregated(descriptors: Float[Tensor, "k d"], words: Float[Tensor, "words d"]) -> Float[Tensor, " size"]:
    """Sums of the differences from the nearest words, each of length one, and the roots of all, of length one; zero
    without descriptors."""
    word = nearest_word(descriptors, words)
    total = segment_sum(descriptors, word, len(words))
    total = total - torch.bincount(word, minlength=len(words))[:, None] * words
    vector = normalize(total, dim=1).flatten()
    return normalize(vector.sign() * vector.abs().sqrt(), dim=0)
