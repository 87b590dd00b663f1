"""Errors against truth, and the figures that a run states about itself."""
