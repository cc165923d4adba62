"""Images that other means than the kernel make: exact pixel integrals, and many samples in plain PyTorch."""
