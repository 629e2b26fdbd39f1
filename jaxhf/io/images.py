"""Image files to linear radiance and back.

In memory every image is linear, shape (h, w, 3), top row first. Sizes that a file declares are checked against its
length and against `MAX_PIXELS` before anything is decoded.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from .files import PathLike, by_ending, read_npy, reading, replacing, require_file, require_folder, require_pixels
from .png import read_png, samples_16


def load_image(path: PathLike) -> Float32[np.ndarray, "h w 3"]:
    """Reads an image as linear radiance: float32, shape (h, w, 3), top row first.

    .png and .jpg hold sRGB, and are decoded by the curve of IEC 61966-2-1; .exr (needs OpenEXR), .pfm and .npy (of
    floats, shape (h, w, 3) or (h, w)) hold linear radiance. Grey becomes three equal channels, alpha is dropped, colour
    profiles and EXIF rotations are not looked at.

    Raises:
      FileNotFoundError: no file is there.
      ValueError: the ending is not known, or the file is not a whole image of that kind.
    """
    return _load(path, linear_from_srgb)


def load_numbers(path: PathLike) -> Float32[np.ndarray, "h w 3"]:
    """As `load_image`, for an image whose values are not colours: those of .png and .jpg are shares of 255, or of 65535."""
    return _load(path, lambda encoded: encoded)


def _load(path: PathLike, decode: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    path = require_file(path)
    reader = by_ending(_READERS, path, "read an image with")
    with reading(path):
        image = reader(path)
    if image.dtype.kind == "u":
        top = np.iinfo(image.dtype).max
        image = decode(np.arange(top + 1) / top).astype(np.float32)[image]
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def save_image(path: PathLike, image: Any, *, transfer: Literal["srgb", "linear"] = "srgb") -> None:
    """Writes a linear image of shape (h, w, 3) or (h, w), top row first, NumPy or JAX.

    Values are radiance in floats, 1 being white; bytes of 0..255 are not. .png: 8 bits of the values clipped to 0..1, by
    the curve of sRGB or, with transfer="linear", in proportion as in printed maps; nan becomes 0. .exr and .pfm: float32.
    .npy: in the precision of `image`. The last three keep nan and inf. The file appears whole or not at all: what was there
    before stays until its successor is complete.

    Raises:
      FileNotFoundError, ValueError: as `require_writable`; or `image` has another shape or is not of floats.
    """
    path = require_writable(path)
    pixels = np.asarray(image)
    if pixels.dtype.kind == "V":  # bfloat16 and its like, which .npy would store without their meaning
        pixels = pixels.astype(np.float32)
    if pixels.dtype.kind != "f":
        raise ValueError(f"{path}: an image must hold linear radiance in floats, 1 being white; this one holds {pixels.dtype}")
    if pixels.ndim not in (2, 3) or pixels.shape[2:] not in ((), (3,)) or 0 in pixels.shape:
        raise ValueError(f"{path}: an image must have shape (h, w, 3) or (h, w), this one has {pixels.shape}")
    if path.suffix.lower() == ".png" and transfer == "linear":
        pixels = linear_from_srgb(np.clip(pixels, 0, 1))
    with replacing(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, pixels)


def require_writable(path: PathLike) -> Path:
    """Checks that `save_image` can write to `path`, so that nobody renders for an hour first.

    Raises:
      ValueError: the ending is not known, a package for it is missing, or `path` is a folder.
      FileNotFoundError: the folder does not exist.
      PermissionError: the folder cannot be written to.
    """
    path = Path(path)
    by_ending(_WRITERS, path, "write an image with")
    require_folder(path, "an image")
    if path.suffix.lower() == ".exr":
        with reading(path):
            _openexr("writing")
    return path


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1: encoded values in 0..1 to linear ones."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1: linear values in 0..1 to encoded ones."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


# One reader a format: a path to shape (h, w, 3) or (h, w), float32 or, where values are encoded, uint8 or uint16.


def _read_png(path: Path) -> np.ndarray:
    png = read_png(path)
    if png.depth == 16:
        samples = samples_16(png)
        return samples[:, :, :3] if png.channels > 2 else samples[:, :, 0]
    return _read_pillow(path, PngImageFile)


def _read_jpeg(path: Path) -> np.ndarray:
    return _read_pillow(path, JpegImageFile)


def _read_pillow(path: Path, kind: type[ImageFile]) -> np.ndarray:
    # The class is called directly: Image.open refuses 16384 x 16384 as an attack, by a limit for the whole process.
    with path.open("rb") as file:
        image = kind(file)
        require_pixels(image.height, image.width)
        image.info.pop("transparency", None)  # or convert warns that it will be lost
        return np.asarray(image.convert("RGB"))


def _openexr(doing: str) -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise ValueError(f"{doing} .exr needs OpenEXR: pip install 'jaxhf[exr]'") from error
    return OpenEXR


def _read_exr(path: Path) -> np.ndarray:
    exr = _openexr("reading")
    try:
        with exr.File(str(path), separate_channels=True, header_only=True) as file:
            (x0, y0), (x1, y1) = file.header()["dataWindow"]
        require_pixels(int(y1) - int(y0) + 1, int(x1) - int(x0) + 1)
        with exr.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except RuntimeError as error:
        raise ValueError("it is not an OpenEXR file, or damaged") from error
    except ValueError as error:
        if "part index" not in str(error):
            raise
        raise ValueError("it is cut off or damaged: pixels are missing") from error
    names = next((names for names in ("RGB", "Y") if set(names) <= set(channels)), None)
    if names is None:
        raise ValueError(f"its channels must be R, G, B or Y, they are {', '.join(channels)}")
    shapes = {channels[name].shape for name in names}
    if len(shapes) > 1:
        raise ValueError(f"its channels must have one size, they have {sorted(shapes)}")
    return np.stack([channels[name] for name in names], axis=-1) if len(names) == 3 else channels[names]


def _read_pfm(path: Path) -> np.ndarray:
    """Paul Debevec's format: `PF` or `Pf`, width and height, a scale whose sign gives the byte order, rows from below."""
    data = path.read_bytes()
    header = re.match(rb"(P[Ff])\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]+)\s", data)
    if header is None:
        raise ValueError("it is not a PFM")
    channels, width, height = 3 if header[1] == b"PF" else 1, int(header[2]), int(header[3])
    scale = float(header[4])
    if scale == 0:
        raise ValueError("its scale must not be 0: the sign gives the byte order")
    require_pixels(height, width)
    declared, present = 4 * channels * width * height, len(data) - header.end()
    if declared != present:
        raise ValueError(f"it is cut off or damaged: {width} x {height} pixels take {declared} bytes, {present} are there")
    pixels = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end())
    return pixels.astype(np.float32).reshape((height, width, 3)[: 3 if channels == 3 else 2])[::-1].copy()


