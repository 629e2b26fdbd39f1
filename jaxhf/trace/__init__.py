"""From a ray to a hit: which triangle does it meet, and what stands there. Derivatives begin at the hit."""
