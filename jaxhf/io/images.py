"""Image files to linear radiance and back.

In memory every image is linear, shape (h, w, 3), top row first. Sizes that a file declares are checked against its
length and against `MAX_PIXELS` before anything is decoded.
"""

import contextlib
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from ..core.errors import ArgumentError
from . import files
from .errors import FileError
from .exr import channels_of, read_channels, read_exr, write_channels
from .files import (
    PathLike,
    by_ending,
    read_npy,
    reading,
    replacing,
    require_file,
    require_pixels,
    write_npy,
)
from .gdal import opened
from .png import require_whole


def load_image(path: PathLike, *, transfer: str | None = None) -> Float32[np.ndarray, "h w 3"]:
    """Reads an image as linear radiance: float32, shape (h, w, 3), top row first.

    .png, .jpg and .tif (a GeoTIFF such as an orthophoto; needs rasterio) hold whole numbers of 8 or, if grey or .tif, 16 bits,
    which `transfer` explains. Floats are linear radiance as they are: in a .tif too, in .exr (needs OpenEXR), .pfm and .npy
    (shape (h, w, 3) or (h, w)). Grey becomes three equal channels, alpha is dropped, colour profiles and EXIF rotations are
    not looked at. Pixels of a .tif that its nodata value, mask or alpha leaves out are nan.

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
    require_transfer("load_image", transfer or "srgb")
    path = require_file(path)
    reader = by_ending(_READERS, path, "read an image with")
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


def require_transfer(owner: str, transfer: Any) -> None:
    if transfer not in TRANSFERS:
        raise ArgumentError(owner, "transfer", f"must be one of {', '.join(TRANSFERS)}; it is {transfer!r}")


def save_image(path: PathLike, image: Any, *, transfer: str = "srgb", aovs: Mapping[str, Any] | None = None) -> None:
    """Writes a linear image of shape (h, w, 3) or (h, w), top row first, NumPy or JAX.

    Values are radiance in floats, 1 being white; bytes of 0..255 are not. What is masked is nan. .png, .jpg: 8 bits of the
    values clipped to 0..1, nan becomes 0; a .jpg has Pillow's quality 95. .exr and .pfm: float32. .npy: in the precision of
    `image`. The last three keep nan and inf. The file appears whole or not at all: what was there before stays until its
    successor is complete.

    Args:
      path: the file.
      image: the radiance.
      transfer: the bytes of a .png or .jpg: "srgb", which viewers and `load_image` expect; "linear", 255 times the value, as in
        GDAL's shaded maps. The other formats always hold the values as they are.
      aovs: what `render` gives beside the image, by name, each (h, w) or (h, w, c): layers of an .exr, in float32. Their
        channels are those of compositing programs: depth.Z, normal.X, normal.Y, normal.Z, uv.U, uv.V, else name.V, or
        name.0, name.1 and so on.

    Raises:
      FileNotFoundError, ValueError: as `require_writable`; or `image` has another shape or is not of floats, or `transfer`
        is another, or there are `aovs` of another size, or without .exr.
    """
    path = require_writable(path)
    require_transfer("save_image", transfer)
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
    if ending in _OF_BYTES:
        shares = np.clip(np.nan_to_num(pixels.astype(np.float64), nan=0.0), 0, 1)
        pixels = (TRANSFERS[transfer][0](shares) * 255 + 0.5).astype(np.uint8)
    with replacing(path) as temporary:
        if layers:
            write_channels(temporary, channels_of(pixels) | layers)
        else:
            _WRITERS[ending](temporary, pixels)


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


# One reader a format: a path to shape (h, w, 3) or (h, w), float32 or, where values are encoded, uint8 or uint16.


def read_png(path: Path) -> np.ndarray:
    """What a .png stores: uint8 of shape (h, w, 3), or uint16 of shape (h, w) for 16-bit grey."""
    data = path.read_bytes()
    channels, depth = require_whole(data)
    if depth < 16:
        return _decoded(data, "RGBA")[:, :, :3]
    if channels > 1:  # Pillow would cut them down to 8 bits
        raise FileError(f"a PNG of 16 bits must be grey, it has {channels} channels")
    return _decoded(data)


def read_grey(path: Path) -> np.ndarray:
    """What a picture of one channel stores, .png, .exr or .pfm: shape (h, w), in the numbers of the file."""
    ending = path.suffix.lower()
    if ending == ".exr":
        channels = read_channels(path)
        if len(channels) > 1:
            raise FileError(f"heights must be one channel, it has {', '.join(channels)}")
        return next(iter(channels.values()))
    if ending == ".pfm":
        pixels = _read_pfm(path)
        if pixels.ndim > 2:
            raise FileError("heights must be one channel, it has red, green and blue")
        return pixels
    data = path.read_bytes()
    require_whole(data)
    depth, colour = data[24:26]
    if colour != 0 or depth < 8:
        kinds = {0: "grey", 2: "red, green and blue", 3: "a palette", 4: "grey with opacity", 6: "colours with opacity"}
        raise FileError(f"heights must be grey of 8 or 16 bits, it has {kinds[colour]} of {depth} bits")
    return _decoded(data)


def _read_jpeg(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    data = path.read_bytes()
    if not data.startswith(b"\xff\xd8\xff"):
        raise FileError("it is not a JPEG")
    return _decoded(data, "RGB")


def _decoded(data: bytes, mode: str | None = None) -> np.ndarray:
    with _any_size():
        require_pixels(*imageio.improps(data, index=0, plugin="pillow").shape[:2])
        return imageio.imread(data, index=0, mode=mode, plugin="pillow", writeable_output=False)


_LIMIT = threading.Lock()


@contextlib.contextmanager
def _any_size() -> Iterator[None]:
    """Lifts Pillow's limit, which is one for the whole process and refuses 16384 x 16384: sizes are checked here."""
    with _LIMIT:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def _read_pfm(path: Path) -> np.ndarray:
    """Paul Debevec's format: `PF` or `Pf`, width and height, a scale whose sign gives the byte order, rows from below."""
    data = path.read_bytes()
    header = re.match(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]+)\s", data)
    if header is None:
        raise FileError("it is not a PFM")
    channels, width, height = 3 if header[1] == b"PF" else 1, int(header[2]), int(header[3])
    scale = float(header[4])
    if scale == 0:
        raise FileError("its scale must not be 0: the sign gives the byte order")
    require_pixels(height, width)
    declared, present = 4 * channels * width * height, len(data) - header.end()
    if declared != present:
        raise FileError(f"it is cut off or damaged: {width} x {height} pixels take {declared} bytes, {present} are there")
    pixels = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end())
    return pixels.astype(np.float32).reshape((height, width, 3)[: 3 if channels == 3 else 2])[::-1].copy()


