"""Reads scenes in TOML; `scenes/` holds examples.

A scene consists of `samples`, one `[camera]`, any number of `[[lights]]` and `[textures.NAME]`, and at least one of
`[[objects]]`. Which keys these take stands in the tables below; any other key, a value of another type and a file outside the
scene's folder are errors.
"""

import difflib
import inspect
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from .._camera import Camera, Orthographic, Perspective
from .._cylinder import Cylinder
from .._heightfield import Heightfield
from .._light import Directional, Light, Point, Sky
from .._material import Material, Matte, Mirror
from .._scene import Object, Scene, Shape
from .._texture import ImageTexture
from .._transform import require_invertible, rotate, scale, translate
from ._images import PathLike, load_image, require_file
from ._procedural import HEIGHTS, TEXTURES
from ._source import SceneError, nearest, resolve_inside
from ._terrain import jacksboro_file, load_heights

# What a value may be: a function that returns it, or raises ValueError with what it must be.


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(value: Any) -> float:
    if not _is_number(value):
        raise ValueError("a finite number")
    return float(value)


def _a(kind: type, words: str) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        if type(value) is not kind:  # exactly: True is an int
            raise ValueError(words)
        return value

    return check


_whole, _word, _table = _a(int, "a whole number"), _a(str, "a string"), _a(dict, "a table")


def _numbers(count: int) -> Callable[[Any], list[float]]:
    def kind(value: Any) -> list[float]:
        if not isinstance(value, list) or len(value) != count or not all(map(_is_number, value)):
            raise ValueError(f"a list of {count} finite numbers")
        return [float(number) for number in value]

    return kind


def _size(value: Any) -> list[int]:
    if not isinstance(value, list) or len(value) != 2 or not all(type(number) is int for number in value):
        raise ValueError("a list of 2 whole numbers, rows and columns")
    return value


def _colour(value: Any) -> list[float]:
    if _is_number(value):
        return [float(value)] * 3
    if not isinstance(value, list) or len(value) != 3 or not all(map(_is_number, value)):
        raise ValueError("a finite number or a list of 3")
    return [float(number) for number in value]


def _colour_or_name(value: Any) -> list[float] | str:
    if isinstance(value, str):
        return value
    try:
        return _colour(value)
    except ValueError as error:
        raise ValueError(f"{error}, or the name of a texture") from None


def _grid(value: Any) -> np.ndarray:
    if not isinstance(value, list) or not value or not all(isinstance(row, list) and row for row in value):
        raise ValueError("a list of rows of numbers, the southernmost first")
    if len({len(row) for row in value}) > 1:
        raise ValueError(f"a list of rows of one length, theirs are {sorted({len(row) for row in value})}")
    for iy, row in enumerate(value):
        for ix, height in enumerate(row):
            if not _is_number(height):
                raise ValueError(f"made of finite numbers, row {iy} column {ix} is {height!r}")
    return np.array(value, np.float64)


def _steps(value: Any) -> np.ndarray:
    """The product of a list of transforms: as in pbrt, the last of them acts first on a point."""
    if not isinstance(value, list) or not value:
        raise ValueError("a list such as [{translate = [0, 0, 1]}, {rotate = [90, 0, 0, 1]}, {scale = 2}]")
    matrix = np.eye(4)
    for k, step in enumerate(value):
        if not isinstance(step, dict) or len(step) != 1:
            raise ValueError(f"a list of tables with one key each, step {k} is {step!r}")
        ((verb, amount),) = step.items()
        if verb not in _STEPS:
            raise ValueError(f"made of {', '.join(_STEPS)}, step {k} is {verb!r}; {nearest(verb, _STEPS)}")
        kind, function = _STEPS[verb]
        try:
            matrix = matrix @ function(*kind(amount))
        except ValueError as error:
            raise ValueError(f"valid in step {k}: {verb} must be {error}, it is {amount!r}") from error
    return matrix


_STEPS: dict[str, tuple[Callable[[Any], list[float]], Callable[..., np.ndarray]]] = {
    "translate": (_numbers(3), translate),
    "rotate": (_numbers(4), rotate),
    "scale": (_colour, scale),
}


