"""Simulated worlds, rendering, robot dynamics, and devices that speak the real wire protocols."""
