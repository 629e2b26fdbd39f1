"""Whether a PNG file (ISO/IEC 15948) is whole, which decoders do not tell: Pillow fills missing rows with zeros in silence."""

import struct
import zlib

from ..errors import FileError
from ..files import require_pixels

_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def require_whole(data: bytes) -> tuple[int, int]:
    """The number of channels of a PNG, and the bits of a sample; ValueError where a byte of it is missing or wrong."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise FileError("it is not a PNG")
    header, packed, kind, at = b"", [], b"", 8
    while kind != b"IEND":
        if len(data) < at + 12:
            raise FileError("it is cut off: its end mark is missing")
        (length,), kind = struct.unpack_from(">I", data, at), data[at + 4 : at + 8]
        body, check = data[at + 8 : at + 8 + length], data[at + 8 + length : at + 12 + length]
        if len(check) < 4:
            raise FileError(f"it is cut off inside its part {kind.decode('latin1')!r}")
        if zlib.crc32(kind + body) != int.from_bytes(check, "big"):
            raise FileError(f"it is damaged: the checksum of its part {kind.decode('latin1')!r} is wrong")
        at += length + 12
        if kind == b"IHDR":
            header = body
        elif kind == b"IDAT":
            packed.append(body)
    if len(header) != 13:
        raise FileError("it is damaged: its header is missing")
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    require_pixels(height, width)
    if colour not in _CHANNELS or depth not in (1, 2, 4, 8, 16):
        raise FileError(f"it is damaged: there is no colour type {colour} with {depth} bits")
    expected, present = _row_bytes(width, height, depth * _CHANNELS[colour], interlaced), 0
    rows = zlib.decompressobj()
    for body in packed:
        present += len(rows.decompress(body, expected + 1 - present))
        if present > expected:
            break
    if present != expected:
        have = "more" if present > expected else present
        raise FileError(f"it is cut off or damaged: {width} x {height} pixels take {expected} bytes, it holds {have}")
    return _CHANNELS[colour], depth


def _row_bytes(width: int, height: int, bits: int, interlaced: int) -> int:
    """The length of all rows with their filter bytes; of the seven passes of Adam7 where `interlaced`."""
    total = 0
    for x, y, dx, dy in _ADAM7 if interlaced else ((0, 0, 1, 1),):
        w, h = max(0, -(-(width - x) // dx)), max(0, -(-(height - y) // dy))
        total += h * (1 + (w * bits + 7) // 8) if w else 0
    return total
