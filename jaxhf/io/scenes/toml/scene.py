"""Reads scenes in TOML; `docs/guides/scene-files.md` describes them, `scenes/` holds examples.

Which keys there are stands in `tables.py`; any other key, a value of another type and a file outside the scene's folder
are errors.
"""

import functools
import re
import tomllib
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Float32
from numpy.typing import DTypeLike

from ....core.affine import invertible
from ....core.errors import ArgumentError
from ....core.precision import fitted
from ....core.rules import require
from ....scene import procedural
from ....scene.camera import Camera
from ....scene.cylinder import Cylinder
from ....scene.heightfield import Heightfield
from ....scene.light import Light
from ....scene.nested import nested
from ....scene.scene import Object, Scene
from ....scene.texture import ImageTexture, Wrap
from ...errors import SceneError, nearest
from ...pictures.images import TRANSFERS, load_image
from ...terrain.load import jacksboro_file, read_terrain
from ...terrain.terrain import Terrain
from .checks import Part
from .priors import Provenance
from .tables import CAMERAS, CYLINDER, GRID, HEIGHTS, LIGHTS, MATERIALS, OBJECT, ORIGINS, SCENE, TEXTURES, Key, Keys, optional
from .values import word


def load_toml(path: Path, dtype: DTypeLike = np.float32) -> Scene:
    """The scene that a .toml file describes; arguments and errors as those of `load_scene`."""
    part = open_toml(path)
    samples = read_samples(part)
    camera = read_camera(part.at("camera"))
    objects, lights, _ = read_world(part, np.dtype(dtype))
    return part.made(Scene, objects, camera, lights, samples)


def open_toml(path: Path) -> Part:
    """The outermost table of a file; SceneError where it is not TOML."""
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
    return Part(path, text, (), content)


def read_samples(part: Part) -> int:
    """The samples of a scene, with all of its outermost table checked."""
    for name in ("pictures", "fit"):
        if name in part.table:
            raise part.at(name).error(f"{name!r} makes this a fit file, for `jaxhf fit`; a scene has no such table")
    return part.read(SCENE).get("samples", 1)


def read_world(part: Part, dtype: np.dtype) -> tuple[list[Object], list[Light], Provenance]:
    """The objects of a scene with its textures, its lights, and where the first heightfield is from."""
    textures = {name: _texture(part.at("textures", name)) for name in part.table.get("textures", {})}
    objects = _nested(part.all("objects"), [_object(item, textures, dtype) for item in part.all("objects")])
    known = [field for _, field in objects if field is not None]
    terrain = next((field.stored for field in known if field.stored), None)
    return [item for item, _ in objects], read_lights(part, terrain), known[0] if known else Provenance()


def read_camera(part: Part) -> Camera:
    return _variant(part, "type", CAMERAS)


def read_lights(part: Part, terrain: Terrain | None) -> list[Light]:
    """The lights in the list `lights` of `part`; those by date alone stand where they do over the terrain."""
    return [_light(light, terrain) for light in part.all("lights")]


def _light(part: Part, terrain: Terrain | None) -> Light:
    if "time" in part.table and part.table.keys().isdisjoint(("latitude", "longitude")):
        if terrain is None:
            raise part.must("have latitude and longitude, there is no terrain file whose place they could be")
        latitude, longitude = part.made(lambda: terrain.place)
        part = part._replace(table={**part.table, "latitude": latitude, "longitude": longitude})
    return _variant(part, "type", LIGHTS)


def _variant(part: Part, key: str, variants: Any) -> Any:
    """What the function makes that the value of `key` chooses from `variants`."""
    function, keys = variants[part.choice(key, variants)]
    values = part.read({key: Key(word), **keys})
    del values[key]
    return part.made(function, **values)


def _texture(part: Part) -> ImageTexture:
    if part.one_of(("image", "source"), {key for _, keys in TEXTURES.values() for key in keys}) == "source":
        return ImageTexture(_variant(part, "source", TEXTURES))
    part.read(optional("image", "transfer", "wrap", kind=word))
    image, wrap = read_image(part), part.choice("wrap", get_args(Wrap), "repeat")
    # An image starts at its top, a texture at v = 0: so it lies on a map with the north up.
    return part.at("image").made(ImageTexture, image[::-1], wrap=wrap)


def read_image(part: Part) -> Float32[np.ndarray, "h w 3"]:
    """The picture that a table names; it may say what the whole numbers in it are, see `load_image`."""
    transfer = part.choice("transfer", TRANSFERS) if "transfer" in part.table else None
    return part.file("image", functools.partial(load_image, transfer=transfer))


