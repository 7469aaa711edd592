"""Poses, the transform buffer and the projections of panorama, cube and perspective pictures (numpy only)."""
