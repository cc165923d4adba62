"""Meshes, scenes, images and cameras from and to files."""
