"""Kernels are compiled when they are first called, which is no reason for a property test to fail."""

from hypothesis import settings

settings.register_profile("compiling", deadline=None)
settings.load_profile("compiling")
