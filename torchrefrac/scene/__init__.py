"""What goes in and what comes out: captures, tracks, reconstructions, and the files they live in."""

from torchrefrac.scene.capture import Capture, CaptureError
from torchrefrac.scene.capture_file import load_capture
from torchrefrac.scene.reconstruction import Reconstruction
from torchrefrac.scene.reconstruction_file import load_cameras, load_points, write_cameras, write_points
from torchrefrac.scene.tracks import Tracks
from torchrefrac.scene.truth import Truth, load_truth

__all__ = [
    "Capture",
    "CaptureError",
    "Reconstruction",
    "Tracks",
    "Truth",
    "load_cameras",
    "load_capture",
    "load_points",
    "load_truth",
    "write_cameras",
    "write_points",
]
