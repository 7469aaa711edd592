"""Poses, transform buffer, and projections of panoramas, cube faces and perspective images (numpy only)."""
