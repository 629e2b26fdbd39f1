"""`jaxhf horizon`: how high the terrain stands round each of its points, direction by direction."""

import argparse
import time
from pathlib import Path
from typing import Any

from .. import arguments, mapping
from .skyview import add_terrain, read


def add(commands: Any) -> None:
    about = "Map horizon angles, in degrees above the horizontal, at least 0: exact and without a search radius."
    examples = arguments.examples(
        "jaxhf horizon dem.tif -o horizon.npy --azimuths 36", "jaxhf horizon dem.tif -o west.tif --azimuth 270"
    )
    command = commands.add_parser("horizon", help="map the horizon angles of a terrain", description=about, epilog=examples)
    add_terrain(command, "the map: .npy of shape (azimuths, rows, columns), or .tif, one file an azimuth: OUT_090.tif")
    command.add_argument("--azimuth", type=float, metavar="DEGREES", help="one direction, from north, clockwise, in its place")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    import numpy as np

    from ...core.errors import ArgumentError, counted
    from ...io.files import replacing_all, write_npy
    from ...io.rasters import geotiff, require_writable_raster

    mapping.require_numbers(options.output, "angles")
    path = require_writable_raster(options.output)
    if options.azimuth is not None:
        arguments.refuse(options, "azimuths", because="--azimuth asks for one")
    if options.azimuth is not None and not np.isfinite(options.azimuth):
        raise ArgumentError("", "--azimuth", f"must be finite, it is {options.azimuth}")
    stored, terrain = read(options)
    arguments.set_up_jax(options)
    from ...maps.skyview import horizon
    from ...trace.horizon import even_azimuths
    from ..progress import compiled_bar

    begin = time.perf_counter()
    azimuths = even_azimuths(options.azimuths) if options.azimuth is None else np.array([options.azimuth])
    tiff, one = path.suffix.lower() != ".npy", options.azimuth is not None
    paths, maps, highest = [path if one or not tiff else _of(path, azimuth) for azimuth in azimuths], [], 0.0
    with replacing_all(paths if tiff else [path]) as temporaries, compiled_bar(unit=" angles", unit_scale=True) as advance:
        for number, azimuth in enumerate(azimuths):

            def grown(done: int, total: int, number: int = number) -> None:
                advance(number * total + done, len(azimuths) * total)

            (angles,) = np.asarray(horizon(terrain, [azimuth], progress=grown))
            highest = max(highest, float(np.nanmax(angles)))
            if tiff:
                temporaries[number].write_bytes(geotiff(angles, stored, np.nan))
            else:
                maps.append(angles)
        if maps:
            write_npy(temporaries[0], maps[0] if one else np.stack(maps))
    took = time.perf_counter() - begin
    print(f"{path}: horizon angles up to {highest:.2f} degrees, {counted(len(azimuths), 'azimuth')}, {took:.1f} s")


def _of(path: Path, azimuth: float) -> Path:
    """The file of one direction: out_090.tif."""
    degrees = f"{azimuth:03.0f}" if azimuth == round(azimuth) else f"{azimuth:06.2f}"
    return path.with_name(f"{path.stem}_{degrees}{path.suffix}")
