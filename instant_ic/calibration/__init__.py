"""Calibration of the mount between camera and LiDAR, from a recording."""
