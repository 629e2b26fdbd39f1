"""From a scene to a picture."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from pathlib import PurePath
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Float

from ..core.errors import ArgumentError, UserError, require_kind, require_progress
from ..core.settings import Settings
from ..preparation.any_size import Rooms, in_room, make_roomy_ceilings, make_roomy_world, surfaces_and_rooms, with_shapes_of
from ..preparation.localise import anchor, localise, localise_camera, localise_lights, precision
from ..preparation.world import World, make_world, resolve_settings
from ..scene.camera import Camera
from ..scene.heightfield import Heightfield, Size
from ..scene.light import Light
from ..scene.scene import Scene
from ..trace.grid import Grid, make_grid
from ..xla.compilation import compiled, is_traced
from ..xla.devices import chosen_mesh, held_everywhere, on_every_device, prepared_mesh, takes_numbers, where_called
from ..xla.materialise import unfolded
from .aovs import known_aovs
from .picture import compile_picture_ahead, picture, trace_in_parts, trace_picture


class _Given:
    """A scene that is no part of a pytree: what JAX has taken apart and put together again has it no longer."""

    def __init__(self, scene: Scene | None):
        self.scene = scene


jax.tree_util.register_pytree_node(_Given, lambda given: ((), None), lambda _, __: _Given(None))


class Prepared(eqx.Module):
    """A scene with all that its pictures need and that does not depend on the camera; `prepare` makes it, `render` takes it.

    As a pytree, for `jax.tree.map` or as the argument of a compiled function, it consists of the camera and of what was
    prepared. The scene is no part of it, as a change of that would change no picture: to differentiate by heights, lights or
    materials, prepare within the function.

    Attributes:
      camera: that is to see it.
      scene: as it was given, with that camera; ValueError of what JAX has taken apart and put together again.
      settings: those for which it was prepared.
      mesh: the devices on which it lies. What is read from a pickle lies on those of the same numbers, or on all of a process
        that has no such devices.
    """

    camera: Camera
    mesh: Mesh = eqx.field(static=True)
    _world: World
    _origin: tuple[float, ...] = eqx.field(static=True)  # of `_world`, in the scene's frame
    _form: Scene = eqx.field(static=True)  # the scene, with shapes and dtypes in place of arrays
    _given: _Given

    @property
    def scene(self) -> Scene:
        if self._given.scene is None:
            raise UserError(
                "Prepared: scene is no part of its pytree: change the scene, or differentiate by it, and prepare it"
            )
        return self._given.scene.with_camera(self.camera)

    @property
    def settings(self) -> Settings:
        return self._world.settings

    def with_camera(self, camera: Camera) -> "Prepared":
        """The same, seen by another camera.

        Nothing is compiled again if its picture is as large. If both have more than 64 tiles of `Settings.chunk` pixels, only
        what puts these together is, in 0.05 s, and on several devices nothing.
        """
        (self._given.scene or self._form).with_camera(camera)  # which checks it
        return dataclasses.replace(self, camera=camera)

    @takes_numbers
    def with_lights(self, lights: Iterable[Light]) -> "Prepared":
        """The same in another light; normals, bounds and what hides the sky are kept, see `Scene.with_lights`."""
        scene = (self._given.scene or self._form).with_lights(lights)
        if scene.sky_occlusion != self._form.sky_occlusion:
            return prepare(self.scene.with_lights(scene.lights), self.settings, mesh=self.mesh)
        local = localise_lights(scene.lights, np.array(self._origin), precision(self._form))
        local = on_every_device(local, prepared_mesh("with_lights", self.mesh, None, local))
        surfaces, rooms = surfaces_and_rooms(self._world)
        ceilings = _make_ceilings(surfaces, local, rooms=rooms, settings=self.settings)
        world = dataclasses.replace(self._world, lights=local, ceilings=ceilings)
        return dataclasses.replace(self, _world=world, _given=_Given(self._given.scene and scene))

    def __getstate__(self) -> dict[str, Any]:
        """Devices cannot be pickled, nor copied: their numbers stand for them."""
        numbers = np.vectorize(lambda device: device.id, otypes=[int])(self.mesh.devices)
        return {**vars(self), "mesh": (numbers, self.mesh.axis_names, self.mesh.axis_types)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        numbers, names, kinds = state["mesh"]
        here = {device.id: device for device in jax.devices()}
        found = [here[number] for number in numbers.ravel().tolist() if number in here]
        same = len(found) == numbers.size
        mesh = Mesh(np.array(found).reshape(numbers.shape), names, axis_types=kinds) if same else chosen_mesh("prepare", None)
        vars(self).update(state | {"mesh": mesh})


class PreparedHeightfield(eqx.Module):
    """A heightfield with all that rays on it need, or a batch of them; `prepare` makes it, `cast` takes it.

    Attributes:
      field: as it was given.
      settings: those for which it was prepared.
    """

    field: Heightfield
    settings: Settings = eqx.field(static=True)
    _grid: Grid  # of a batch: with one leading axis


@overload
def prepare(scene: Scene, settings: Settings | None = None, *, mesh: Mesh | None = None) -> Prepared: ...
@overload
def prepare(scene: Heightfield, settings: Settings | None = None) -> PreparedHeightfield: ...
@takes_numbers
def prepare(
    scene: Scene | Heightfield, settings: Settings | None = None, *, mesh: Mesh | None = None
) -> Prepared | PreparedHeightfield:
    """Takes the normals and the bounds of the heights once, for many pictures of the same terrain in the same light.

    The arguments are those of `render`. Or, for many calls of `cast` on one heightfield or on a batch of them, `scene` is
    that, and `mesh` None; with shading="flat" no normals are taken. Beyond its heights each then takes about 5 times as much
    memory, and 3 times that of its heights for normals.
    """
    if isinstance(scene, Heightfield):
        if mesh is not None:
            raise UserError("prepare: a heightfield alone goes to no mesh, as cast uses one device")
        require_kind("prepare", "settings", settings or Settings(), Settings, "a jaxhf.Settings")
        heights, settings = jnp.asarray(where_called("prepare", scene.heights)), settings or Settings()
        grid = heightfield_grids(heights.reshape(-1, *heights.shape[-2:]), scene.dx, scene.dy, settings)
        return PreparedHeightfield(scene, settings, grid if heights.ndim > 2 else jax.tree.map(lambda leaf: leaf[0], grid))
    _require_scene("prepare", scene, Scene)
    return prepare_to_render(scene, settings, mesh)


def prepare_to_render(
    scene: Scene, settings: Settings | None = None, mesh: Mesh | None = None, aovs: tuple[str, ...] | None = None
) -> Prepared:
    """As `prepare`; with `aovs` the program for pictures with these is compiled beside that which prepares."""
    mesh = chosen_mesh("prepare", mesh, scene)
    local = on_every_device(localise(scene), mesh)

    def compile_ahead(world: World) -> None:
        if aovs is not None:
            compile_picture_ahead(world, local.camera, aovs, mesh, None)

    world = prepared_world(local, resolve_settings(settings or Settings(), scene), mesh, compile_ahead)
    world = held_everywhere(world, mesh)
    form = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), scene)
    return Prepared(scene.camera, mesh, world, tuple(anchor(scene).tolist()), form, _Given(scene))


@takes_numbers
def render(
    scene: Scene | Prepared,
    settings: Settings | None = None,
    *,
    aovs: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
    key: jax.Array | None = None,
    mesh: Mesh | None = None,
) -> Any:
    """Renders a picture.

    Its tiles are dealt out to many devices, each of which holds a copy of the scene; the picture has the same bits on any
    number of CPU devices. JAX takes the cores of a CPU for one device, unless
    `jax.config.update("jax_num_cpu_devices", n)` says otherwise before it is first used.

    Args:
      scene: what to see. Values that are NumPy or Python numbers keep double precision until the origin has been moved to
        the terrain; the rest is computed in the precision of the (first) heightfield's heights.
      settings: the knobs; None: `Settings()`, or those of a `Prepared` scene, which can be rendered with no others.
      aovs: names out of `AOVS`.
      progress: called with (pixels done, pixels in all) as the picture grows; not within `jit`, `grad`, `vmap` and the like.
      key: of JAX's random numbers, for what is sampled: the points on edges, if the settings ask for them. The same key
        gives the same derivative; None stands for a fixed one.
      mesh: the devices that share the work, whatever its axes; None: those of `jax.set_mesh`, or else all of this process.
        Where it spans several processes (`jax.distributed`), each must call with the same values, and gets the whole picture.
        Within a `pmap`, or a `shard_map` with check_vma=False, it must be None: each device renders a picture of its own.

    Returns:
      Linear radiance, shape (h, w, 3), top row first; with `aovs` that and a dict of them.

    Raises:
      ValueError: an unknown AOV, or settings or a mesh for a scene that was prepared with others; another mesh than that of
        `jax.set_mesh`; a `shard_map` with check_vma=True.
    """
    _require_scene("render", scene, (Scene, Prepared))
    require_progress("render", progress, is_traced())
    require_key(key)
    aovs = known_aovs("render", aovs)
    if isinstance(scene, Scene):
        here = chosen_mesh("render", mesh, (scene, key))
        local = on_every_device(localise(scene), here)
        camera = local.camera

        def compile_ahead(world: World) -> None:
            compile_picture_ahead(world, camera, aovs, here, key if progress is None else None)

        world = prepared_world(local, resolve_settings(settings or Settings(), scene), here, compile_ahead)
    else:
        here, world = prepared_mesh("render", scene.mesh, mesh, (scene, key)), scene._world
        if settings is not None and resolve_settings(settings, scene._form) != scene.settings:
            raise UserError(f"render: the scene was prepared with {scene.settings}, it cannot be rendered with {settings}")
        camera = localise_camera(scene.camera, scene._given.scene, np.array(scene._origin), precision(scene._form))
        camera = on_every_device(camera, here)
    if progress is None:
        outputs = picture(world, camera, aovs, here, key)
    else:
        outputs = trace_in_parts(world, camera, aovs, here, progress)
    image = outputs.pop("image")
    return (image, {name: outputs[name] for name in aovs}) if aovs else image


def _require_scene(owner: str, scene: Any, kind: type | tuple[type, ...]) -> None:
    if isinstance(scene, kind):
        return
    hint = ""
    if isinstance(scene, str | PurePath):
        hint = "jaxhf.load_scene reads one from a file"
    elif isinstance(scene, list | tuple):
        hint = f"{owner} takes one at a time"
    elif hasattr(scene, "heights"):
        hint = "which has a camera and lights besides: jaxhf.Scene([jaxhf.Object(heightfield)], camera, lights)"
    elif isinstance(scene, Prepared):
        hint = "whose .scene can be prepared anew"
    require_kind(owner, "scene", scene, kind, "a jaxhf.Scene", hint)


def require_key(key: Any) -> None:
    """Refuses what is neither a key of JAX's, nor its older form, two numbers."""
    typed = isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ()
    if not (key is None or typed or (isinstance(key, jax.Array | np.ndarray) and key.dtype == np.uint32 and key.ndim == 1)):
        raise ArgumentError("render", "key", f"must be one key of JAX's, as jax.random.key(0) makes it, it is {key!r}")


