"""Scenes in the format of pbrt-v2."""
