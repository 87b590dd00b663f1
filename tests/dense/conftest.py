"""Surveys of a basin."""

from tests.dense.flights import flight  # noqa: F401 - a fixture
from tests.sfm.conftest import survey_of  # noqa: F401 - a fixture
