"""What can go wrong with a bag."""


class BagError(RuntimeError):
    """A bag that cannot be written or read; the message says why and what to do."""


class DiskFullError(BagError):
    """No space left: the bag is complete without what did not fit."""
