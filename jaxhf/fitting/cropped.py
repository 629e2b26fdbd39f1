"""A part of a terrain and of its pictures, for a fit of that part within the terrain that goes on around it."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from ..core.settings import Settings
from ..preparation.localise import localise
from ..rendering.render import render
from ..scene.camera import cropped as cropped_camera
from ..scene.heightfield import Heightfield
from ..scene.light import Directional, Point, Sky, Sun
from ..scene.material import Mirror, map_textures
from ..scene.scene import Object, Scene
from ..scene.texture import ImageTexture
from .model.unknowns import Window

_MARGIN = 2  # cells from the rim, where normals lack their neighbours; and pixels that a moving rim may come to
_STEP = 16  # pixels, of which the sides of a part of a picture are a multiple
_COARSENING = 1.4  # by which a part of a picture may be too large along a side, so that it shares programs with others

ndimage: Any = scipy.ndimage  # whose stubs miss much


class Seen(NamedTuple):
    """A part of a picture that shows a window: a scene with the window as its first heightfield and the terrain around it as
    its last object, target and weight of each pixel, 0 where it shows something else, and the picture's number among all."""

    scene: Scene
    target: Float[np.ndarray, "h w *c"]
    weight: Float[np.ndarray, "h w *c"]
    number: int


def surroundings(scenes: Sequence[Scene], heights: tuple[float, float], windows: Sequence[Window]) -> list[Window]:
    """For each window of a terrain the part of it that may hide the window from a light or a camera, all of one size.

    Beyond it all rays from the window to lights and cameras are above the highest height. Where light comes from all around, or
    a mirror shows any place, it is the whole terrain. `heights`: the lowest and the highest that it may have, in its own frame.
    """
    field = scenes[0].heightfields[0]
    shape, steps = np.array(field.heights.shape), np.array([field.dy, field.dx])
    low, high = heights
    ends = []  # of each window: first and last row and column
    for window in windows:
        rows, columns = (window.y, window.y + window.ny - 1), (window.x, window.x + window.nx - 1)
        corners = np.array(list(itertools.product(rows, columns)))
        rays = [end / steps for scene in scenes for end in _ends_of_rays(scene, corners * steps, low, high)]
        reached = np.concatenate([corners, *rays])
        ends.append([reached.min(0), reached.max(0)])
    first, last = np.moveaxis(np.array(ends), 1, 0)
    first, last = (np.clip(found, 0, shape - 1) for found in (np.floor(first) - _MARGIN, np.ceil(last) + _MARGIN))
    size = (last - first).max(0).astype(int) + 1
    first = np.minimum(first, shape - size).astype(int)
    return [Window(y, x, *size.tolist()) for y, x in first.tolist()]


def _ends_of_rays(
    scene: Scene, starts: Float[np.ndarray, "n 2"], low: float, high: float
) -> Iterator[Float[np.ndarray, "n 2"]]:
    """Where rays from places at the lowest height come above the highest on their way to each light and to the camera;
    infinitely far off where they never do. Places are y and x from the terrain's first height on, in its own frame."""
    local = localise(scene)
    world = local.objects[scene.first_heightfield].world_from_object
    to_object = np.linalg.inv(np.eye(4) if world is None else np.asarray(world, np.float64))
    mirrors = any(isinstance(obj.material, Mirror) for obj in local.objects)
    for source in (local.camera, *local.lights):
        if isinstance(source, Sky) and source.occlusion is None:
            continue
        if mirrors or isinstance(source, Sky | Sun):
            yield np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
            continue
        if isinstance(source, Directional | Point):
            at_place = isinstance(source, Point)
            there: Any = source.p if isinstance(source, Point) else source.towards
        else:
            there, at_place = source.viewpoint()
        x, y, z = to_object[:3, :3] @ np.asarray(there, np.float64) + (to_object[:3, 3] if at_place else 0)
        if at_place:
            share = min(1.0, (high - low) / (z - low)) if z > low else 1.0
            yield starts + share * (np.array([y, x]) - starts)
        elif z > 0:
            yield starts + (high - low) / z * np.array([y, x])
        else:
            yield starts + np.where(np.array([y, x]) == 0, 0, np.copysign(np.inf, [y, x]))


