"""Plane sweeps: where a surface may lie, from all distances along the reference's rays."""
