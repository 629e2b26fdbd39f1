"""What the result of a fit is worth."""
