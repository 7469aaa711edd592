"""Equirectangular cameras: Theta Z1 live preview, video devices and streams, picture files."""
