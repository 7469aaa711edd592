"""Bridges to other machines and other systems."""
