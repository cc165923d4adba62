"""How often pose fits find the pose, how exactly, and whether they know. __main__.py says how it is run."""
