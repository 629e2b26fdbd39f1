"""What each format of pictures stores, read and written as it is.

Sizes that a file declares are checked against its length and against `MAX_PIXELS` before anything is decoded.
"""

import contextlib
import re
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from ..errors import FileError
from ..files import read_npy, require_pixels, write_npy
from ..gdal import opened
from .exr import channels_of, read_channels, read_exr, write_channels
from .png import require_whole


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


def _read_lossy(path: Path, kind: str, begin: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """A "JPEG" or "WebP"; FileError where its first bytes are not these, a regular expression."""
    data = path.read_bytes()
    if not re.match(begin, data, re.DOTALL):
        raise FileError(f"it is not a {kind}")
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
        require_pixels(dataset.height, dataset.width)
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


def _write_lossy(path: Path, pixels: np.ndarray, kind: str, most: int, **how: Any) -> None:
    """As a "JPEG" or "WebP", whose library takes `most` pixels a side; FileError where there are more."""
    if max(pixels.shape[:2]) > most:
        raise FileError(f"a {kind} has at most {most} pixels a side, this has {pixels.shape[1]} x {pixels.shape[0]}")
    with path.open("wb") as file:
        imageio.imwrite(file, pixels, plugin="pillow", extension=f".{kind.lower()}", quality=95, **how)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Bytes of shape (h, w), (h, w, 3) or (h, w, 4), or uint16 of shape (h, w), as they are, top row first."""
    with path.open("wb") as file:
        imageio.imwrite(file, np.ascontiguousarray(pixels), plugin="pillow", extension=".png")


def _write_pfm(path: Path, pixels: np.ndarray) -> None:
    h, w = pixels.shape[:2]
    header = f"{'PF' if pixels.ndim == 3 else 'Pf'}\n{w} {h}\n-1.0\n"
    path.write_bytes(header.encode() + pixels[::-1].astype("<f4").tobytes())


# One reader a format: a path to shape (h, w, 3) or (h, w), float32 or, where values are encoded, uint8 or uint16.
READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": read_png,
    **dict.fromkeys((".jpg", ".jpeg"), partial(_read_lossy, kind="JPEG", begin=rb"\xff\xd8\xff")),
    ".webp": partial(_read_lossy, kind="WebP", begin=rb"RIFF.{4}WEBP"),
    ".exr": read_exr,
    ".pfm": _read_pfm,
    ".npy": _read_npy,
    **dict.fromkeys((".tif", ".tiff"), _read_tiff),
}
# One writer a format: a path, and pixels as the file holds them, bytes or floats of shape (h, w, 3) or (h, w).
WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".png": write_png,
    **dict.fromkeys((".jpg", ".jpeg"), partial(_write_lossy, kind="JPEG", most=65500, subsampling=0)),
    ".webp": partial(_write_lossy, kind="WebP", most=16383),
    ".exr": lambda path, pixels: write_channels(path, channels_of(pixels)),
    ".pfm": _write_pfm,
    ".npy": write_npy,
}
OF_BYTES = (".png", ".jpg", ".jpeg", ".webp")
