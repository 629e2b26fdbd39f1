"""`jaxhf view`: a terrain as a solid block, from a place that shows all of it."""

import argparse
import dataclasses
import datetime
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...core.errors import UserError
from ...core.extras import import_extra
from ...io.files import require_writable as require_writable_file
from ...io.pictures.films import FILMS, require_writable_film, writing_film
from ...io.pictures.images import PICTURES, bytes_of, linear_from_srgb, require_writable, save_image
from ...io.terrain.drape import load_drape
from ...io.terrain.load import jacksboro_file, load_heights
from ...io.terrain.terrain import Terrain
from ...maps.relief import color_relief
from ...rendering.render import Prepared
from ...scene.camera import Perspective
from ...scene.heightfield import Heightfield
from ...scene.material import SCATTERING
from ...scene.sun import sun, utc
from ...xla.devices import local_mesh
from .. import arguments, limits
from ..block import Look, block, exaggeration, has_sea, lights, photograph, prepared, with_water
from ..caption import annotated
from ..catalogue import PRESETS
from ..overwriting import require_no_input
from ..progress import bar
from ..sheet import SHEETS, save_sheet
from .maps import place_of

_TALLEST = 100  # times its length: beyond, a terrain is a needle that no pixel shows


def _sun_path(options: argparse.Namespace, terrain: Terrain) -> np.ndarray | None:
    """The sun's azimuth from the y axis and altitude in each frame of a film, shape (frames, 2); None where it stands still."""
    first, last, place = options.sun_from, options.sun_to, (options.latitude, options.longitude)
    times = isinstance(first, datetime.datetime)
    if times != isinstance(last, datetime.datetime):
        raise UserError("view: --sun-from and --sun-to must both be angles or both be times")
    if not times:
        if place != (None, None):
            raise UserError("view: --latitude and --longitude stand with times, as in --sun-from 2026-06-21T06:00:00Z")
        return None if first is None else np.linspace(first, last, options.frames) - (terrain.rotation, 0)
    place = place_of("view", options, terrain)
    start, end = (utc("view", "time", time) for time in (first, last))
    instants = start + (end - start) * np.arange(options.frames) // (options.frames - 1)
    azimuth, altitude = sun(instants, *place)
    if not (altitude > 0).all():
        low = int(np.argmin(altitude))
        when = instants[low].astype("datetime64[s]")
        raise UserError(f"view: the sun must be up all the time, its altitude is {altitude[low]:.2f} degrees at {when}Z (UTC)")
    return np.stack([azimuth - terrain.turned_from_north, altitude], -1)


def _output(options: argparse.Namespace) -> tuple[Path, bool]:
    """The file, and whether it is a film; UserError where options do not go together."""
    if options.demo == (options.terrain is not None):
        raise UserError(f"view: IN or --demo must say what to show, {'not both' if options.demo else 'there is neither'}")
    if options.demo:
        options.terrain = jacksboro_file()
    output = Path(options.output or Path(options.terrain).with_suffix(".png").name)
    ending, moves = output.suffix.lower(), options.frames is not None or options.sun_from is not None
    film = ending in FILMS or (moves and ending not in PICTURES)
    if (options.sun_from is None) != (options.sun_to is None):
        raise UserError("view: --sun-from and --sun-to belong together, one is missing")
    if options.sun_from is not None and not film:
        raise UserError(f"view: a moving sun makes a film, {output} is none; write {' or '.join(FILMS)}")
    if not film:
        arguments.refuse(options, "frames", because=f"{output} is one picture, a film is {' or '.join(FILMS)}")
    if options.sun_from is not None:
        arguments.refuse(options, "azimuth", "altitude", because="the sun moves from --sun-from to --sun-to")
    if options.drape is not None:
        arguments.refuse(options, "ramp", because="--drape gives the terrain its colours")
    if film:
        arguments.refuse(options, "annotate", because=f"{output} is a film, and pictures have captions")
    if not options.annotate:
        arguments.refuse(options, "title", because="without --annotate there is no caption")
    require_no_input(options, output)
    if options.annotate:
        import_extra("matplotlib", "--annotate draws with", "plot")
        require_writable_file("view", "a picture with a caption", SHEETS, output)
    else:
        (require_writable_film if film else require_writable)(output)
    return output, film


