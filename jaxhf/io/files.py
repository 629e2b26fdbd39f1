"""What the readers of scenes, heights and images share: which files there are, and how errors name them."""

import contextlib
import glob
import math
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from ..core.errors import ArgumentError, require_kind
from ..core.extras import import_extra
from .errors import FileError, nearest

MAX_PIXELS = 2**28  # 16384 x 16384, for images and for grids of heights

PathLike = str | os.PathLike[str]
Codec = TypeVar("Codec")
_KINDS = {
    **dict.fromkeys((".toml", ".pbrt"), "a scene, for jaxhf render"),
    **dict.fromkeys((".tif", ".tiff", ".npz", ".asc", ".hgt"), "a terrain, for jaxhf view, hillshade, relief or convert"),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".webp", ".exr", ".npy", ".pfm"), "a picture"),
    **dict.fromkeys((".glb", ".obj", ".ply", ".stl"), "a mesh"),
}


def by_ending(codecs: Mapping[str, Codec], path: Path, task: str) -> Codec:
    """What does `task` for the ending of `path`; FileError where nothing does, with the one that was meant, or all that do."""
    ending = path.suffix.lower()
    if ending in codecs:
        return codecs[ending]
    named = f"the ending {path.suffix!r}" if ending else "a name without an ending"
    tail = f"known: {', '.join(sorted(codecs))}" if ending in _KINDS else nearest(ending, codecs, cutoff=0.7)
    if task.startswith("read") and ending in _KINDS and _KINDS[ending] not in map(_KINDS.get, codecs):
        tail += f"; this is {_KINDS[ending]}"
    raise FileError(f"{path}: cannot {task} {named}; {tail}")


def file_path(owner: str, path: Any) -> Path:
    """A path of pathlib's; ArgumentError where something else stands in the place of a file's name, as an address does."""
    require_kind(owner, "path", path, (str, os.PathLike), "the name of a file")
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", str(path)):
        raise FileError(f"{path}: this is an address, files are neither read from the network nor written there; download it")
    return Path(path)


def require_file(path: PathLike) -> Path:
    path = file_path("", path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise FileError(f"{path}: must be a file, it is a folder or a device")
    return path


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Puts the file's name in front of whatever goes wrong inside, as one FileError.

    The decoders raise nearly anything on broken files: OSError, SyntaxError, RuntimeError, EOFError, struct.error.
    """
    try:
        yield
    except (MemoryError, PermissionError):
        raise
    except Exception as error:
        raise FileError(f"{path}: {error}") from error


def require_folder(path: Path, what: str) -> None:
    """Checks that a file can be put where `path` says: into a folder that is there and can be written to."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {str(path.parent)!r}")
    if path.is_dir():
        raise FileError(f"{path}: {what} cannot be written here, it is a folder")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: the folder {str(path.parent)!r} cannot be written to")


@contextlib.contextmanager
def replacing(path: Path, beside: Mapping[Path, str] | None = None) -> Iterator[Path]:
    """Yields a temporary name beside `path`, which takes its place at the end, or vanishes if anything goes wrong.

    Small text files that go `beside` it, given with their contents, are written before any file takes its place.
    """
    beside = beside or {}
    with replacing_all([path, *beside]) as (temporary, *others):
        yield temporary
        for other, text in zip(others, beside.values(), strict=True):
            other.write_text(text, encoding="utf-8")


