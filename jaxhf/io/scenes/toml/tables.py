"""Which keys the tables of a TOML scene take, and what is made of them. `docs/guides/scene-files.md` explains them all."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ....core.errors import ArgumentError
from ....scene import procedural
from ....scene.camera import Camera, Orthographic, Perspective
from ....scene.cylinder import Cylinder
from ....scene.light import Directional, Light, Point, Sky, Sun
from ....scene.material import SCATTERING, Hapke, Material, Matte, Mirror
from . import values as kinds


class Key(NamedTuple):
    """What a key takes, and whether it must be there."""

    kind: kinds.Kind
    needed: bool = False


Keys = dict[str, Key]


def optional(*names: str, kind: kinds.Kind | None = None) -> Keys:
    """Keys that may be missing, of one kind or, where that is None, of those that their names say."""
    return {name: Key(kind or _KINDS[name]) for name in names}


def _directional(kind: type[Directional] = Directional, **given) -> Directional:
    ways = [keys for keys in (("towards",), ("azimuth", "altitude"), ("time", "latitude", "longitude")) if given.keys() & keys]
    if len(ways) > 1:
        first, *_ = given.keys() & ways[0]
        raise ArgumentError("", first, f"must stand without {' and '.join(ways[1])}, it says the same")
    if "towards" in given:
        return kind(**given)
    if "time" in given or "latitude" in given or "longitude" in given:
        for name in ("time", "latitude", "longitude"):
            if name not in given:
                raise ArgumentError("", name, "must be given with time, latitude and longitude, it is missing")
        return kind.at(**given)
    return kind.from_angles(**given)


def _point(position, intensity) -> Point:
    return Point(position, intensity)


# What each parameter takes of the functions and classes that make the parts of a scene.
_KINDS: Mapping[str, kinds.Kind] = {
    **dict.fromkeys(("albedo", "w"), kinds.colour_or_texture),
    "altitude": kinds.angle_above_horizon,
    "convention": kinds.word,
    "size": kinds.size,
    "time": kinds.instant,
    "world_from_camera": kinds.matrix,
    **dict.fromkeys(("eye", "target", "up", "towards", "position"), kinds.numbers(3)),
    **dict.fromkeys(("range", "lengths", "sun"), kinds.numbers(2)),
    **dict.fromkeys(("width", "height", "chords", "occlusion", "seed", "count", "lines", "squares"), kinds.whole),
    **dict.fromkeys(("fov", "extent", "fx", "fy", "cx", "cy"), kinds.number),
    **dict.fromkeys(("azimuth", "latitude", "longitude", "angular_diameter", "radius", "z_min", "z_max"), kinds.number),
    **dict.fromkeys(("limb", "k", "roughness", "b", "c", "opposition"), kinds.number),
    **dict.fromkeys(("exponent", "level", "direction", "spread", "sun_radius", "clouds"), kinds.number),
    **dict.fromkeys(("irradiance", "intensity", "radiance", "reflectance"), kinds.colour),
    **dict.fromkeys(("zenith", "horizon", "sun_radiance", "first", "second"), kinds.colour),
}


def _keys(function: Callable[..., Any], *needed: str) -> Keys:
    """The parameters of a function; those without a default are needed, too."""
    given = inspect.signature(function).parameters.values()
    kinds_of = {**_KINDS, "width": kinds.number} if function is Hapke else _KINDS  # of pictures a whole number
    return {p.name: Key(kinds_of[p.name], p.name in needed or p.default is p.empty) for p in given}


SCENE: Keys = {
    "samples": Key(kinds.whole),
    "camera": Key(kinds.table, needed=True),
    "lights": Key(kinds.tables),
    "textures": Key(kinds.table_of_tables),
    "objects": Key(kinds.tables, needed=True),
}
CAMERAS: dict[str, tuple[Callable[..., Camera], Keys]] = {
    "perspective": (Perspective.look_at, _keys(Perspective.look_at)),
    "orthographic": (Orthographic.look_at, _keys(Orthographic.look_at, "extent")),
    "pinhole": (Perspective.from_intrinsics, _keys(Perspective.from_intrinsics)),
}
_DIRECTION = optional("towards", "azimuth", "altitude", "time", "latitude", "longitude", "irradiance")
LIGHTS: dict[str, tuple[Callable[..., Light], Keys]] = {
    "directional": (_directional, _DIRECTION),
    "sun": (functools.partial(_directional, kind=Sun), {**_DIRECTION, **optional("angular_diameter", "chords")}),
    "point": (_point, _keys(_point)),
    "sky": (Sky, _keys(Sky)),
}
_MATTE = functools.partial(Matte, albedo=0.7)
MATERIALS: dict[str, tuple[Callable[..., Material | Mirror], Keys]] = {
    **{name: (kind, _keys(kind)) for name, kind in SCATTERING.items()},
    "matte": (_MATTE, _keys(_MATTE)),
    "mirror": (Mirror, _keys(Mirror)),
}
TEXTURES = {name: (function, _keys(function)) for name, function in procedural.TEXTURES.items()}
HEIGHTS: dict[str, Keys] = {
    "jacksboro": {},
    **{name: _keys(function) for name, function in procedural.HEIGHTS.items()},
}
ORIGINS: dict[str, Keys] = {  # where a heightfield comes from
    "heights": optional("heights", kind=kinds.grid),
    "file": {**optional("file", kind=kinds.word), **optional("nodata", kind=kinds.number)},
    "source": optional("source", kind=kinds.word),
}
GRID: Keys = {**optional("dx", "dy", "x0", "y0", "z_scale", kind=kinds.number), **optional("around", kind=kinds.flag)}
CYLINDER = _keys(Cylinder)
OBJECT: Keys = {
    **optional("shape", "material", kind=kinds.word),
    **optional("transform", kind=kinds.steps),
    **optional("matrix", kind=kinds.matrix),
}