def _read_npy(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        image = read_npy(file, path.stat().st_size)
    if image.dtype.kind != "f":
        raise ValueError(f"its array must hold linear radiance in floats, it holds {image.dtype}")
    if image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise ValueError(f"its array must have shape (h, w, 3) or (h, w), it has {image.shape}")
    return image.astype(np.float32)


# One writer a format.


def _write_png(path: Path, pixels: np.ndarray) -> None:
    clipped = np.clip(np.nan_to_num(pixels.astype(np.float64), nan=0.0), 0, 1)
    encoded = (srgb_from_linear(clipped) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(encoded).save(path, format="PNG")


def _write_exr(path: Path, pixels: np.ndarray) -> None:
    exr = _openexr("writing")
    planes = {"Y": pixels} if pixels.ndim == 2 else {name: pixels[:, :, c] for c, name in enumerate("RGB")}
    channels = {name: np.ascontiguousarray(plane, np.float32) for name, plane in planes.items()}
    with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels) as file:
        file.write(str(path))


def _write_pfm(path: Path, pixels: np.ndarray) -> None:
    h, w = pixels.shape[:2]
    header = f"{'PF' if pixels.ndim == 3 else 'Pf'}\n{w} {h}\n-1.0\n"
    path.write_bytes(header.encode() + pixels[::-1].astype("<f4").tobytes())


def _write_npy(path: Path, pixels: np.ndarray) -> None:
    with path.open("wb") as file:  # np.save appends .npy to a name without it
        np.save(file, pixels)


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": _read_png,
    ".jpg": _read_jpeg,
    ".jpeg": _read_jpeg,
    ".exr": _read_exr,
    ".pfm": _read_pfm,
    ".npy": _read_npy,
}
_WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".png": _write_png,
    ".exr": _write_exr,
    ".pfm": _write_pfm,
    ".npy": _write_npy,
}
