"""What goes in and what comes out: captures, tracks, reconstructions, and the files they live in."""

from torchrefrac.scene.alignment import Alignment, AlignmentError
from torchrefrac.scene.capture import Capture, CaptureError
from torchrefrac.scene.capture_file import load_capture
from torchrefrac.scene.colmap_model import read_colmap, write_colmap
from torchrefrac.scene.dense import DenseCloud, DepthMap
from torchrefrac.scene.dense_file import load_dense, load_depth_map, write_dense, write_depth_map
from torchrefrac.scene.mesh import height_field_mesh, write_mesh
from torchrefrac.scene.ply import DenseFileError
from torchrefrac.scene.raster import Raster, rasterize
from torchrefrac.scene.raster_file import load_raster, write_geotiff, write_raster
from torchrefrac.scene.reconstruction import Assessment, Reconstruction
from torchrefrac.scene.reconstruction_file import load_cameras, load_points, write_cameras, write_points
from torchrefrac.scene.survey import Survey, SurveyError
from torchrefrac.scene.survey_file import read_survey
from torchrefrac.scene.tracks import Tracks
from torchrefrac.scene.tracks_file import read_alignment, read_run, write_tracks
from torchrefrac.scene.truth import Truth, load_truth
from torchrefrac.scene.truth_points import TruthPoints, load_truth_points
from torchrefrac.scene.water_file import Water, read_water, write_water

__all__ = [
    "Alignment",
    "AlignmentError",
    "Assessment",
    "Capture",
    "CaptureError",
    "DenseCloud",
    "DenseFileError",
    "DepthMap",
    "Raster",
    "Reconstruction",
    "Survey",
    "SurveyError",
    "Tracks",
    "Truth",
    "TruthPoints",
    "Water",
    "height_field_mesh",
    "load_cameras",
    "load_capture",
    "load_dense",
    "load_depth_map",
    "load_points",
    "load_raster",
    "load_truth",
    "load_truth_points",
    "rasterize",
    "read_alignment",
    "read_colmap",
    "read_run",
    "read_survey",
    "read_water",
    "write_cameras",
    "write_colmap",
    "write_dense",
    "write_depth_map",
    "write_geotiff",
    "write_mesh",
    "write_points",
    "write_raster",
    "write_tracks",
    "write_water",
]
