"""How well trackers follow objects in films with known poses: `python -m benchmarks.track`, and --help."""
