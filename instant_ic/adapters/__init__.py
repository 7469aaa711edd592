"""Conversion of messages to the plain values of the algorithms and back, one module a part."""
