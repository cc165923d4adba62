"""The error of image and gradient in extreme cases."""
