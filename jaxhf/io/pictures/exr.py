"""OpenEXR files to channels and back."""

import contextlib
import errno
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...core.extras import import_extra
from ..errors import FileError
from ..files import require_pixels, utf8_name


def read_channels(path: Path) -> dict[str, np.ndarray]:
    """The channels of an .exr by their names, float32."""
    exr = import_extra("OpenEXR", "reading .exr needs", "exr")
    try:
        with utf8_name(path) as name:
            with exr.File(name, separate_channels=True, header_only=True) as file:
                (x0, y0), (x1, y1) = file.header()["dataWindow"]
            require_pixels(int(y1) - int(y0) + 1, int(x1) - int(x0) + 1)
            with exr.File(name, separate_channels=True) as file:
                return {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except RuntimeError as error:
        raise FileError("it is not an OpenEXR file, or damaged") from error
    except ValueError as error:
        if "part index" not in str(error):
            raise
        raise FileError("it is cut off or damaged: pixels are missing") from error


def read_exr(path: Path) -> np.ndarray:
    """The picture in an .exr: float32 of shape (h, w, 3), or (h, w) where it is grey."""
    channels = read_channels(path)
    names = next((names for names in ("RGB", "Y") if set(names) <= set(channels)), None)
    if names is None:
        raise FileError(f"its channels must be R, G, B or Y, they are {', '.join(channels)}")
    shapes = {channels[name].shape for name in names}
    if len(shapes) > 1:
        raise FileError(f"its channels must have one size, they have {sorted(shapes)}")
    return np.stack([channels[name] for name in names], axis=-1) if len(names) == 3 else channels[names]


def channels_of(pixels: np.ndarray) -> dict[str, np.ndarray]:
    """Those that `read_exr` reads as these pixels."""
    return {"Y": pixels} if pixels.ndim == 2 else {name: pixels[:, :, c] for c, name in enumerate("RGB")}


def write_channels(path: Path, planes: Mapping[str, np.ndarray]) -> None:
    """Channels of shape (h, w) by their names, top row first, in float32; OSError where the disk is full, which OpenEXR does
    not say: what was written is read again.
    """
    exr = import_extra("OpenEXR", "writing .exr needs", "exr")
    channels = {name: np.ascontiguousarray(plane, np.float32) for name, plane in planes.items()}
    options, found = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, {}
    with contextlib.suppress(FileError, OSError, RuntimeError):
        with utf8_name(path) as name, exr.File(options, dict(channels)) as file:
            file.write(name)
        found = read_channels(path)
    if not all(name in found and np.array_equal(found[name], plane, equal_nan=True) for name, plane in channels.items()):
        raise OSError(errno.ENOSPC, "OpenEXR left it incomplete, the disk is probably full")
