"""The error of the gradient against the time it takes, next to other renderers."""