def _object(part: Part, textures: dict[str, ImageTexture], dtype: np.dtype) -> tuple[Object, Provenance | None]:
    is_field = part.choice("shape", ("heightfield", "cylinder")) == "heightfield"
    make_material, material_keys = MATERIALS[part.choice("material", MATERIALS, "matte")]
    common: Keys = {**OBJECT, **material_keys}
    values = part.read({**common, **(_field_keys(part, common) if is_field else CYLINDER)})
    given = part.at_most_one("transform", "matrix")
    world = values[given] if given else None
    if given:
        part.made(require, "", given, world, invertible)
    paint = {name: _painted(part.at(name), values[name], textures) for name in material_keys & values.keys()}
    material = part.made(make_material, **paint)
    if is_field:
        shape, known = part.made(_heightfield, part, values, dtype)
    else:
        shape, known = part.made(Cylinder, **{name: values[name] for name in CYLINDER & values.keys()}), None
    return Object(shape, material, world), known


def _nested(parts: list[Part], made: list[tuple[Object, Provenance | None]]) -> list[tuple[Object, Provenance | None]]:
    """The objects, those that go `around` a heightfield before them fitted to that."""
    begins = [k for k, part in enumerate(parts) if not part.table.get("around")]
    if parts and begins[:1] != [0]:
        raise parts[0].at("around").must("stand below another heightfield, it is the first")
    for begin, end in zip(begins, [*begins[1:], len(parts)], strict=True):
        if end - begin == 1:
            continue
        place, objects, known = parts[begin + 1].at("around"), *zip(*made[begin:end], strict=True)
        if any(field is None for field in known):
            raise place.must("stand below a heightfield, there it is below a cylinder")
        for part, field in zip(parts[begin:end], known, strict=True):
            crs = field.stored and field.stored.crs
            if crs and crs.degrees and not {"x0", "y0"} <= part.table.keys():
                raise place.must(f"go with files in metres, {part.name} is in degrees (gdalwarp projects it)")
            if part is not parts[begin] and (given := part.at_most_one("transform", "matrix")):
                raise part.at(given).must(f"stand without around: it has that of {parts[begin].name}")
        fields = place.made(nested, *(item.shape for item in objects))
        made[begin:end] = [
            (Object(field, item.material, objects[0].world_from_object), before.seen_by(field))
            for field, item, before in zip(fields, objects, known, strict=True)
        ]
    return made


def _painted(part: Part, value: Any, textures: dict[str, ImageTexture]) -> Any:
    """A colour, or the texture whose name stands in its place."""
    if isinstance(value, str) and value not in textures:
        tail = nearest(value, textures) if textures else "the scene has none"
        raise part.error(f"{part.name}: there is no texture {value!r}; {tail}")
    return textures[value] if isinstance(value, str) else value


def _field_keys(part: Part, common: Keys) -> Keys:
    """The keys of this heightfield, beside the `common` ones: they depend on where it comes from."""
    origin = part.one_of(ORIGINS, {*common, *GRID, "nodata"}.union(*HEIGHTS.values()))
    source = HEIGHTS[part.choice("source", HEIGHTS)] if origin == "source" else {}
    return {**ORIGINS[origin], **GRID, **source}


def _heightfield(part: Part, values: dict[str, Any], dtype: np.dtype) -> tuple[Heightfield, Provenance]:
    z_scale, source = values.get("z_scale", 1.0), values.get("source")
    if z_scale == 0:
        raise ArgumentError("", "z_scale", "must not be zero, it is 0")
    grid = {name: values[name] for name in ("dx", "dy", "x0", "y0") if name in values}
    if "file" in values or source == "jacksboro":

        def load(path: Path | None = None) -> Provenance:
            stored = read_terrain(path or jacksboro_file(), z_scale, values.get("nodata"))
            stored.require_unrotated("a scene's terrain")
            like = path if path and not grid and path.suffix.lower() in (".tif", ".tiff") else None
            return Provenance(stored.in_metres(**grid), stored, path, like, z_scale, values.get("nodata"))

        known = part.at("source").made(load) if source else part.file("file", load)
        return known.placed.heightfield(dtype), known
    chosen = {name: values[name] for name in HEIGHTS[source] & values.keys()} if source else {}
    heights = procedural.HEIGHTS[source](**chosen) if source else values["heights"]
    field = Heightfield(fitted(heights * z_scale, dtype), **grid)
    return field, Provenance.of(field, grid, z_scale)
