"""The parts of the kernel that only tests call."""

from edgegrad.library import load

parts = load("_core_tests")
