"""Tracked base: RoboClaw packet serial, skid-steer odometry, limits."""
