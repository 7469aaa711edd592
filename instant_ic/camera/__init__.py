"""Equirectangular cameras: Theta Z1 live preview, video devices and streams, image files."""