def render_each(scenes: Scene, change: Callable[[Scene], Scene], settings: Settings, mesh: Mesh) -> Float[jax.Array, "n h w 3"]:
    """Pictures of scenes that differ in numbers only, one after the other, in one program; for tracing.

    They come as one `localise`d scene whose leaves have a leading axis; `change` is done to each before it is rendered.
    """

    def one(scene: Scene) -> jax.Array:
        scene = change(scene)
        resolved = resolve_settings(settings, scene)
        return trace_picture(prepared_world(on_every_device(scene, mesh), resolved), scene.camera, (), mesh, None)["image"]

    return lax.map(one, scenes)


@functools.partial(compiled, newer=True, static_argnames=("dx", "dy", "settings"))
def heightfield_grids(heights: Float[jax.Array, "m ny nx"], dx: float, dy: float, settings: Settings) -> Grid:
    """Of heightfields that differ in their heights only."""
    return lax.map(lambda z: make_grid(Heightfield(z, dx, dy), None, settings), heights)


_make_ceilings = compiled(make_roomy_ceilings, static_argnames=("rooms", "settings"))


def _made_world(scene: Scene, sizes: tuple[Size | None, ...], rooms: Rooms | None, settings: Settings) -> World:
    return make_world(scene, settings) if rooms is None else make_roomy_world(scene, sizes, rooms, settings)


_make_world = compiled(_made_world, static_argnames=("rooms", "settings"))
_make_world_with_horizons = compiled(_made_world, newer=True, static_argnames=("rooms", "settings"))


def prepared_world(
    scene: Scene, settings: Settings, mesh: Mesh | None = None, then: Callable[[World], None] = lambda world: None
) -> World:
    """Of a `localise`d scene, by one program for all cameras; with room, where programs of its own are to trace it.

    If that must be compiled first, `then` is called meanwhile with a world of forms, on a mesh as the scene is.
    """
    make = _make_world if scene.sky_occlusion is None else _make_world_with_horizons
    if is_traced():
        scene = eqx.tree_at(lambda scene: scene.camera, unfolded(scene), None)
        return make(scene, (), rooms=None, settings=settings)
    seen, sizes, rooms = in_room(scene, settings)

    def following(world: World) -> None:
        then(with_shapes_of(scene, world if mesh is None else on_every_device(world, mesh)))

    return with_shapes_of(scene, make.meanwhile(following, seen, sizes, rooms=rooms, settings=settings))
