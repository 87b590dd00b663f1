"""Random numbers of their own for every image and purpose, whatever else has been drawn before."""

import hashlib

import torch


def seeded(seed: int, *purpose: str | int) -> torch.Generator:
    """A generator that depends on nothing but the seed and what it is for."""
    words = "/".join(str(word) for word in (seed, *purpose))
    number = int.from_bytes(hashlib.sha256(words.encode("utf-8")).digest()[:8], "little")
    return torch.Generator().manual_seed(number & (2**63 - 1))
