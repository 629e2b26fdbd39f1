"""Pictures and films: files to arrays, rows from the top, and back."""
