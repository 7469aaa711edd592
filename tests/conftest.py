"""For all tests: no time limit for one example of a property, since the machine may be busy."""

from hypothesis import settings

settings.register_profile("stack", deadline=None)
settings.load_profile("stack")
