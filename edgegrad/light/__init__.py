"""Radiance of surfaces by their materials and lights, in PyTorch and as the kernel is asked for it."""
