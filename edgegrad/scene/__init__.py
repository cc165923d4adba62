"""Rendered scenes: meshes and their materials, lights, backgrounds. This package knows neither cameras, nor files, nor the
kernel."""