_Sides = tuple[list[int], list[int]]
"""Numbers of rows, and of columns, that parts of pictures have; ascending."""


def sides_in_sight(
    scenes: Sequence[Scene], terrain: Float[np.ndarray, "my mx"], off: float, windows: Sequence[Window]
) -> _Sides:
    """For the parts of pictures that show each of these windows; the arguments are those of `cropped`.

    They are few: a part has the least of them that is enough, at most `_COARSENING` times what it needs.
    """
    found: list[tuple[int, int]] = []
    for scene in scenes:
        places = filter(None, _in_sight(scene, terrain, off, windows))
        found += [(last[0] - first[0], last[1] - first[1]) for first, last in places]
    rows, columns = ([_rounded(count) for count in counts] for counts in zip(*found, strict=True)) if found else ([], [])
    return _few(rows), _few(columns)


def _few(counts: Sequence[int]) -> list[int]:
    """Of these the largest, the next that is less than that over `_COARSENING`, and so on."""
    found: list[int] = []
    for count in sorted(counts, reverse=True):
        if not found or count * _COARSENING < found[-1]:
            found.append(count)
    return found[::-1]


def _rounded(count: int) -> int:
    return math.ceil(max(count, 1) / _STEP) * _STEP


def _side(count: int, sides: Sequence[int]) -> int:
    """The least of these sides that is enough; a rounded one where none is, as heights have come to differ."""
    return next((side for side in sides if side >= count), _rounded(count))


