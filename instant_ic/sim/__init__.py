"""Simulated worlds, rendering, robot dynamics, and devices with the real wire protocols."""
