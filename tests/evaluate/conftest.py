"""Surveys with known cameras, for what is said about a finished scene."""

from tests.sfm.conftest import survey_of  # noqa: F401 - a fixture
