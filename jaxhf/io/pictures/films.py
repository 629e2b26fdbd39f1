"""Films: .gif and .mp4."""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import imageio.v3 as imageio
import numpy as np
from jaxtyping import UInt8

from ..files import PathLike, replacing, require_writable

Add = Callable[[UInt8[np.ndarray, "h w 3"]], None]

FILMS = (".gif", ".mp4")
_RATE = 24
require_writable_film = partial(require_writable, "writing_film", "a film", FILMS)


@contextlib.contextmanager
def writing_film(path: PathLike) -> Iterator[Add]:
    """Yields a function that takes one sRGB picture of one size after the other, 24 a second.

    A .gif repeats for ever; an .mp4 (H.264) leaves out a last column or row where their number is odd.
    """
    path = require_writable_film(path)
    ending = path.suffix.lower()
    with replacing(path) as temporary, temporary.open("wb") as file:
        if ending == ".gif":
            frames: list[Any] = []
            yield frames.append
            # By name, not by the file's own ending, which is that of a temporary one.
            imageio.imwrite(file, frames, plugin="pillow", extension=".gif", duration=1000 / _RATE, loop=0)
            return
        with imageio.imopen(file, "w", plugin="pyav", extension=".mp4", container="mp4") as film:
            film.init_video_stream("libx264", fps=_RATE)

            def add(frame: np.ndarray) -> None:
                film.write_frame(frame[: len(frame) // 2 * 2, : frame.shape[1] // 2 * 2])

            yield add
