"""Conversion between messages and the plain values of the algorithms, one module per part of the stack."""
