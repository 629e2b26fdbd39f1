"""What each setting costs and gains, measured."""
