"""The data model: what goes in, what is known about it, and what comes out; no file format, no algorithm."""

from torchrefrac.scene.alignment import Alignment, AlignmentError
from torchrefrac.scene.capture import Capture, CaptureError
from torchrefrac.scene.dense import DenseCloud, DepthMap
from torchrefrac.scene.raster import Raster
from torchrefrac.scene.reconstruction import Assessment, Reconstruction
from torchrefrac.scene.survey import Survey, SurveyError
from torchrefrac.scene.tracks import Tracks
from torchrefrac.scene.truth import Truth, TruthPoints

__all__ = [
    "Alignment",
    "AlignmentError",
    "Assessment",
    "Capture",
    "CaptureError",
    "DenseCloud",
    "DepthMap",
    "Raster",
    "Reconstruction",
    "Survey",
    "SurveyError",
    "Tracks",
    "Truth",
    "TruthPoints",
]
