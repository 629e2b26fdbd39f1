"""Files: scenes, terrain and images. Everything here runs on the host; nothing is traced."""

import numpy as np
from numpy.typing import DTypeLike

from .._scene import Scene
from ._files import (
    PathLike,
    by_ending,
    require_file,
    require_precision,
    require_writable_text as require_writable_text,
    save_text as save_text,
)
from ._images import load_image as load_image, require_writable as require_writable, save_image as save_image
from ._pbrt import load_pbrt
from ._save_heights import require_writable_heights as require_writable_heights, save_heights as save_heights
from ._source import SceneError as SceneError
from ._terrain import Terrain as Terrain, jacksboro as jacksboro, load_heights as load_heights
from ._toml import load_toml
from ._toml_fit import Case as Case, load_case as load_case

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
