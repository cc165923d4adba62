"""Readers and writers of mesh and camera files, one format a module."""