def _matrix(value: Any) -> np.ndarray:
    if not isinstance(value, list) or len(value) != 4:
        raise ValueError("a list of 4 rows of 4 numbers")
    return np.array([_numbers(4)(row) for row in value])


def _tables(value: Any) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise ValueError("a list of tables")
    return value


def _table_of_tables(value: Any) -> dict[str, dict[str, Any]]:
    return {name: _table(item) for name, item in _table(value).items()}


# Which keys there are.


class _Key(NamedTuple):
    """What a key takes. Without a `default` it must be there; where that is None, the reader decides."""

    kind: Callable[[Any], Any]
    default: Any = ...


_Keys = Mapping[str, _Key]


def _directional(towards, azimuth, altitude, radiance) -> Directional:
    if towards is None:
        return Directional.from_angles(315.0 if azimuth is None else azimuth, 45.0 if altitude is None else altitude, radiance)
    if azimuth is not None or altitude is not None:
        raise ValueError("towards must stand without azimuth and altitude, it says the same")
    return Directional(towards, radiance)


def _point(position, intensity) -> Point:
    return Point(position, intensity)


_SCENE: _Keys = {
    "samples": _Key(_whole, 1),
    "camera": _Key(_table),
    "lights": _Key(_tables, []),
    "textures": _Key(_table_of_tables, {}),
    "objects": _Key(_tables),
}
_VIEW: _Keys = {
    "eye": _Key(_numbers(3)),
    "target": _Key(_numbers(3)),
    "up": _Key(_numbers(3), [0.0, 0.0, 1.0]),
    "width": _Key(_whole, 512),
    "height": _Key(_whole, 512),
}
_CAMERAS: dict[str, tuple[Callable[..., Camera], _Keys]] = {
    "perspective": (Perspective.look_at, {**_VIEW, "fov": _Key(_number, 45.0)}),
    "orthographic": (Orthographic.look_at, {**_VIEW, "extent": _Key(_number)}),
}
_LIGHTS: dict[str, tuple[Callable[..., Light], _Keys]] = {
    "directional": (
        _directional,
        {
            "towards": _Key(_numbers(3), None),
            "azimuth": _Key(_number, None),
            "altitude": _Key(_number, None),
            "radiance": _Key(_colour, math.pi),
        },
    ),
    "point": (_point, {"position": _Key(_numbers(3)), "intensity": _Key(_colour)}),
    "sky": (Sky, {"radiance": _Key(_colour)}),
}
_MATERIALS: dict[str, tuple[Callable[..., Material], _Keys]] = {
    "matte": (Matte, {"albedo": _Key(_colour_or_name, 0.7)}),
    "mirror": (Mirror, {"reflectance": _Key(_colour, 0.9)}),
}
_CYLINDER: _Keys = {"radius": _Key(_number, 1.0), "z_min": _Key(_number, -1.0), "z_max": _Key(_number, 1.0)}
_GRID: _Keys = {**{name: _Key(_number, None) for name in ("dx", "dy", "x0", "y0")}, "z_scale": _Key(_number, 1.0)}
_PARAMETERS: dict[str, Callable[[Any], Any]] = {
    "size": _size,
    **{name: _whole for name in ("seed", "count", "lines", "squares")},
    **{name: _number for name in ("exponent", "level", "direction", "spread", "radius", "sun_radius", "clouds")},
    **{name: _numbers(2) for name in ("range", "lengths", "sun")},
    **{name: _colour for name in ("zenith", "horizon", "sun_radiance", "first", "second")},
}


def _parameters(function: Callable[..., Any]) -> _Keys:
    given = inspect.signature(function).parameters.values()
    return {p.name: _Key(_PARAMETERS[p.name], ... if p.default is p.empty else p.default) for p in given}


_HEIGHTS: dict[str, _Keys] = {"jacksboro": {}, **{name: _parameters(function) for name, function in HEIGHTS.items()}}
_TEXTURES: dict[str, _Keys] = {name: _parameters(function) for name, function in TEXTURES.items()}
_SURFACE: dict[str, _Keys] = {  # where a heightfield comes from
    "heights": {"heights": _Key(_grid)},
    "file": {"file": _Key(_word), "nodata": _Key(_number, None)},
    "source": {"source": _Key(_word)},
}
_PLACE: _Keys = {
    "shape": _Key(_word),
    "material": _Key(_word, "matte"),
    "transform": _Key(_steps, None),
    "matrix": _Key(_matrix, None),
}

