"""Clouds of points that were made as if there were no water, corrected point by point."""

from torchrefrac.correction.forecast import Forecast, forecast_errors
from torchrefrac.correction.points import Correction, correct_points
from torchrefrac.correction.rules import CorrectionRules
from torchrefrac.correction.totals import Totals

__all__ = ["Correction", "CorrectionRules", "Forecast", "Totals", "correct_points", "forecast_errors"]
