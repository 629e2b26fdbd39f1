"""The picture of a terrain from straight above: its size, and what it spans."""

import math


def picture_above(
    shape: tuple[int, ...], dx: float, dy: float, width: int | None, height: int | None
) -> tuple[int, int, float]:
    """Width and height in pixels, and what the shorter side spans, so that all of a grid is seen in square pixels.

    Args:
      shape: of the heights, (ny, nx).
      dx, dy: between them.
      width, height: pixels; at most one is None, see `from_above`.
    """
    across, up = (shape[1] - 1) * dx, (shape[0] - 1) * dy
    if width is None:
        assert height is not None
        width = _pixels(height * across / up)
    if height is None:
        height = _pixels(width * up / across)
    return width, height, max(across / width, up / height) * min(width, height)


def _pixels(exact: float) -> int:
    return math.ceil(exact - 1e-9)  # of a product that is whole but for rounding