# From the file to the scene.

_Where = tuple[str | int, ...]  # ("objects", 0, "heights")


class _File(NamedTuple):
    """What every part of the reader needs to know."""

    path: Path
    lines: dict[_Where, int]
    dtype: np.dtype

    def error(self, where: _Where, message: str) -> SceneError:
        line = next((self.lines[where[:k]] for k in range(len(where), 0, -1) if where[:k] in self.lines), None)
        return SceneError(self.path, line, message)

    def open(self, name: str) -> Path:
        return resolve_inside(self.path.parent, self.path.parent, name)


def load_toml(path: PathLike, dtype: DTypeLike = np.float32) -> Scene:
    """Reads a scene.

    Args:
      path: a .toml file; the files that it names lie in its folder or below.
      dtype: of the heights, and thereby the precision of the picture.

    Raises:
      FileNotFoundError: `path` is not there.
      SceneError: anything is wrong in it; with its line.
    """
    path = require_file(path)
    text = ""
    try:
        text = path.read_text(encoding="utf-8")
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).partition(" (at ")
        at = re.match(r"line (\d+)", place)
        raise SceneError(path, int(at[1]) if at else len(text.splitlines()), f"this is not TOML: {message}") from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise SceneError(path, None, f"this is not TOML: {error}") from error
    return _scene(_File(path, _line_numbers(text), np.dtype(dtype)), content)


def _scene(file: _File, content: dict[str, Any]) -> Scene:
    values = _read(file, (), content, _SCENE)
    textures = {name: _texture(file, ("textures", name), table) for name, table in values["textures"].items()}
    parts = {
        "camera": _variant(file, ("camera",), values["camera"], _CAMERAS),
        "lights": [_variant(file, ("lights", k), table, _LIGHTS) for k, table in enumerate(values["lights"])],
        "objects": [_object(file, ("objects", k), table, textures) for k, table in enumerate(values["objects"])],
    }
    return _made(file, (), content, Scene, samples=values["samples"], **parts)


def _variant(
    file: _File, where: _Where, table: dict[str, Any], variants: Mapping[str, tuple[Callable[..., Any], _Keys]]
) -> Any:
    """A camera or a light, by its `type`."""
    function, keys = variants[_choice(file, where, table, "type", variants)]
    values = _read(file, where, table, {"type": _Key(_word), **keys})
    del values["type"]
    return _made(file, where, table, function, **values)


def _texture(file: _File, where: _Where, table: dict[str, Any]) -> ImageTexture:
    if _one_of(file, where, table, ("image", "source"), {"size"}.union(*_TEXTURES.values())) == "image":
        name = _read(file, where, table, {"image": _Key(_word)})["image"]
        # An image starts at its top, a texture at v = 0: so it lies on a map with the north up.
        return _made(file, (*where, "image"), {}, lambda: ImageTexture(load_image(file.open(name))[::-1]))
    source = _choice(file, where, table, "source", _TEXTURES)
    values = _read(file, where, table, {"source": _Key(_word), **_TEXTURES[source]})
    del values["source"]
    return _made(file, where, table, lambda: ImageTexture(TEXTURES[source](**values)))


def _object(file: _File, where: _Where, table: dict[str, Any], textures: dict[str, ImageTexture]) -> Object:
    shape = _choice(file, where, table, "shape", _SHAPES)
    make_material, material_keys = _MATERIALS[_choice(file, where, table, "material", _MATERIALS, "matte")]
    common: _Keys = {**_PLACE, **material_keys}
    make_shape, shape_keys = _SHAPES[shape](file, where, table, common)
    values = _read(file, where, table, {**common, **shape_keys})
    world = _world_from_object(file, where, values)
    paint = {name: _painted(file, (*where, name), values[name], textures) for name in material_keys}
    material = _made(file, where, table, make_material, **paint)
    return Object(_made(file, where, table, make_shape, {name: values[name] for name in shape_keys}), material, world)


