"""How a ray ended."""

import enum


class Status(enum.IntEnum):
    """How a ray ended."""

    MISS = 0
    HIT = 1
    EXHAUSTED = 2  # its budget of steps ran out
    INVALID = 3  # its origin or direction was not finite, or its direction zero
