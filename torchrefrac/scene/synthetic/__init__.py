"""Scenes that are made rather than photographed: surfaces, cameras over water, and the photographs they would take."""