def _world_from_object(file: _File, where: _Where, values: dict[str, Any]) -> np.ndarray | None:
    given = [name for name in ("transform", "matrix") if values[name] is not None]
    if not given:
        return None
    if len(given) > 1:
        raise file.error((*where, "matrix"), f"{_named(where)} must have transform or matrix, it has both")
    place = (*where, given[0])
    _made(file, place, {}, require_invertible, _named(place), values[given[0]])
    return values[given[0]]


def _painted(file: _File, where: _Where, value: Any, textures: dict[str, ImageTexture]) -> Any:
    """A colour, or the texture whose name stands in its place."""
    if isinstance(value, str) and value not in textures:
        tail = nearest(value, textures) if textures else "the scene has none"
        raise file.error(where, f"{_named(where)}: there is no texture {value!r}; {tail}")
    return textures[value] if isinstance(value, str) else value


Made = tuple[Callable[[dict[str, Any]], Shape], _Keys]


def _cylinder(file: _File, where: _Where, table: dict[str, Any], common: _Keys) -> Made:
    return (lambda values: Cylinder(**values)), _CYLINDER


def _heightfield(file: _File, where: _Where, table: dict[str, Any], common: _Keys) -> Made:
    known = {*common, *_GRID, "nodata"}.union(*_HEIGHTS.values())
    origin = _one_of(file, where, table, tuple(_SURFACE), known)
    keys: _Keys = {**_SURFACE[origin], **_GRID}
    if origin == "source":
        keys = {**keys, **_HEIGHTS[_choice(file, where, table, "source", _HEIGHTS)]}
    from_file = origin == "file" or table.get("source") == "jacksboro"
    make = _loaded if from_file else _generated
    return (lambda values: make(file, (*where, origin), values)), keys


_SHAPES = {"heightfield": _heightfield, "cylinder": _cylinder}


def _loaded(file: _File, where: _Where, values: dict[str, Any]) -> Heightfield:
    def load():
        path = file.open(values["file"]) if "file" in values else jacksboro_file()
        return load_heights(path, nodata=values.get("nodata"), **{name: values[name] for name in _GRID})

    terrain = _made(file, where, {}, load)
    return Heightfield(_fitted(terrain.heights, file.dtype), terrain.dx, terrain.dy, terrain.x0, terrain.y0)


def _generated(file: _File, where: _Where, values: dict[str, Any]) -> Heightfield:
    if values["z_scale"] == 0:
        raise ValueError("z_scale must not be zero, it is 0")
    source = values.get("source")
    heights = HEIGHTS[source](**{name: values[name] for name in _HEIGHTS[source]}) if source else values["heights"]
    placement = {name: values[name] for name in ("dx", "dy", "x0", "y0") if values[name] is not None}
    return Heightfield(_fitted(heights * values["z_scale"], file.dtype), **placement)


def _fitted(heights: np.ndarray, dtype: np.dtype) -> np.ndarray:
    with np.errstate(over="ignore"):
        fitted = heights.astype(dtype)
    if np.isinf(fitted).any():  # it would count as a hole
        raise ValueError(f"heights must fit into {dtype}, the largest is {np.nanmax(np.abs(heights)):.3g}")
    return fitted


# Checks, each of which ends with the line on which things went wrong.


