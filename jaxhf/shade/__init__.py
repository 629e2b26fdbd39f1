"""From a hit to the radiance along the ray."""
