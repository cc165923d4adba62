"""Points of surfaces and of the curves at which the image jumps, for what is written in PyTorch."""
