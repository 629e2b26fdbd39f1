"""Terrain: heights with their place on the Earth, from files of many formats and back, and as meshes."""
