"""The error of the gradient against the time it takes, beside other renderers."""
