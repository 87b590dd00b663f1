"""Surveys of a basin."""

from tests.sfm.conftest import survey_of  # noqa: F401 - a fixture
