"""How programs stay small and fast: what is done to JAX and XLA, and what the machine has."""
