"""Errors of the bag package."""


class BagError(RuntimeError):
    """A bag cannot be written or read; the message says why and what to do."""


class DiskFullError(BagError):
    """No space left on the disk. The bag is complete except for the messages that did not fit."""