def run(options: argparse.Namespace) -> None:
    output, film = _output(options)
    begin = time.perf_counter()
    terrain = load_heights(options.terrain, **arguments.reading(options))
    if terrain.nodata.all():
        raise UserError(f"view: {options.terrain} holds no height")
    options.frames = options.frames or 72
    path = _sun_path(options, terrain)
    factor = options.exaggeration or exaggeration(terrain.heights, terrain.dx, terrain.dy)
    z, colours, base = _solid(options, terrain, factor)
    limits.set_up_jax(options)
    field = Heightfield(z, terrain.dx, terrain.dy)
    frames = _frames(options, field, base, path, film, terrain.rotation)
    camera, look = frames[0]
    scene = block(field, colours, camera, look, base, SCATTERING[options.material])
    limits.require_memory(scene, local_mesh().size)
    ready, said = prepared(scene, look), "{} x {} pixels".format(*options.size)
    if film:
        _film(output, ready, frames)
        said = f"{len(frames)} frames of {said}"
    else:
        with bar(total=look.samples, unit=" samples", delay=0.5) as shown:
            image = photograph(ready, camera, look, shown.update)
        if options.annotate:
            level = float(np.nanmin(z)) if base is None else base
            caption = _caption(terrain, look, factor)
            save_sheet(output, annotated(bytes_of(image), terrain, camera, level, options.title, caption))
        else:
            save_image(output, image)
    print(f"{output}: {said}, heights x {factor:g}, {time.perf_counter() - begin:.1f} s")


def _solid(options: argparse.Namespace, terrain: Terrain, factor: float) -> tuple[np.ndarray, np.ndarray, float | None]:
    """What `block` takes: the terrain's heights times a factor, with water on them; colours; the floor's level."""
    z = terrain.heights.astype(options.precision)
    if options.drape is not None:
        colours = load_drape(options.drape, terrain)
    else:
        colours = linear_from_srgb(np.arange(256) / 255).astype(np.float32)[color_relief(terrain, options.ramp)]
    sea = options.water is None and options.drape is None and options.ramp is None and has_sea(z)
    water = 0.0 if sea else options.water
    if water is not None:
        low, high = np.nanmin(z), np.nanmax(z)
        if not low <= water < high:
            warnings.warn(f"view: the heights go from {low:.6g} to {high:.6g}, --water is {water:g}", stacklevel=2)
        z, colours = with_water(z, colours, water)
    reach = max((n - 1) * d for n, d in zip(z.shape, (terrain.dy, terrain.dx), strict=True))
    times = (float(np.nanmax(z)) - float(np.nanmin(z))) * factor / reach
    if times > _TALLEST:
        found = f"times {factor:g} it is {times:.3g} times its length high"
        raise UserError(f"view: --exaggeration must leave a terrain at most {_TALLEST} times its length high; {found}")
    if sea and not options.quiet:
        said = "holds wide areas at 0, which are drawn as a sea, as --water 0 does (--ramp overrules)"
        print(f"jaxhf: {options.terrain} {said}", file=sys.stderr)
    z = z * z.dtype.type(factor)
    low, high = np.nanmin(z), np.nanmax(z)
    return z, colours, float(low - max(0.25 * (high - low), 0.02 * reach)) if options.skirt else None


def _frames(
    options: argparse.Namespace, field: Heightfield, base: float | None, path: np.ndarray | None, film: bool, rotation: float
) -> list[tuple[Perspective, Look]]:
    """A camera and a look for each frame: round the terrain, or in a moving sun, whose `path` it is; for a picture one."""
    look = Look(**arguments.given(options, "azimuth", "altitude", "haze"), samples=PRESETS[options.preset])
    look = dataclasses.replace(look, azimuth=look.azimuth - rotation)  # from the y axis
    azimuth = look.azimuth - 110 if options.camera_azimuth is None else options.camera_azimuth - rotation
    around, (width, height) = film and path is None, options.size
    looks = [look] if path is None else [dataclasses.replace(look, azimuth=float(az), altitude=float(alt)) for az, alt in path]
    cameras = [
        Perspective.framing(
            field, azimuth + turn, options.camera_altitude, options.fov, width=width, height=height, base=base, around=around
        )
        for turn in ([360 * k / options.frames for k in range(options.frames)] if around else [0])
    ]
    return [(camera, look) for camera in cameras for look in looks]  # of which one is alone


def _caption(terrain: Terrain, look: Look, factor: float) -> str:
    """What a picture does not show by itself."""
    said = [f"sun from {(look.azimuth + terrain.rotation) % 360:g}°, {look.altitude:g}° high"]
    said += [f"vertical exaggeration {factor:g}"] if factor != 1 else []
    return "; ".join([*said, "scale along the edge beside it"])


def _film(output: Path, ready: Prepared, frames: Sequence[tuple[Perspective, Look]]) -> None:
    """Writes frames of a block that was prepared in the light of the first one."""
    with writing_film(output) as add, bar(total=len(frames), unit=" frames") as shown:
        for camera, look in frames:
            lit = ready if look is frames[0][1] else ready.with_lights(lights(ready.scene.heightfields[0], look))
            add(bytes_of(photograph(lit, camera, look)))
            shown.update()