@contextlib.contextmanager
def replacing_all(paths: Iterable[Path]) -> Iterator[list[Path]]:
    """Yields a temporary name beside each path; at the end all take their places, or vanish if anything goes wrong with one.

    The new content is on the disk before it gets the name, and the name when this ends: a power failure leaves the old file
    or the new one, not an empty one (Pillai et al., All file systems are not created equal, 2014).
    """
    paths = [path.resolve() for path in paths]  # what a link points to is replaced, not the link
    temporaries = [path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp") for path in paths]
    TEMPORARIES.update(temporaries)
    try:
        yield temporaries
        for temporary in temporaries:
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
        for path, temporary in zip(paths, temporaries, strict=True):
            os.replace(temporary, path)
        for folder in {path.parent for path in paths}:
            with contextlib.suppress(OSError):  # Windows opens no folders, some network file systems synchronise none
                descriptor = os.open(folder, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)
    except OSError as error:
        if error.errno is None:
            raise
        named = type(error)(f"{paths[0]}: cannot be written: {error.strerror}")
        named.errno = error.errno
        raise named from error
    finally:
        for temporary in temporaries:
            temporary.unlink(missing_ok=True)
        TEMPORARIES.difference_update(temporaries)


TEMPORARIES: set[Path] = set()  # that there may be now: for Ctrl-C, which ends a command wherever it is


@contextlib.contextmanager
def utf8_name(path: Path) -> Iterator[str]:
    """The file's name as GDAL and OpenEXR take it, in UTF-8; where it is not, that of a link, beside links to its sidecars."""
    path, named = path.absolute(), None
    with contextlib.suppress(UnicodeDecodeError):
        named = os.fsencode(path).decode()
    with contextlib.ExitStack() as folders:
        if named is None:
            folder = Path(folders.enter_context(tempfile.TemporaryDirectory()))
            for other in {path, *path.parent.glob(f"{glob.escape(path.stem)}.*")}:
                (folder / f"linked{other.name.removeprefix(path.stem)}").symlink_to(other)
            named = str(folder / f"linked{path.suffix}")
        yield named


_NEEDS = {  # the package that writes a format, and the extra that installs it
    ".exr": ("OpenEXR", "exr"),
    ".mp4": ("av", "video"),
    **dict.fromkeys((".tif", ".tiff"), ("rasterio", "geo")),
    **dict.fromkeys((".glb", ".obj", ".ply", ".stl"), ("trimesh", "mesh")),
}


def require_writable(owner: str, what: str, endings: Iterable[str], path: PathLike) -> Path:
    """Checks that `owner` can write a file of one of these endings, so that nobody renders or fits for an hour first.

    FileError where the ending is another, or a package for it, or its part of Pillow, is missing; else as `require_folder`.
    """
    path = file_path(owner, path)
    by_ending(dict.fromkeys(endings), path, f"write {what} with")
    require_folder(path, what)
    ending = path.suffix.lower()
    if ending in _NEEDS:
        with reading(path):
            package, extra = _NEEDS[ending]
            import_extra(package, f"writing {ending} needs", extra)
    if ending == ".webp":
        from PIL import features  # which most files do without

        if not features.check("webp"):
            raise FileError(f"{path}: the Pillow that is installed was built without WebP; write .png or .jpg")
    return path


def save_text(path: PathLike, text: str) -> None:
    """Writes a text as UTF-8; the file appears whole or not at all."""
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape")  # names in it may be in no encoding


def require_precision(dtype: DTypeLike) -> np.dtype:
    """The dtype of the heights; ArgumentError where it is not float32 or float64, or JAX would narrow it in silence."""
    found = np.dtype(dtype)
    if found not in (np.float32, np.float64):
        raise ArgumentError("", "dtype", f"must be float32 or float64, it is {found}")
    import jax  # which converting a file does without

    if jax.dtypes.canonicalize_dtype(found) != found:
        raise ArgumentError("", "dtype", "float64 needs JAX's x64 mode: jax.config.update('jax_enable_x64', True)")
    return found


def require_pixels(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise FileError(f"its size must be positive, it is {width} x {height}")
    if height * width > MAX_PIXELS:
        raise FileError(f"it must hold at most {MAX_PIXELS} pixels, it declares {width} x {height}")


def write_npy(path: Path, array: np.ndarray) -> None:
    """As np.save, but a full disk is the system's own error, which names itself, and not "8 requested and 7 written"."""
    array = np.ascontiguousarray(array)
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(array))
        file.write(array.data)


def read_npy(file: Any, size: int, kinds: str = "fiub") -> np.ndarray:
    """The array of an open .npy file, or member of an archive, of `size` bytes; ValueError where it is not of these `kinds`.

    np.load trusts the header and asks for all the memory that it names, so its size is compared with the file's first.
    """
    version = np.lib.format.read_magic(file)
    header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if header is None:
        raise ValueError(f"its .npy version must be 1.0 or 2.0, it is {version}")
    shape, _, dtype = header(file)
    if dtype.kind not in kinds:
        raise ValueError(f"its array must hold real numbers, it holds {dtype}")
    require_pixels(*(*shape, 1, 1)[:2])
    declared, present = math.prod(shape) * dtype.itemsize, size - file.tell()
    if declared != present:
        raise ValueError(f"it is cut off or damaged: its header declares {declared} bytes of data, {present} are there")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
