"""Metrics and experiments."""
