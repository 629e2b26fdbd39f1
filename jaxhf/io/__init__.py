"""Files: scenes, terrain and images. Everything here runs on the host; nothing is traced."""

import numpy as np
from numpy.typing import DTypeLike

from .._scene import Scene
from ._images import (
    PathLike,
    load_image as load_image,
    require_file,
    require_writable as require_writable,
    save_image as save_image,
)
from ._pbrt import load_pbrt
from ._source import SceneError as SceneError, nearest
from ._terrain import Terrain as Terrain, jacksboro as jacksboro, load_heights as load_heights
from ._toml import load_toml

_READERS = {".toml": load_toml, ".pbrt": load_pbrt}


def load_scene(path: PathLike, dtype: DTypeLike = np.float32) -> Scene:
    """Reads a scene file, .toml or .pbrt.

    Args:
      path: the file; those that it names lie in its folder or below.
      dtype: of the heights, and thereby the precision of the picture; float64 needs JAX's x64 mode.

    Raises:
      FileNotFoundError: `path` is not there.
      ValueError: its ending is another.
      SceneError: something is wrong in the file; the message gives its line.
    """
    path = require_file(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: cannot read a scene from the ending {path.suffix!r}; {nearest(path.suffix, _READERS)}")
    return reader(path, dtype)
