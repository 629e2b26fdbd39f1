"""From pictures back to heights."""
