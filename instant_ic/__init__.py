"""Instant IC: teleoperation that passes between a real robot and an instantly built virtual one."""

from instant_ic.limits import limit_opencv

limit_opencv()
