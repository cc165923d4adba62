"""Rigs: functions from few numbers to meshes that bend."""
