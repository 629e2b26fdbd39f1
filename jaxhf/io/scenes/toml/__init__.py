"""Scenes, and cases for a fit, in TOML."""
