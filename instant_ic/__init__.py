"""Instant IC: teleoperation that switches between a real robot and an instantly built virtual one."""

from instant_ic.util.limits import limit_opencv

limit_opencv()
