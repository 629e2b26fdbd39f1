"""PNG files (ISO/IEC 15948) as far as Pillow does not read them: whether they are whole, and colours of 16 bits."""

import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt16

from .files import require_pixels


class Png(NamedTuple):
    """What a .png declares, and its still filtered rows."""

    width: int
    height: int
    depth: int  # bits a sample
    channels: int
    interlaced: bool
    rows: bytes


def read_png(path: Path) -> Png:
    """Reads a .png down to its unpacked rows; ValueError where it is not whole.

    Pillow alone fills missing rows with zeros in silence. The layout is that of the PNG specification (ISO/IEC 15948).
    """
    data = path.read_bytes()
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise ValueError("it is not a PNG")
    header, packed, at = b"", [], 8
    while True:
        if len(data) < at + 12:
            raise ValueError("it is cut off: its end mark is missing")
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        body, check = data[at + 8 : at + 8 + length], data[at + 8 + length : at + 12 + length]
        if len(check) < 4:
            raise ValueError(f"it is cut off inside its part {kind.decode('latin1')!r}")
        if zlib.crc32(kind + body) != int.from_bytes(check, "big"):
            raise ValueError(f"it is damaged: the checksum of its part {kind.decode('latin1')!r} is wrong")
        at += length + 12
        if kind == b"IHDR":
            header = body
        elif kind == b"IDAT":
            packed.append(body)
        elif kind == b"IEND":
            break
    return _unpacked(header, b"".join(packed))


def samples_16(png: Png) -> UInt16[np.ndarray, "h w channels"]:
    """The samples of a 16-bit .png, uint16, shape (h, w, channels).

    Pillow cuts 16-bit colours down to 8 bits. The filters (PNG specification, section 9) are undone along
    anti-diagonals: a byte depends only on those left of it, above it, and left above it.
    """
    if png.interlaced:
        raise ValueError("interlaced 16-bit PNG is not read: save it without interlacing")
    h, w, step = png.height, png.width, 2 * png.channels
    rows = np.frombuffer(png.rows, np.uint8).reshape(h, 1 + w * step)
    filters, filtered = rows[:, :1].astype(np.int16), rows[:, 1:].reshape(h, w, step).astype(np.int16)
    if filters.max() > 4:
        raise ValueError(f"it is damaged: filters go from 0 to 4, it uses {filters.max()}")
    out = np.zeros((h + 1, w + 1, step), np.int16)  # one row above and one column to the left, of zeros
    for diagonal in range(h + w - 1):
        y = np.arange(max(0, diagonal - w + 1), min(h, diagonal + 1))
        x = diagonal - y
        a, b, c = out[y + 1, x], out[y, x + 1], out[y, x]
        kinds = filters[y]
        near_a, near_b, near_c = abs(b - c), abs(a - c), abs(a + b - 2 * c)
        paeth = np.where((near_a <= near_b) & (near_a <= near_c), a, np.where(near_b <= near_c, b, c))
        predicted = np.choose(kinds, [np.zeros_like(a), a, b, (a + b) // 2, paeth])
        out[y + 1, x + 1] = (filtered[y, x] + predicted) & 255
    return out[1:, 1:].astype(np.uint8).reshape(h, w * step).view(">u2").reshape(h, w, png.channels).astype(np.uint16)


def _unpacked(header: bytes, packed: bytes) -> Png:
    if len(header) != 13:
        raise ValueError("it is damaged: its header is missing")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    require_pixels(height, width)
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colour)
    if channels is None or depth not in (1, 2, 4, 8, 16):
        raise ValueError(f"it is damaged: there is no colour type {colour} with {depth} bits")
    expected = _row_bytes(width, height, depth * channels, interlaced)
    rows = zlib.decompressobj().decompress(packed, expected + 1)
    if len(rows) != expected:
        have = "more" if len(rows) > expected else len(rows)
        raise ValueError(f"it is cut off or damaged: {width} x {height} pixels take {expected} bytes, it holds {have}")
    return Png(width, height, depth, channels, bool(interlaced), rows)


def _row_bytes(width: int, height: int, bits: int, interlaced: int) -> int:
    """The length of all rows with their filter bytes; of the seven passes of Adam7 where `interlaced`."""
    adam7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    total = 0
    for x, y, dx, dy in adam7 if interlaced else ((0, 0, 1, 1),):
        w, h = max(0, -(-(width - x) // dx)), max(0, -(-(height - y) // dy))
        total += h * (1 + (w * bits + 7) // 8) if w else 0
    return total
