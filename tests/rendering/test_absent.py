"""What a scene does not use is not in its compiled program.

For every feature, the code behind it is made to fail. A scene that has it gets another, longer program, and cannot be traced
once its code fails; the program of a scene without it must not change by that, to the letter.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

import jaxhf
from jaxhf.boundary import fold, guiding, outline, sample
from jaxhf.core import affine, autodiff
from jaxhf.rendering import aovs as rendering_aovs, tiles
from jaxhf.scene import localise, texture
from jaxhf.shade import lighting, radiance
from jaxhf.trace import ceiling, cylinder, horizon, intersect, normals, search, skirt, skyline, world as trace_world
from jaxhf.xla import masked

CAMERA = jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), width=16, height=16)
FIELD = jaxhf.Heightfield(np.random.default_rng(0).uniform(size=(5, 5)))
SUN, SKY = jaxhf.Directional((1, 2, 3)), jaxhf.Sky(0.5)
BARE = jaxhf.Settings(shading="flat", shadows=False)


def scene(*others: jaxhf.Object, material: jaxhf.Matte | None = None, world=None, lights=(SUN,)):
    return jaxhf.Scene([jaxhf.Object(FIELD, material, world), *others], CAMERA, lights)


class Case(NamedTuple):
    """A scene and how it is rendered."""

    scene: jaxhf.Scene
    settings: jaxhf.Settings = BARE
    aovs: tuple[str, ...] = ()
    differentiated: bool = False

    def program(self) -> str:
        jax.clear_caches()  # or a trace from before the change would be taken

        def brightness(heights):
            return jaxhf.render(self.scene.with_heights(heights), self.settings).sum()

        if self.differentiated:
            return jax.jit(jax.grad(brightness)).lower(self.scene.heights).as_text()
        return jax.jit(lambda scene: jaxhf.render(scene, self.settings, aovs=self.aovs)).lower(self.scene).as_text()


class Used(Exception):
    """The code of an absent feature ran."""


Change = Callable[[pytest.MonkeyPatch], None]


def fails(*args, **kwargs):
    raise Used


def modules() -> list[Any]:
    return [module for name, module in sys.modules.items() if name.split(".")[0] == "jaxhf"]


def fails_everywhere(function: Callable[..., Any], when: Callable[..., bool] = lambda **_: True) -> Change:
    """`function` fails under whatever names the package's modules know it, where `when` holds for its keyword arguments."""

    def guarded(*args, **kwargs):
        return fails() if when(**kwargs) else function(*args, **kwargs)

    def change(patch):
        for module in modules():
            for name, value in list(vars(module).items()):
                if value is function:
                    patch.setattr(module, name, guarded)

    return change


def fails_in(place: Any, name: str) -> Change:
    """`name` of a class or of one module fails; elsewhere it may be needed."""
    return lambda patch: patch.setattr(place, name, fails)


def recognised(place: Any, name: str) -> Change:
    """isinstance(value, place.name) fails where it would be true: no branch for this kind of thing is entered."""
    kind = getattr(place, name)

    class Guard(type):
        def __instancecheck__(cls, instance):
            return fails() if isinstance(instance, kind) else False

    return lambda patch: patch.setattr(place, name, Guard(name, (), {}))


def without(place: Any, module: str, name: str) -> Change:
    """`place` finds no function `name` in the module that it knows as `module`."""

    class Rest:
        def __getattr__(self, other):
            return fails if other == name else getattr(original, other)

    original = getattr(place, module)
    return lambda patch: patch.setattr(place, module, Rest())


def second_call_fails(function: Callable[..., Any]) -> Change:
    calls = []

    def second(**_):
        calls.append(function)
        return len(calls) > 1

    def change(patch):
        calls.clear()
        fails_everywhere(function, second)(patch)

    return change


