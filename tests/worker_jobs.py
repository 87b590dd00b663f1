"""What workers of tests are asked to do: in a module that their processes can import."""

import os
import time
from pathlib import Path

import numpy as np


def squared(number):
    return number * number


def process_of(number):
    return os.getpid()


def refuse(number):
    raise ValueError(f"number {number}")


def squared_unless_first(folder, number):
    """The process that meets number 3 first is killed by it."""
    first = Path(folder) / "killed"
    if number == 3 and not first.exists():
        first.touch()
        os.kill(os.getpid(), 9)
    return number * number


def killed(number):
    os.kill(os.getpid(), 9)


def waits(seconds):
    time.sleep(seconds)


def row_of(number):
    return {"values": np.arange(float(number)), "large": np.full((number, 2), number, dtype=np.uint8)}