def _read_npy(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        image = read_npy(file, path.stat().st_size)
    if image.dtype.kind != "f":
        raise FileError(f"its array must hold linear radiance in floats, it holds {image.dtype}")
    if image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise FileError(f"its array must have shape (h, w, 3) or (h, w), it has {image.shape}")
    return image.astype(np.float32)


def _read_tiff(path: Path) -> np.ma.MaskedArray:
    """A GeoTIFF's first three bands, or its only one, or its palette's colours; masked where it says that there is nothing."""
    with opened(path) as dataset:
        kinds, words = set(dataset.dtypes), [found.name for found in dataset.colorinterp]
        if len(kinds) > 1 or not kinds <= {"uint8", "uint16", "float32", "float64"}:
            raise FileError(f"a picture must be of uint8, uint16, float32 or float64, it is of {', '.join(sorted(kinds))}")
        if dataset.count > 4 or (dataset.count == 2 and words[1] != "alpha"):
            raise FileError(f"a picture must have 1, 3 or 4 bands, it has {dataset.count} (gdal_translate -b takes some)")
        pixels, there = dataset.read([1, 2, 3] if dataset.count > 2 else [1]), dataset.dataset_mask() > 0
        palette = dataset.colormap(1) if words[0] == "palette" else None
    image = np.moveaxis(pixels, 0, -1) if len(pixels) > 1 else pixels[0]
    if palette is not None:
        image = np.array([palette.get(k, (0, 0, 0))[:3] for k in range(max(palette) + 1)], np.uint8)[image]
    image = image.astype(np.float32) if image.dtype.kind == "f" else image
    return np.ma.array(image, mask=np.broadcast_to(~there if image.ndim == 2 else ~there[..., None], image.shape))


_MOST_OF_JPEG = 65500  # of libjpeg

# One writer a format: a path, and pixels as the file holds them, bytes or floats of shape (h, w, 3) or (h, w).


def _write_jpeg(path: Path, pixels: np.ndarray) -> None:
    if max(pixels.shape[:2]) > _MOST_OF_JPEG:
        raise FileError(f"a JPEG has at most {_MOST_OF_JPEG} pixels a side, this has {pixels.shape[1]} x {pixels.shape[0]}")
    with path.open("wb") as file:
        imageio.imwrite(file, pixels, plugin="pillow", extension=".jpg", quality=95, subsampling=0)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Bytes of shape (h, w), (h, w, 3) or (h, w, 4), or uint16 of shape (h, w), as they are, top row first."""
    with path.open("wb") as file:
        imageio.imwrite(file, np.ascontiguousarray(pixels), plugin="pillow", extension=".png")


def _write_pfm(path: Path, pixels: np.ndarray) -> None:
    h, w = pixels.shape[:2]
    header = f"{'PF' if pixels.ndim == 3 else 'Pf'}\n{w} {h}\n-1.0\n"
    path.write_bytes(header.encode() + pixels[::-1].astype("<f4").tobytes())


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": read_png,
    ".jpg": _read_jpeg,
    ".jpeg": _read_jpeg,
    ".exr": read_exr,
    ".pfm": _read_pfm,
    ".npy": _read_npy,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
}
_WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".png": write_png,
    ".jpg": _write_jpeg,
    ".jpeg": _write_jpeg,
    ".exr": lambda path, pixels: write_channels(path, channels_of(pixels)),
    ".pfm": _write_pfm,
    ".npy": write_npy,
}
_OF_BYTES = (".png", ".jpg", ".jpeg")
PICTURES = tuple(_WRITERS)  # the endings of what `save_image` writes
require_writable = partial(files.require_writable, "save_image", "an image", PICTURES)
# How values in 0..1 are encoded in whole numbers, and decoded.
TRANSFERS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]] = {
    "srgb": (srgb_from_linear, linear_from_srgb),
    "linear": (np.asarray, np.asarray),
}
