"""What the optics and the sensor make of the light: blur, noise, whole grey values."""

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from torchrefrac.synthetic.options import SensorOptions
from torchrefrac.synthetic.seeds import seeded


def develop(
    light: Float32[Tensor, "height width 3"], options: SensorOptions, seed: int, image: int
) -> UInt8[np.ndarray, "height width 3"]:
    """The photograph, RGB, of colours from 0 to 255.

    A Gaussian spot of the optics, Gaussian noise of each grey value, rounded. The noise depends on the seed and the
    number of the image alone, so that images may be made in any order.
    """
    if options.blur > 0.0:
        size = 2 * max(1, round(4.0 * options.blur)) + 1
        blurred = cv2.GaussianBlur(light.numpy(), (size, size), options.blur, borderType=cv2.BORDER_REFLECT_101)
        light = torch.from_numpy(blurred)
    if options.noise > 0.0:
        generator = seeded(seed, "noise", image)
        light = light + options.noise * torch.randn(light.shape, generator=generator)
    return light.round().clamp(0.0, 255.0).to(torch.uint8).numpy()
