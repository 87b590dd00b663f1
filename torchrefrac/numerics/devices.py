"""Where tensors are worked on."""

import torch

AUTO = "auto"


def device_of(name: str) -> torch.device:
    """The device that PyTorch has under a name (cpu, cuda, cuda:1); auto: a GPU with CUDA where there is one, else the
    CPU. Raises ValueError, of one sentence, for one that PyTorch cannot use here."""
    if name == AUTO:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:  # an assertion where PyTorch was built without CUDA
        reason = str(error).split("\n", maxsplit=1)[0]
        raise ValueError(f"device is {name!r}, which PyTorch cannot use here: {reason}") from None
