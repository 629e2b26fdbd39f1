"""Which keys the tables of a TOML scene take, and what is made of them. `docs/guides/scene-files.md` explains them all."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ...core.errors import ArgumentError
from ...scene.camera import Camera, Orthographic, Perspective
from ...scene.light import Directional, Light, Point, Sky, Sun
from ...scene.material import Material, Matte, Mirror
from .. import procedural
from .values import (
    angle_above_horizon,
    colour,
    grid,
    instant,
    matrix,
    number,
    numbers,
    or_word,
    size,
    steps,
    table,
    table_of_tables,
    tables,
    whole,
    word,
)


class Key(NamedTuple):
    """What a key takes. Without a `default` it must be there; where that is None, the reader decides."""

    kind: Callable[[Any], Any]
    default: Any = ...


Keys = Mapping[str, Key]


def _directional(irradiance, radiance=None, kind: type[Directional] = Directional, **given) -> Directional:
    if irradiance is not None and radiance is not None:
        raise ArgumentError("", "radiance", "must stand without irradiance, whose old name it is")
    irradiance = radiance if irradiance is None else irradiance
    given = {name: value for name, value in given.items() if value is not None}
    ways = [keys for keys in (("towards",), ("azimuth", "altitude"), ("time", "latitude", "longitude")) if given.keys() & keys]
    if len(ways) > 1:
        first, *_ = given.keys() & ways[0]
        raise ArgumentError("", first, f"must stand without {' and '.join(ways[1])}, it says the same")
    if "towards" in given:
        return kind(**given, irradiance=irradiance)
    if "time" in given or "latitude" in given or "longitude" in given:
        for name in ("time", "latitude", "longitude"):
            if name not in given:
                raise ArgumentError("", name, "must be given with time, latitude and longitude, it is missing")
        return kind.at(**given, irradiance=irradiance)
    return kind.from_angles(**given, irradiance=irradiance)


def _point(position, intensity) -> Point:
    return Point(position, intensity)


SCENE: Keys = {
    "samples": Key(whole, 1),
    "camera": Key(table),
    "lights": Key(tables, []),
    "textures": Key(table_of_tables, {}),
    "objects": Key(tables),
}
_VIEW: Keys = {
    "eye": Key(numbers(3)),
    "target": Key(numbers(3)),
    "up": Key(numbers(3), [0.0, 0.0, 1.0]),
    "width": Key(whole, 512),
    "height": Key(whole, 512),
}
CAMERAS: dict[str, tuple[Callable[..., Camera], Keys]] = {
    "perspective": (Perspective.look_at, {**_VIEW, "fov": Key(number, 45.0)}),
    "orthographic": (Orthographic.look_at, {**_VIEW, "extent": Key(number)}),
    "pinhole": (
        Perspective.from_intrinsics,
        {
            **{name: Key(number) for name in ("fx", "fy", "cx", "cy")},
            "world_from_camera": Key(matrix),
            "convention": Key(word, "opencv"),
            **{name: Key(whole) for name in ("width", "height")},
        },
    ),
}
_DIRECTION: Keys = {
    "towards": Key(numbers(3), None),
    "azimuth": Key(number, None),
    "altitude": Key(angle_above_horizon, None),
    "time": Key(instant, None),
    **{name: Key(number, None) for name in ("latitude", "longitude")},
    "irradiance": Key(colour, None),
}
LIGHTS: dict[str, tuple[Callable[..., Light], Keys]] = {
    "directional": (_directional, {**_DIRECTION, "radiance": Key(colour, None)}),  # the old name of irradiance
    "sun": (
        functools.partial(_directional, kind=Sun),
        {**_DIRECTION, "angular_diameter": Key(number, None), "chords": Key(whole, None)},
    ),
    "point": (_point, {"position": Key(numbers(3)), "intensity": Key(colour)}),
    "sky": (Sky, {"radiance": Key(colour), "occlusion": Key(whole, None)}),
}
MATERIALS: dict[str, tuple[Callable[..., Material], Keys]] = {
    "matte": (Matte, {"albedo": Key(or_word(colour, ", or the name of a texture"), 0.7)}),
    "mirror": (Mirror, {"reflectance": Key(colour, 0.9)}),
}

# The parameters of procedural heights and textures, by their names in `procedural.py`.
_PARAMETERS: dict[str, Callable[[Any], Any]] = {
    "size": size,
    **{name: whole for name in ("seed", "count", "lines", "squares")},
    **{name: number for name in ("exponent", "level", "direction", "spread", "radius", "sun_radius", "clouds")},
    **{name: numbers(2) for name in ("range", "lengths", "sun")},
    **{name: colour for name in ("zenith", "horizon", "sun_radiance", "first", "second")},
}


def _parameters(function: Callable[..., Any]) -> Keys:
    given = inspect.signature(function).parameters.values()
    return {p.name: Key(_PARAMETERS[p.name], ... if p.default is p.empty else p.default) for p in given}


TEXTURES = {name: (function, _parameters(function)) for name, function in procedural.TEXTURES.items()}
HEIGHTS: dict[str, Keys] = {
    "jacksboro": {},
    **{name: _parameters(function) for name, function in procedural.HEIGHTS.items()},
}
ORIGINS: dict[str, Keys] = {  # where a heightfield comes from
    "heights": {"heights": Key(grid)},
    "file": {"file": Key(word), "nodata": Key(number, None)},
    "source": {"source": Key(word)},
}
GRID: Keys = {**{name: Key(number, None) for name in ("dx", "dy", "x0", "y0")}, "z_scale": Key(number, 1.0)}
CYLINDER: Keys = {"radius": Key(number, 1.0), "z_min": Key(number, -1.0), "z_max": Key(number, 1.0)}
OBJECT: Keys = {
    "shape": Key(word),
    "material": Key(word, "matte"),
    "transform": Key(steps, None),
    "matrix": Key(matrix, None),
}
