"""What is known of a scene before a ray flies: its place, its surfaces made ready, the bounds of its shadows, its skies."""
