"""The only door to the compiled kernel: flat arrays of a scene, requests, operators of torch and their derivatives."""
