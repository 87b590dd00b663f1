"""Photographs that look alike as a whole: vectors of locally aggregated descriptors (VLAD; Jégou et al., CVPR 2010),
normalised as Arandjelović & Zisserman (CVPR 2013), by words that are learnt from these photographs."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchrefrac.numerics import segment_sum

WORDS = 128
SAMPLE = 32_768
"""Descriptors of all photographs together that words are learnt from."""
ROUNDS = 12
MANY = 128
"""Photographs, from which on their common variation is known well enough to be taken out; KEPT: times fewer
directions, those of most variance, are left then."""
KEPT = 2


def likeness(descriptors: Sequence[Float[Tensor, "_ d"]], seed: int = 0) -> Float[Tensor, "m m"]:
    """Cosines between what is aggregated of the descriptors of each photograph: the higher the more alike.

    A photograph without descriptors is like no other. Deterministic for a seed.
    """
    if not any(map(len, descriptors)):
        return torch.zeros(len(descriptors), len(descriptors))
    words = learn_words(descriptors, seed)
    vectors = torch.stack([aggregated(of_image, words) for of_image in descriptors])
    vectors = whitened(vectors) if len(vectors) >= MANY else vectors
    return vectors @ vectors.T


def learn_words(descriptors: Sequence[Float[Tensor, "_ d"]], seed: int) -> Float[Tensor, "words d"]:
    """Centres of clusters, by k-means on a sample of all descriptors; fewer than WORDS where there are as few."""
    generator = torch.Generator().manual_seed(seed)
    share = max(SAMPLE // len(descriptors), 1)
    some = torch.cat([of_image[torch.randperm(len(of_image), generator=generator)[:share]] for of_image in descriptors])
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


def whitened(vectors: Float[Tensor, "m size"]) -> Float[Tensor, "m kept"]:
    """Along the principal axes of these vectors, each of variance one, and of length one again; those of the least
    variance are left out."""
    about = vectors - vectors.mean(dim=0)
    variance, axes = torch.linalg.eigh((about @ about.T).double())
    kept = len(vectors) // KEPT
    return normalize(axes[:, -kept:] * (variance[-kept:] > 0.0), dim=1).to(vectors.dtype)
