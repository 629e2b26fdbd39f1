"""From a start to the heights that explain the pictures."""