PLAIN = Case(scene())
TEXTURE = jaxhf.Matte(jaxhf.ImageTexture(np.ones((2, 2, 3))))
CLAMPED = jaxhf.Matte(jaxhf.ImageTexture(np.ones((2, 2, 3)), wrap="clamp"))
TILTED = np.array([[1, 0, 0, 0.1], [0, 1, 0.2, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
SMOOTH = jaxhf.Settings(shading="smooth", shadows=False)
DEPTH = Case(scene(), aovs=("depth",))
POINTS = jaxhf.Settings(shading="flat", shadows=False, edge_samples=64)
EDGES = Case(scene(), POINTS, differentiated=True)

# feature: the baseline without it, the same with it, and the changes that make its code fail
FEATURES: dict[str, tuple[str, Case, list[Change]]] = {
    "shadows": (
        "plain",
        Case(scene(), jaxhf.Settings(shading="flat")),
        [fails_everywhere(intersect.blocked), fails_everywhere(ceiling.make_ceiling), fails_everywhere(ceiling.clears)],
    ),
    "image texture": ("plain", Case(scene(material=TEXTURE)), [fails_in(jaxhf.ImageTexture, "__call__")]),
    "clamped texture": ("repeated", Case(scene(material=CLAMPED)), [fails_in(texture, "within")]),
    "mirror": (
        "plain",
        Case(scene(jaxhf.Object(FIELD, jaxhf.Mirror()))),
        [fails_everywhere(radiance._reflect), fails_everywhere(radiance._reflectance), fails_everywhere(trace_world.no_hit)],
    ),
    "cylinder": (
        "plain",
        Case(scene(jaxhf.Object(jaxhf.Cylinder()))),
        [fails_everywhere(cylinder.make_tube), fails_everywhere(cylinder.tube_distance), recognised(intersect, "Tube")],
    ),
    "skirt": (
        "edges",
        Case(scene(jaxhf.Object(jaxhf.Skirt.of(FIELD, -1))), POINTS, differentiated=True),
        [fails_everywhere(function) for function in (skirt.make_walls, skirt.hit_on_side, outline.faces_of, fold._with_walls)],
    ),
    "second heightfield": (
        "smooth",
        Case(scene(jaxhf.Object(FIELD)), SMOOTH),
        [second_call_fails(trace_world.make_surface), second_call_fails(normals.vertex_normals)],
    ),
    "several samples": (
        "plain",
        Case(scene(), jaxhf.Settings(shading="flat", shadows=False, samples=4)),
        [without(tiles, "lax", "fori_loop")],
    ),
    "sky": ("plain", Case(scene(lights=(SUN, SKY))), [recognised(lighting, "Sky")]),
    "hidden sky": (
        "plain",
        Case(scene(lights=(SUN, jaxhf.Sky(0.5, occlusion=4)))),
        [fails_everywhere(horizon.visible_sky), fails_everywhere(lighting._seen_share)],
    ),
    "sun with a size": (
        "plain",
        Case(scene(lights=(jaxhf.Sun((1, 2, 3)),)), jaxhf.Settings(shading="flat")),
        [fails_everywhere(skyline.skyline_slope), fails_everywhere(lighting._disc)],
    ),
    "point light": (
        "plain",
        Case(scene(lights=(jaxhf.Point((1, 2, 3)),))),
        [recognised(localise, "Point"), without(lighting, "jnp", "sqrt")],
    ),
    "smooth normals": (
        "plain",
        Case(scene(), SMOOTH),
        [fails_everywhere(normals.vertex_normals), fails_everywhere(lighting.rounded_clamp)],
    ),
    "transform": (  # None is the identity, and nothing is inverted for it
        "plain",
        Case(scene(world=TILTED)),
        [fails_in(trace_world, "affine"), fails_in(affine.Affine, "inverse")],
    ),
    "edge samples": (
        "differentiated",
        EDGES,
        [fails_everywhere(sample.draw), fails_everywhere(guiding.initial_weights), fails_everywhere(autodiff.with_tangent)],
    ),
    "AOVs": ("plain", DEPTH, [fails_everywhere(rendering_aovs.observe)]),
    "step counting": (
        "depth",
        Case(scene(), aovs=("depth", "steps")),
        [fails_everywhere(search.first_triangle, lambda count_steps=False, **_: count_steps)],
    ),
    "shadow AOV": ("depth", Case(scene(), aovs=("depth", "shadow")), [fails_everywhere(lighting.in_shadow)]),
    "step budget": (
        "plain",
        Case(scene(), jaxhf.Settings(shading="flat", shadows=False, max_steps=6)),
        [fails_everywhere(search.first_triangle, lambda max_steps=None, **_: max_steps is not None)],
    ),
    "fixed number of steps": (
        "plain",
        Case(scene(), jaxhf.Settings(shading="flat", shadows=False, early_exit=False)),
        [fails_everywhere(masked.only_where, lambda skips=True, **_: not skips)],
    ),
}


BASELINES = {
    "plain": PLAIN,
    "smooth": Case(scene(), SMOOTH),
    "repeated": Case(scene(material=TEXTURE)),
    "depth": DEPTH,
    "differentiated": Case(scene(), differentiated=True),
    "edges": EDGES,
}


@functools.cache
def baseline(name: str) -> str:
    return BASELINES[name].program()


@pytest.mark.parametrize("name", FEATURES)
def test_a_feature_that_is_used_is_in_the_program(name, monkeypatch):
    without_it, with_it, changes = FEATURES[name]
    program, other = baseline(without_it), with_it.program()
    assert other != program
    assert len(other) > len(program) or name in ("step budget", "fixed number of steps")  # another loop, no more
    for change in changes:
        with monkeypatch.context() as patch:
            change(patch)
            with pytest.raises(Used):
                with_it.program()


@pytest.mark.parametrize("name", BASELINES)
def test_what_is_absent_leaves_no_trace(name, monkeypatch):
    """The code of all features that a scene lacks fails at once."""
    program = baseline(name)
    with monkeypatch.context() as patch:
        for without_it, _, changes in FEATURES.values():
            for change in changes if without_it == name else ():
                change(patch)
        assert BASELINES[name].program() == program


def test_points_on_edges_are_drawn_only_where_a_derivative_is_taken():
    assert Case(scene(), POINTS).program() == baseline("plain")


def test_max_depth_means_nothing_without_mirrors():
    programs = {Case(scene(), jaxhf.Settings(max_depth=depth, shading="flat", shadows=False)).program() for depth in (0, 1, 7)}
    assert len(programs) == 1
    mirror = jaxhf.Scene([jaxhf.Object(FIELD, jaxhf.Mirror())], CAMERA, [SUN])
    one, two = (jaxhf.Settings(max_depth=depth, shading="flat", shadows=False) for depth in (1, 2))
    assert Case(mirror, one).program() != Case(mirror, two).program()


@pytest.mark.parametrize(
    ("lights", "knobs"), [((jaxhf.Point((1, 2, 3)), SKY), {}), ((SUN,), {"max_steps": 9}), ((SUN,), {"early_exit": False})]
)
def test_bounds_under_a_light_only_where_they_spare_walks(lights, knobs, monkeypatch):
    """Not where a walk is to take a number of steps, as its steps are those of the settings."""
    fails_everywhere(ceiling.make_ceiling)(monkeypatch)
    Case(scene(lights=lights), jaxhf.Settings(shading="flat", **knobs)).program()
