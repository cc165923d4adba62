"""The error of image and gradient in extreme cases."""

NAME = "stability"  # of the files that are written
