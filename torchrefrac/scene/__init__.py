"""The data model: what goes in, what is known about it, and what comes out; no file format, no algorithm."""

from torchrefrac.scene.capture import Capture, CaptureError
from torchrefrac.scene.dense import DenseCloud, DepthMap
from torchrefrac.scene.extent import WaterExtent
from torchrefrac.scene.findings import Finding, WarningCode
from torchrefrac.scene.georeference import Georeference
from torchrefrac.scene.interfaces import Interfaces
from torchrefrac.scene.raster import Raster, RasterGrid
from torchrefrac.scene.scene import (
    Assessment,
    Part,
    Scene,
    SceneError,
    largest_deviation,
    mean_deviation,
    reprojection_errors,
)
from torchrefrac.scene.survey import Survey, Surveyed, SurveyError, with_measured
from torchrefrac.scene.tables import Cameras, Observations, Views
from torchrefrac.scene.truth import Truth, TruthPoints
from torchrefrac.scene.viewpoints import Viewpoints, field_of_view
from torchrefrac.scene.water_heights import GridWater, LevelWater, MeshWater, WaterHeights

__all__ = [
    "Assessment", "Cameras", "Capture", "CaptureError", "DenseCloud", "DepthMap", "Finding", "Georeference",
    "GridWater", "Interfaces", "LevelWater", "MeshWater", "Observations", "Part", "Raster", "RasterGrid", "Scene",
    "SceneError", "Survey", "SurveyError", "Surveyed", "Truth", "TruthPoints", "Viewpoints", "Views", "WarningCode",
    "WaterExtent", "WaterHeights", "field_of_view", "largest_deviation", "mean_deviation", "reprojection_errors",
    "with_measured",
]  # fmt: skip
