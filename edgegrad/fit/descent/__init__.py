"""Fits by gradient descent: any tensors of a scene, shapes, textures."""
