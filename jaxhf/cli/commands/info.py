"""`jaxhf info`: what a scene or a terrain file holds, in words."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import counted
from ...io.files import by_ending
from ...io.terrain.georeference import Georeference, coordinate_system, corners_said
from ...io.terrain.load import ENDINGS, read_terrain
from ...io.terrain.terrain import Terrain

if TYPE_CHECKING:  # with JAX, which a terrain does without
    from ...scene.heightfield import Heightfield
    from ...scene.scene import Scene


def run(options: argparse.Namespace) -> None:
    of_scene = dict.fromkeys((".toml", ".pbrt"), True)
    if not by_ending({**dict.fromkeys(ENDINGS, False), **of_scene}, Path(options.file), "describe"):
        print("\n".join(_terrain_lines(options.file, read_terrain(options.file))))
        return
    from ...io.scenes.load import load_scene
    from ..scene_warnings import warn

    scene = load_scene(options.file)
    print(f"{options.file}: {scene.camera.width} x {scene.camera.height} pixels, {counted(scene.samples, 'sample')} a pixel")
    print("\n".join(_scene_lines(scene)))
    warn([scene])


def _scene_lines(scene: "Scene") -> Iterator[str]:
    """A line for the camera, and one for each object and light."""
    from ...scene.heightfield import Heightfield

    eye = np.asarray(scene.camera.world_from_camera)[:3, 3]
    yield f"camera: {type(scene.camera).__name__}, at {_numbers(eye)}"
    for k, obj in enumerate(scene.objects):
        what = heightfield_line(obj.shape) if isinstance(obj.shape, Heightfield) else repr(obj.shape)
        place = "" if obj.world_from_object is None else ", with a transform"
        yield f"object {k}: {what}, {_material(obj.material)}{place}"
    for k, light in enumerate(scene.lights):
        values = ", ".join(f"{name} {_numbers(value)}" for name, value in vars(light).items() if value is not None)
        yield f"light {k}: {type(light).__name__}, {values}"


def _terrain_lines(path: str, terrain: Terrain) -> Iterator[str]:
    """Size, spacing, place, reference system and range of a terrain in its file's own coordinates."""
    ny, nx = terrain.heights.shape
    yield f"{path}: {ny} rows, {nx} columns of {terrain.heights.dtype}"
    place = terrain.georeference or Georeference()
    crs = coordinate_system(place.wkt) if place.wkt else terrain.crs
    dx, dy, x0, y0 = terrain.in_file
    if crs is None and (dx, dy, x0, y0) == (1, 1, 0, 0):
        yield "cells: not in the file, taken as 1 x 1"
    else:
        metres = ""
        if crs is not None and crs.degrees and crs.globe is not None:
            local = terrain.in_metres()
            metres = f", in the middle {local.dx:.6g} x {local.dy:.6g} metres"
        yield f"cells: {dx:.9g} x {dy:.9g}{place.unit and ' '}{place.unit}{metres}"
        x, y = ("longitude", "latitude") if crs is not None and crs.degrees else ("x", "y")
        if terrain.rotation:
            yield f"place: {corners_said((x0, y0), (dx, dy), (nx, ny), terrain.rotation)}"
        else:
            yield f"place: {x} {x0:.10g} to {x0 + (nx - 1) * dx:.10g}, {y} {y0:.10g} to {y0 + (ny - 1) * dy:.10g}"
    code = f" (EPSG:{crs.code})" if crs is not None and crs.code else ""
    yield f"system: {place.name or 'not known'}{code}"
    holes = int(np.count_nonzero(np.isnan(terrain.heights)))
    share = f", {counted(holes, 'hole')} ({100 * holes / terrain.heights.size:.3g} %)" if holes else ", no holes"
    stored = f", stored as {place.nodata:.10g}" if holes and place.nodata is not None else ""
    lowest, highest = np.fmin.reduce(terrain.heights, axis=None), np.fmax.reduce(terrain.heights, axis=None)
    span = "none" if holes == terrain.heights.size else f"{lowest:.7g} to {highest:.7g}"
    yield f"heights: {span}{place.height_unit and ' '}{place.height_unit}{share}{stored}"


def heightfield_line(field: "Heightfield | Terrain") -> str:
    heights = np.asarray(field.heights)
    ny, nx = heights.shape
    finite = heights[np.isfinite(heights)]
    span = _numbers([finite.min(), finite.max()]) if finite.size else "none"
    holes = f", {counted(heights.size - finite.size, 'hole')}" if finite.size < heights.size else ""
    return (
        f"Heightfield, {ny} x {nx} heights, cells {field.dx:.6g} x {field.dy:.6g}, "
        f"origin {_numbers([field.x0, field.y0])}, range {span}{holes}"
    )


def _material(material: Any) -> str:
    from ...scene.texture import ImageTexture

    (name, value), *_ = vars(material).items()
    what = (
        f"an image of {value.texels.shape[1]} x {value.texels.shape[0]}" if isinstance(value, ImageTexture) else _numbers(value)
    )
    return f"{type(material).__name__.lower()}, {name} {what}"


def _numbers(values: Any) -> str:
    return "(" + ", ".join(f"{float(value):.6g}" for value in np.ravel(values)) + ")"
