"""The live view of a fit: a page in a browser, or a figure in a notebook. No other part of the library depends on it."""
