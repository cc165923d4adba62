"""Where a point lands in the image: cameras, their lenses, and how other libraries describe them."""
