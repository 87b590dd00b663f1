"""COLMAP models, as text and as binary."""
