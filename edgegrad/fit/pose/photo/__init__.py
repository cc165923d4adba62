"""Poses in photographs: what is compared where neither the light nor the background is known, and no mask is given."""