def cropped(
    scenes: Sequence[Scene],
    targets: Sequence[np.ndarray],
    weights: Sequence[np.ndarray],
    terrain: Float[np.ndarray, "my mx"],
    off: float,
    window: Window,
    around: Window,
    sides: _Sides,
) -> list[Seen]:
    """What the pictures of a terrain show of a window of it, a weight for each value; `terrain`: its heights as far as they are
    known; `off`: by how much they may be off in the window; `around`: see `surroundings`; `sides`: see `sides_in_sight`."""
    field, whole = scenes[0].heightfields[0], Window(0, 0, *terrain.shape)

    def within(place: Window) -> list[Scene]:
        fields = _fields(field, terrain, window, place)
        return [_with_surroundings(scene, *fields, window, place) for scene in scenes]

    parts, everything = within(around), within(whole)
    places = [_in_sight(scene, terrain, off, [window])[0] for scene in scenes]
    # Pictures of one size share a program, those of this window and of the next ones.
    height, width = (
        _side(max((place[1][axis] - place[0][axis] for place in places if place is not None), default=1), sides[axis])
        for axis in (0, 1)
    )
    found = []
    for index, (scene, place) in enumerate(zip(parts, places, strict=True)):
        if place is None:
            continue
        camera = scene.camera
        size = min(height, camera.height), min(width, camera.width)
        y, x = (
            int(np.clip((low + high - side) // 2, 0, most - side))
            for low, high, side, most in zip(*place, size, (camera.height, camera.width), strict=True)
        )
        camera, here = cropped_camera(camera, x, y, size[1], size[0]), (slice(y, y + size[0]), slice(x, x + size[1]))
        shows, other = _sight_of(everything[index].with_camera(camera), window, terrain.shape)
        weight = np.where(other.reshape(*size, *(1,) * (weights[index].ndim - 2)), 0, weights[index][here])
        if (weight.reshape(*size, -1).any(-1) & shows).any():
            found.append(Seen(scene.with_camera(camera), targets[index][here], weight, index))
    return found


def _fields(
    whole: Heightfield, terrain: Float[np.ndarray, "my mx"], window: Window, around: Window
) -> tuple[Heightfield, Heightfield]:
    """A window of a terrain, and what is around it, with a hole there."""
    heights = terrain.astype(whole.heights.dtype)
    inside = _part(whole, heights, window)
    heights[window.y + 1 : window.y + window.ny - 1, window.x + 1 : window.x + window.nx - 1] = np.nan
    return inside, _part(whole, heights, around)


def _part(whole: Heightfield, heights: Float[np.ndarray, "my mx"], place: Window) -> Heightfield:
    """Of a terrain with these heights."""
    corner = whole.x0 + place.x * whole.dx, whole.y0 + place.y * whole.dy
    seam = None if whole.seam is None else np.asarray(whole.seam)[place.place]
    return Heightfield(heights[place.place].copy(), whole.dx, whole.dy, *corner, seam)


def _with_surroundings(scene: Scene, part: Heightfield, beyond: Heightfield, window: Window, around: Window) -> Scene:
    """The scene with the one in place of its terrain and the other as its last object."""
    shape, objects = scene.heightfields[0].heights.shape, list(scene.objects)
    k = scene.first_heightfield
    material, world = objects[k].material, objects[k].world_from_object
    there = map_textures(material, lambda image: _cropped_texture(image, shape, window))
    objects[k] = Object(part, there, world)
    if beyond.heights.shape != shape:
        material = map_textures(material, lambda image: _cropped_texture(image, shape, around))
    # Its place is given also where it is the world's: windows at the corner then share a program with the others.
    objects.append(Object(beyond, material, np.eye(4) if world is None else world))
    return eqx.tree_at(lambda scene: scene.objects, scene, tuple(objects))


def _cropped_texture(image: ImageTexture, shape: tuple[int, ...], window: Window) -> ImageTexture:
    """An image that covers the window alone: a colour for each vertex, or more where the image has more."""
    size = zip(image.texels.shape, shape, strict=False)
    finer = 1 if image.at_vertices and image.texels.shape[:2] == shape else max(math.ceil(n / (m - 1)) for n, m in size)
    v, u = (
        (begin + np.linspace(0, n - 1, finer * (n - 1) + 1)) / (m - 1)
        for begin, n, m in ((window.y, window.ny, shape[0]), (window.x, window.nx, shape[1]))
    )
    look_up = jnp.vectorize(image, signature="(k)->(c)")
    texels = np.asarray(look_up(jnp.stack(jnp.meshgrid(jnp.asarray(u), jnp.asarray(v)), axis=-1)))
    return ImageTexture(texels, at_vertices=True)


Corners = tuple[tuple[int, int], tuple[int, int]]


def _in_sight(scene: Scene, terrain: Float[np.ndarray, "my mx"], off: float, windows: Sequence[Window]) -> list[Corners | None]:
    """First and last row and column of a picture between which each of these windows may be seen; None: it is not. The other
    arguments are those of `cropped`."""
    local = localise(scene)
    place, film = local.objects[scene.first_heightfield].world_from_object, local.camera.film_from_world()
    matrices = np.eye(4) if place is None else place, film.linear, film.offset
    world, linear, offset = (np.asarray(matrix, np.float64) for matrix in matrices)
    field, camera, found = scene.heightfields[0], scene.camera, []
    for window in windows:
        heights = terrain[window.place]
        xs, ys = ((first * d, (first + n - 1) * d) for first, n, d in
                  ((window.x, window.nx, field.dx), (window.y, window.ny, field.dy)))  # fmt: skip
        box = np.meshgrid(xs, ys, (heights.min() - off, heights.max() + off))
        p = (world @ np.stack([part.ravel() for part in box] + [np.ones(8)]))[:3]
        x, y, w, depth = linear @ p + offset[:, None]
        low, high = [0, 0], [camera.height, camera.width]
        if (depth > 0).all():
            for axis, along in enumerate((y / w, x / w)):
                low[axis] = max(low[axis], math.floor(along.min()) - _MARGIN)
                high[axis] = min(high[axis], math.ceil(along.max()) + _MARGIN)
        seen = low[0] < high[0] and low[1] < high[1]
        found.append(((low[0], low[1]), (high[0], high[1])) if seen else None)
    return found


def _sight_of(scene: Scene, window: Window, shape: tuple[int, ...]) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Which pixels show what is sought, and which may show the rim or what is beyond."""
    _, known = render(scene, Settings(samples=1, shadows=False), aovs=("object", "cell"))
    number, cell = np.asarray(known["object"]), np.asarray(known["cell"])
    rim = window.rim(shape, _MARGIN)
    rim = rim[:-1, :-1] | rim[1:, 1:]
    sought = number == scene.first_heightfield
    outer = sought & rim[np.where(sought, cell[..., 1], 0), np.where(sought, cell[..., 0], 0)]
    other = ndimage.binary_dilation(outer | (number == len(scene.objects) - 1), np.ones((3, 3)), _MARGIN)
    return sought & ~other, other
