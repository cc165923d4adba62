"""Where a known mesh, or a camera, stands: fits by Gauss-Newton on an image pyramid."""
