"""GDAL's own maps, through plain files of numbers that need no package."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

needed = pytest.mark.skipif(shutil.which("gdaldem") is None, reason="GDAL's gdaldem is not installed")


def gdaldem(
    folder: Path,
    mode: str,
    heights: np.ndarray,
    dx: float,
    dy: float,
    *options: object,
    nodata: float | None = None,
    ramp: str = "",
) -> np.ndarray:
    """What `gdaldem mode` makes of heights whose row 0 is in the south: an array of that order, (ny, nx) or (ny, nx, bands).

    `ramp` is the text of the colour file that "color-relief" needs.
    """
    kind = {"i2": 2, "f4": 4, "f8": 5}[heights.dtype.str[1:]]
    header = {"samples": heights.shape[1], "lines": heights.shape[0], "bands": 1, "data type": kind, "byte order": 0}
    header |= {"interleave": "bsq", "map info": f"{{Arbitrary, 1, 1, 0, 0, {dx!r}, {dy!r}}}"}
    header |= {} if nodata is None else {"data ignore value": nodata}
    (folder / "in.hdr").write_text("ENVI\n" + "".join(f"{key} = {value}\n" for key, value in header.items()))
    heights[::-1].tofile(folder / "in.bin")
    (folder / "ramp.txt").write_text(ramp)
    command = ["gdaldem", mode, "in.bin", *(["ramp.txt"] if ramp else []), "out.bin", "-q", "-of", "ENVI", *map(str, options)]
    for old in (*folder.glob("out.*"), *folder.glob("*.aux.xml")):  # GDAL keeps statistics in the latter
        old.unlink(missing_ok=True)
    subprocess.run(command, check=True, cwd=folder, capture_output=True, timeout=60)
    dtype = np.uint8 if mode in ("hillshade", "color-relief") else np.float32
    found = np.fromfile(folder / "out.bin", dtype).reshape(-1, *heights.shape)[:, ::-1]
    return found[0] if len(found) == 1 else np.moveaxis(found, 0, -1)
