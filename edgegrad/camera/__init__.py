"""Projection of points into the image: cameras, their lenses, and the conventions of other libraries."""
