"""Optimisers: damped Gauss-Newton and Adam. They know no images, cameras or meshes."""
