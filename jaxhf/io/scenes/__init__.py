"""Scene files of either format, and cases for a fit."""
