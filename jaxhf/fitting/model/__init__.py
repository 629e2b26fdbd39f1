"""From unknown heights to pictures, and their derivatives."""
