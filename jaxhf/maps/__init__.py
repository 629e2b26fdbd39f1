"""Maps of terrain: shades, slopes, tints and shadows on arrays, in NumPy."""