def _named(where: _Where) -> str:
    """("objects", 0, "dx") as a reader of the file says it: objects[0].dx."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in where).lstrip(".")


def _read(file: _File, where: _Where, table: dict[str, Any], keys: _Keys) -> dict[str, Any]:
    """The values of all `keys`, by their kinds; SceneError on any other key, and on one that is missing."""
    _require_known(file, where, table, keys)
    values = {}
    for name, key in keys.items():
        if name not in table:
            if key.default is ...:
                raise file.error(where, f"{_named(where) or 'a scene'} must have {name!r}, it is missing")
            values[name] = key.default
            continue
        try:
            values[name] = key.kind(table[name])
        except (ValueError, OverflowError) as error:
            shown = repr(table[name])
            shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
            raise file.error((*where, name), f"{_named((*where, name))} must be {error}, it is {shown}") from error
    return values


def _require_known(file: _File, where: _Where, table: dict[str, Any], known: Iterable[str]) -> None:
    for name in table:
        if name not in known:
            inside = f" in {_named(where)}" if where else ""
            raise file.error((*where, name), f"unknown key {name!r}{inside}; {nearest(name, known)}")


def _choice(
    file: _File, where: _Where, table: dict[str, Any], name: str, options: Iterable[str], default: str | None = None
) -> str:
    value = table.get(name, default)
    if value is None:
        for meant in difflib.get_close_matches(name, table, n=1):
            _require_known(file, where, {meant: None}, (name,))
        raise file.error(where, f"{_named(where)} must have {name!r}, one of {', '.join(options)}; it is missing")
    if value not in tuple(options):
        tail = f"; {nearest(value, options)}" if isinstance(value, str) else ""
        message = f"{_named((*where, name))} must be one of {', '.join(options)}; it is {value!r}{tail}"
        raise file.error((*where, name), message)
    return value


def _one_of(file: _File, where: _Where, table: dict[str, Any], names: tuple[str, ...], others: Iterable[str]) -> str:
    """Which of `names` the table has: exactly one. Where it has none, a key outside `others` is taken for a slip of it."""
    present = [name for name in names if name in table]
    if not present:
        _require_known(file, where, table, {*names, *others})
    if len(present) != 1:
        has = f"it has {' and '.join(present)}" if present else "it has none"
        raise file.error((*where, *present[1:2]), f"{_named(where)} must have exactly one of {', '.join(names)}; {has}")
    return present[0]


def _made(file: _File, where: _Where, table: dict[str, Any], function: Callable[..., Any], *args: Any, **values: Any) -> Any:
    """function(*args, **values); its ValueError becomes a SceneError, on the line of the key that its message names."""
    try:
        return function(*args, **values)
    except SceneError:
        raise
    except (ValueError, FileNotFoundError) as error:
        message = str(error)
        named = re.match(r"(?:\w+: )?(\w+) (?=must|may)", message)
        if named and named[1] in table:
            where = (*where, named[1])
            message = f"{_named(where)} {message[named.end() :]}"
        elif where and not message.startswith(_named(where)):
            message = f"{_named(where)}: {message}"
        raise file.error(where, message) from error


# tomllib does not tell on which line a key stood; the text is valid TOML by the time this looks at it.

_TOKEN = re.compile(
    r"""(?P<string>\"{3}(?:\\.|[^\\])*?\"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*')"""
    r"""|(?P<comment>\#[^\n]*)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<newline>\n)|(?P<other>.)""",
    re.DOTALL,
)


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Each header and each key with its value, comments removed, and the line on which it starts."""
    line, start, depth, statement = 1, 1, 0, ""
    for token in _TOKEN.finditer(text + "\n"):
        kind, found = token.lastgroup, token.group()
        if kind == "newline" and depth == 0:
            if statement.strip():
                yield start, statement.strip()
            start, statement = line + 1, ""
        elif kind != "comment":
            statement += found
        depth += (kind == "open") - (kind == "close")
        line += found.count("\n")


def _line_numbers(text: str) -> dict[_Where, int]:
    """The line of every table, and of every key that is not inside an inline table."""
    lines: dict[_Where, int] = {}
    counts: dict[_Where, int] = {}  # of the elements of each [[array of tables]] so far
    here: _Where = ()
    for line, statement in _statements(text):
        header = re.fullmatch(r"(\[\[?)(.*?)\]\]?", statement, re.DOTALL)
        names = _key_names(header[2] if header else statement)
        if not header:
            lines.setdefault((*here, *names), line)
            continue
        here = ()
        for k, name in enumerate(names, 1):
            here = (*here, name)
            if header[1] == "[[" and k == len(names):
                counts[here] = counts.get(here, 0) + 1
            lines.setdefault(here, line)
            if here in counts:
                here = (*here, counts[here] - 1)
        lines.setdefault(here, line)
    return lines


def _key_names(text: str) -> list[str]:
    """The parts of a dotted key at the beginning of `text`."""
    names, at = [], re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([\w-]+))\s*(\.?)""")
    found = at.match(text)
    while found:
        names.append(next(part for part in found.groups()[:3] if part is not None))
        found = at.match(text, found.end()) if found[4] else None
    return names
