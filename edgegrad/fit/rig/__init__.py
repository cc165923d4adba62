"""Poses and shapes of what bends."""
