"""Instant IC: teleoperation that passes between a real robot and an instantly built virtual one."""
