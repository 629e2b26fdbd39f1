"""`jaxhf hillshade`: a shaded map, the terrain from straight above, north up."""

import argparse
import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..core.errors import ArgumentError, UserError
from . import arguments
from .render import draw, finish, report_line

if TYPE_CHECKING:
    from ..io.terrain import Terrain
    from ..scene.scene import Scene


def add(commands: Any) -> None:
    about = "Draw a shaded map: the terrain from straight above, north up, a pixel for each cell."
    command = commands.add_parser("hillshade", help="draw a shaded map of a terrain", description=about)
    command.add_argument("terrain", metavar="TERRAIN", help="heights: .npy, .npz, .png (16 bits) or .tif")
    command.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="the picture: .png (bytes in proportion), .exr, .npy or .pfm"
    )
    command.add_argument(
        "--azimuth", type=float, default=315.0, metavar="DEGREES", help="of the light, from north, clockwise [315]"
    )
    command.add_argument("--altitude", type=float, default=45.0, metavar="DEGREES", help="of the light, above the horizon [45]")
    command.add_argument(
        "--sky", type=float, default=0.0, metavar="RADIANCE", help="light from everywhere, also seen through holes [0]"
    )
    arguments.add_size(command)
    arguments.add_settings(command, ("shadows", "samples"), samples="1")
    arguments.add_raster(command)
    arguments.add_machine(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> None:
    from ..io.images import require_writable
    from ..io.load_terrain import load_heights
    from .limits import require_devices
    from .relief import relief, small

    require_writable(options.output)
    require_devices(options.devices)
    settings, (width, height) = arguments.settings(options), arguments.size(options)
    terrain = load_heights(options.terrain, z_scale=options.z_scale, nodata=options.nodata)
    terrain = replace(terrain, heights=terrain.heights.astype(options.precision))
    view = options.azimuth, options.altitude, options.sky
    _require(terrain, *view[1:])
    width, height, extent = _picture(terrain, width, height)
    samples = settings.samples or 1
    if not small(terrain, width * height * samples, options.altitude):
        return draw(options, lambda: hillshade_scene(terrain, *view, width, height), transfer="linear")
    begin = time.perf_counter()
    image = relief(terrain, *view, width, height, extent, math.isqrt(samples), settings.shadows)
    report = report_line(width, height, samples, time.perf_counter() - begin, 0.0, "NumPy", 0)
    finish(options.output, image, report, transfer="linear")


def _require(terrain: "Terrain", altitude: float, sky: float) -> None:
    if not 0 < altitude <= 90:
        raise ArgumentError("hillshade", "altitude", f"must be above 0 and at most 90 degrees, it is {altitude}")
    if not 0 <= sky < float("inf"):
        raise ArgumentError("hillshade", "sky", f"must be 0 or more, it is {sky}")
    if terrain.nodata.all():
        raise UserError("hillshade: there is no height in the terrain")


def _picture(terrain: "Terrain", width: int | None, height: int | None) -> tuple[int, int, float]:
    """See `picture_above`; of one pixel a cell across, unless its size is given."""
    from ..scene.above import picture_above

    if width is None and height is None:
        width = terrain.heights.shape[1] - 1
    return picture_above(terrain.heights.shape, terrain.dx, terrain.dy, width, height)


def hillshade_scene(
    terrain: "Terrain",
    azimuth: float = 315.0,
    altitude: float = 45.0,
    sky: float = 0.0,
    width: int | None = None,
    height: int | None = None,
) -> "Scene":
    """A white map in light as cartographers give it; of one pixel a cell across, unless its size is given.

    Level ground has the radiance sin(altitude) + sky.

    Args:
      terrain: the heights.
      azimuth, altitude: of the light, degrees clockwise from north, and above the horizon.
      sky: radiance of a sky without shadows, which keeps slopes that face away from being black. Holes show it.
      width, height: pixels; see `from_above`.

    Raises:
      ValueError: the light is not above the horizon, the sky is not 0 or more, or there is no height.
    """
    from ..scene.light import Directional, Sky
    from ..scene.material import Matte
    from ..scene.scene import Object, Scene
    from ..scene.views import from_above

    _require(terrain, altitude, sky)
    field = terrain.heightfield()
    lights = [Directional.from_angles(azimuth, altitude), *([Sky(sky)] if sky else [])]
    width, height, _ = _picture(terrain, width, height)
    return Scene([Object(field, Matte(1.0))], from_above(field, width, height), lights, samples=1)
