"""Image files to linear radiance and back.

In memory every image is linear, shape (h, w, 3), top row first.
"""

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from ...core.errors import ArgumentError
from ...core.rules import OneOf, require
from .. import files
from ..errors import FileError
from ..files import PathLike, by_ending, reading, replacing, require_file
from .codecs import OF_BYTES, READERS, WRITERS
from .exr import channels_of, write_channels


def load_image(path: PathLike, *, transfer: str | None = None) -> Float32[np.ndarray, "h w 3"]:
    """Reads an image as linear radiance: float32, shape (h, w, 3), top row first.

    .png, .jpg, .webp and .tif (a GeoTIFF such as an orthophoto; needs rasterio) hold whole numbers of 8 or, if grey or .tif,
    16 bits, which `transfer` explains. Floats are linear radiance as they are: in a .tif too, in .exr (needs OpenEXR), .pfm
    and .npy (shape (h, w, 3) or (h, w)). Grey becomes three equal channels, alpha is dropped, colour profiles and EXIF
    rotations are not looked at. Pixels of a .tif that its nodata value, mask or alpha leaves out are nan.

    Args:
      path: the file.
      transfer: what whole numbers are: "srgb", decoded by the curve of IEC 61966-2-1; "linear", shares of 255 or 65535, as in
        what cameras and satellites measure. None: sRGB, as nearly all pictures of 8 bits are; of 16 bits many are not, so a
        warning says what was taken.

    Raises:
      FileNotFoundError: no file is there.
      ValueError: the ending or `transfer` is not known, or the file is not a whole image of that kind.
    """
    return _load(path, transfer, np.nan)


def load_numbers(path: PathLike) -> Float32[np.ndarray, "h w 3"]:
    """As `load_image`, for values that are no colours: whole numbers are shares of 255, or of 65535; what is left out is 0."""
    return _load(path, "linear", 0.0)


def _load(path: PathLike, transfer: str | None, left_out: float) -> np.ndarray:
    require("load_image", "transfer", transfer or "srgb", OneOf(TRANSFERS))
    path = require_file(path)
    reader = by_ending(READERS, path, "read an image with")
    with reading(path):
        stored = reader(path)
    image = np.ma.getdata(stored)
    if image.dtype.kind == "u":
        top = np.iinfo(image.dtype).max
        if transfer is None and top > 255:
            warnings.warn(
                f"{path}: its 16-bit values are taken for sRGB; transfer = 'srgb' or 'linear' says what they are",
                stacklevel=3,
            )
        image = TRANSFERS[transfer or "srgb"][1](np.arange(top + 1) / top).astype(np.float32)[image]
    if np.ma.is_masked(stored):
        image = np.where(np.ma.getmaskarray(stored), np.float32(left_out), image)
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def save_image(path: PathLike, image: Any, *, transfer: str = "srgb", aovs: Mapping[str, Any] | None = None) -> None:
    """Writes a linear image of shape (h, w, 3) or (h, w), top row first, NumPy or JAX.

    Values are radiance in floats, 1 being white; bytes of 0..255 are not. What is masked is nan. .png, .jpg, .webp: 8 bits
    of the values clipped to 0..1, nan becomes 0; the last two have Pillow's quality 95. .exr and .pfm: float32. .npy: in the
    precision of `image`. The last three keep nan and inf. The file appears whole or not at all: what was there before stays
    until its successor is complete.

    Args:
      path: the file.
      image: the radiance.
      transfer: the bytes of a .png, .jpg or .webp: "srgb", which viewers and `load_image` expect; "linear", 255 times the
        value, as in GDAL's shaded maps. The other formats always hold the values as they are.
      aovs: what `render` gives beside the image, by name, each (h, w) or (h, w, c): layers of an .exr, in float32. Their
        channels are those of compositing programs: depth.Z, normal.X, normal.Y, normal.Z, uv.U, uv.V, else name.V, or
        name.0, name.1 and so on.

    Raises:
      FileNotFoundError, PermissionError: the folder is not there, or nothing can be written into it.
      ValueError: the ending is not known, or a package for it is missing; `image` has another shape or is not of floats,
        `transfer` is another, or there are `aovs` of another size, or without .exr.
    """
    path = require_writable(path)
    require("save_image", "transfer", transfer, OneOf(TRANSFERS))
    pixels = np.asarray(image)
    if pixels.dtype.kind == "V":  # bfloat16 and its like, which .npy would store without their meaning
        pixels = pixels.astype(np.float32)
    if pixels.dtype.kind != "f":
        raise FileError(f"{path}: an image must hold linear radiance in floats, 1 being white; this one holds {pixels.dtype}")
    pixels = np.ma.filled(image, np.nan) if np.ma.is_masked(image) else pixels
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)) or 0 in pixels.shape:
        raise FileError(f"{path}: an image must have shape (h, w, 3) or (h, w), this one has {pixels.shape}")
    if aovs and path.suffix.lower() != ".exr":
        raise ArgumentError("save_image", "aovs", f"are layers of an .exr, {path} is none")
    ending, layers = path.suffix.lower(), _layers(aovs or {}, pixels.shape[:2])
    if ending in OF_BYTES:
        pixels = bytes_of(pixels, transfer)
    with replacing(path) as temporary:
        if layers:
            write_channels(temporary, channels_of(pixels) | layers)
        else:
            WRITERS[ending](temporary, pixels)


def bytes_of(image: Float[np.ndarray, "h w *c"], transfer: str = "srgb") -> UInt8[np.ndarray, "h w *c"]:
    """Linear radiance as the bytes that `save_image` writes."""
    shares = np.clip(np.nan_to_num(image.astype(np.float64), nan=0.0), 0, 1)
    return (TRANSFERS[transfer][0](shares) * 255 + 0.5).astype(np.uint8)


def _layers(aovs: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """The channels of an .exr for images of this shape beside the picture."""
    found = {}
    for name, values in aovs.items():
        values = np.asarray(values)
        if values.ndim not in (2, 3) or values.shape[:2] != shape:
            raise ArgumentError("save_image", f"aovs[{name!r}]", f"must have the image's size, {shape}, it has {values.shape}")
        values = values.reshape(*shape, -1)
        letters = {"depth": "Z", "normal": "XYZ", "uv": "UV"}.get(name, "V" if values.shape[2] == 1 else "")
        for c in range(values.shape[2]):
            found[f"{name}.{letters[c] if len(letters) == values.shape[2] else c}"] = values[:, :, c]
    return found


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1: encoded values in 0..1 to linear ones."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1: linear values in 0..1 to encoded ones."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


PICTURES = tuple(WRITERS)  # the endings of what `save_image` writes
require_writable = partial(files.require_writable, "save_image", "an image", PICTURES)
# How values in 0..1 are encoded in whole numbers, and decoded.
TRANSFERS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]] = {
    "srgb": (srgb_from_linear, linear_from_srgb),
    "linear": (np.asarray, np.asarray),
}
