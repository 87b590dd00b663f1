"""Reconstruction of scenes under water from photographs taken in air, with refraction at every stage."""
