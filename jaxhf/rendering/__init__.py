"""From a scene to a picture: how it is cut into tiles, and what is traced for each."""
