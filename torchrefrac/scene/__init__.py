"""What goes in and what comes out: captures, tracks, reconstructions, and the files they live in."""

from torchrefrac.scene.alignment import Alignment, AlignmentError
from torchrefrac.scene.capture import Capture, CaptureError
from torchrefrac.scene.capture_file import load_capture
from torchrefrac.scene.colmap_model import read_colmap, write_colmap
from torchrefrac.scene.dense import DenseCloud, DepthMap
from torchrefrac.scene.reconstruction import Assessment, Reconstruction
from torchrefrac.scene.reconstruction_file import load_cameras, load_points, write_cameras, write_points
from torchrefrac.scene.survey import Survey, SurveyError
from torchrefrac.scene.survey_file import read_survey
from torchrefrac.scene.tracks import Tracks
from torchrefrac.scene.tracks_file import read_alignment, write_tracks
from torchrefrac.scene.truth import Truth, load_truth
from torchrefrac.scene.water_file import Water, read_water, write_water

__all__ = [
    "Alignment",
    "AlignmentError",
    "Assessment",
    "Capture",
    "CaptureError",
    "DenseCloud",
    "DepthMap",
    "Reconstruction",
    "Survey",
    "SurveyError",
    "Tracks",
    "Truth",
    "Water",
    "load_cameras",
    "load_capture",
    "load_points",
    "load_truth",
    "read_alignment",
    "read_colmap",
    "read_survey",
    "read_water",
    "write_cameras",
    "write_colmap",
    "write_points",
    "write_tracks",
    "write_water",
]
