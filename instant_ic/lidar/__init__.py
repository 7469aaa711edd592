"""Velodyne VLP-16: packets, captures, decoding, scans."""
