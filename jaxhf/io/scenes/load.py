"""Scene files of either format."""

import numpy as np
from numpy.typing import DTypeLike

from ...scene.scene import Scene
from ..files import PathLike, by_ending, require_file, require_precision
from .pbrt.reader import load_pbrt
from .toml.scene import load_toml

_READERS = {".toml": load_toml, ".pbrt": load_pbrt}


def load_scene(path: PathLike, dtype: DTypeLike = np.float32) -> Scene:
    """Reads a scene file, .toml or .pbrt.

    Args:
      path: the file; those that it names lie in its folder or below.
      dtype: of the heights, and thereby the precision of the picture: float32, or float64, which needs JAX's x64 mode.

    Raises:
      FileNotFoundError: `path` is not there.
      ValueError: its ending or `dtype` is another, or x64 mode is off for float64.
      SceneError: something is wrong in the file; the message gives its line.
    """
    dtype, path = require_precision(dtype), require_file(path)
    return by_ending(_READERS, path, "read a scene from")(path, dtype)
