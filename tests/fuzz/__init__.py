"""Mutated bytes for every parser of what comes from outside (``make fuzz``)."""
