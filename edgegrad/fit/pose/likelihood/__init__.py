"""How likely pictures are at a pose: the terms of the objective, for N poses at once."""
