"""The base of all errors of the package: a leaf that imports nothing."""


class TorchrefracError(Exception):
    """What every named error of the package is, beside what Python would call it."""
