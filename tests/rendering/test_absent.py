"""What a scene does not use is not in its compiled program.

Each case is traced once, with a watch on the code behind every feature. A scene that has a feature gets another, longer program
than the one without it, and runs all of the feature's code, of which the scene without it runs nothing.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

import jaxhf
from jaxhf.boundary import guiding, sample
from jaxhf.core import affine, autodiff
from jaxhf.preparation import ceiling, sky, world as worlds
from jaxhf.rendering import tiles
from jaxhf.scene import material as materials, texture
from jaxhf.shade import lighting, radiance, reflectance
from jaxhf.trace import cylinder, grid, intersect, normals, search, skirt, skyline
from jaxhf.xla import masked

CAMERA = jaxhf.Perspective.look_at((0.5, -1, 1), (0.5, 0.5, 0), width=16, height=16)
FIELD = jaxhf.Heightfield(np.random.default_rng(0).uniform(size=(5, 5)).astype(np.float32))
SUN, SKY = jaxhf.Directional((1, 2, 3)), jaxhf.Sky(0.5)
MIRROR = jaxhf.Object(FIELD, jaxhf.Mirror())
TEXELS = np.ones((2, 2, 3))
TILTED = np.array([[1, 0, 0, 0.1], [0, 1, 0.2, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


class Case(NamedTuple):
    """A scene and how it is rendered."""

    scene: jaxhf.Scene
    settings: jaxhf.Settings
    aovs: tuple[str, ...]
    differentiated: bool

    def picture(self, scene: jaxhf.Scene) -> Any:
        return jaxhf.render(scene, self.settings, aovs=self.aovs)

    def program(self) -> str:
        jax.clear_caches()  # or code that was traced before would not run again
        if self.differentiated:
            return (
                jax.jit(jax.grad(lambda z: self.picture(self.scene.with_heights(z)).sum())).lower(self.scene.heights).as_text()
            )
        return jax.jit(self.picture).lower(self.scene).as_text()


def case(*others: jaxhf.Object, material=None, world=None, lights=(SUN,), aovs=(), differentiated=False, **knobs: Any) -> Case:
    """Terrain in the sun, flat and without shadows unless `knobs` say otherwise."""
    scene = jaxhf.Scene([jaxhf.Object(FIELD, material, world), *others], CAMERA, lights)
    return Case(scene, jaxhf.Settings(**{"shading": "flat", "shadows": False, **knobs}), aovs, differentiated)


# A watch lets code say when it runs, and changes nothing else.
Say = Callable[[], None]
Watch = Callable[[pytest.MonkeyPatch, Say], None]


def saying(function: Callable[..., Any], say: Say, when: Callable[..., bool]) -> Callable[..., Any]:
    @functools.wraps(function)
    def called(*args, **kwargs):
        if when(**kwargs):
            say()
        return function(*args, **kwargs)

    return called


def everywhere(function: Callable[..., Any], when: Callable[..., bool] = lambda **_: True) -> Watch:
    """`function`, under whatever names the package's modules know it, where `when` holds for its keyword arguments."""

    def watch(patch, say):
        for module in [module for name, module in sys.modules.items() if name.split(".")[0] == "jaxhf"]:
            for name, value in list(vars(module).items()):
                if value is function or (callable(value) and getattr(value, "__wrapped__", None) is function):
                    patch.setattr(module, name, saying(value, say, when))

    return watch


def within(place: Any, name: str) -> Watch:
    """`name` of a class or of one module; elsewhere it may be needed."""
    return lambda patch, say: patch.setattr(place, name, saying(getattr(place, name), say, lambda **_: True))


# feature: the case without it, the same with it, and the functions that it alone needs, where there are any
FEATURES: dict[str, tuple[str, Case, list[Watch]]] = {
    "shadows": ("plain", case(shadows=True), [*map(everywhere, (intersect.blocked, ceiling.make_ceiling, ceiling.clears))]),
    "texture": ("plain", case(material=jaxhf.Matte(jaxhf.ImageTexture(TEXELS))), [within(jaxhf.ImageTexture, "__call__")]),
    "clamped texture": (
        "texture",
        case(material=jaxhf.Matte(jaxhf.ImageTexture(TEXELS, wrap="clamp"))),
        [within(texture, "within")],
    ),
    "mirror": ("plain", case(MIRROR), [*map(everywhere, (radiance._reflect, radiance._mirrored, worlds.no_hit))]),
    "cylinder": (
        "plain",
        case(jaxhf.Object(jaxhf.Cylinder())),
        [everywhere(cylinder.make_tube), within(cylinder.Tube, "distance"), within(cylinder.Tube, "hit")],
    ),
    "skirt": (
        "plain",
        case(jaxhf.Object(jaxhf.Skirt.of(FIELD, -1))),
        [everywhere(skirt.make_walls), within(skirt.Walls, "hit")],
    ),
    "second heightfield": ("smooth normals", case(jaxhf.Object(FIELD), shading="smooth"), []),
    "several samples": ("plain", case(samples=4), []),
    "sky": ("plain", case(lights=(SUN, SKY)), []),
    "hidden sky": (
        "plain",
        case(lights=(SUN, jaxhf.Sky(0.5, occlusion=4))),
        [everywhere(sky.visible_sky), everywhere(lighting._seen_share)],
    ),
    "sun with a size": (
        "plain",
        case(lights=(jaxhf.Sun((1, 2, 3)),), shadows=True),
        [everywhere(skyline.skyline_slope), everywhere(lighting._disc)],
    ),
    "point light": ("plain", case(lights=(jaxhf.Point((1, 2, 3)),)), []),
    "smooth normals": (
        "plain",
        case(shading="smooth"),
        [everywhere(normals.vertex_normals), everywhere(lighting.rounded_clamp)],
    ),
    "another law than Lambert's": (
        "plain",
        case(material=jaxhf.LunarLambert(0.5)),
        [everywhere(reflectance.brdf), within(materials.LunarLambert, "brdf")],
    ),
    # None is the identity, and nothing is inverted for it.
    "transform": ("plain", case(world=TILTED), [within(worlds, "affine"), within(affine.Affine, "inverse")]),
    "edge samples": (
        "differentiated",
        case(edge_samples=64, differentiated=True),
        [*map(everywhere, (sample.draw, guiding.initial_weights, autodiff.with_tangent))],
    ),
    "AOVs": ("plain", case(aovs=("depth",)), [within(tiles, "observe")]),
    "step counting": (
        "AOVs",
        case(aovs=("depth", "steps")),
        [everywhere(search.first_triangle, lambda count_steps=False, **_: count_steps)],
    ),
    "shadow AOV": ("AOVs", case(aovs=("depth", "shadow")), [everywhere(lighting.in_shadow)]),
    "step budget": (
        "plain",
        case(max_steps=6),
        [lambda patch, say: patch.setattr(grid, "min", saying(min, say, lambda **_: True), raising=False)],
    ),
    "fixed number of steps": (
        "plain",
        case(early_exit=False),
        [everywhere(masked.only_where, lambda skips=True, **_: not skips)],
    ),
}
CASES = {
    "plain": case(),
    "differentiated": case(differentiated=True),
    **{name: with_it for name, (_, with_it, _) in FEATURES.items()},
}


@functools.cache
def traced(name: str) -> tuple[str, set[tuple[str, int]]]:
    """The program of a case, and which watches spoke while it was traced, by feature and number."""
    said: set[tuple[str, int]] = set()
    with pytest.MonkeyPatch.context() as patch:
        for feature, (_, _, watches) in FEATURES.items():
            for k, watch in enumerate(watches):
                watch(patch, functools.partial(said.add, (feature, k)))
        return CASES[name].program(), said


FURTHER = {
    "clamped texture", "skirt", "several samples", "sky", "point light", "transform",
    "AOVs", "step counting", "shadow AOV", "step budget", "fixed number of steps",
}  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.deep] * (name in FURTHER)) for name in FEATURES])
def test_a_feature_is_in_the_program_only_where_it_is_used(name):
    without_it, _, watches = FEATURES[name]
    (program, said), (longer, said_with_it) = traced(without_it), traced(name)
    assert longer != program
    # Budgets are another loop, no more; an AOV is of the walk that the picture takes.
    assert len(longer) > len(program) or name in ("step budget", "fixed number of steps", "AOVs")
    numbers = range(len(watches))
    assert [(name, k) in said_with_it for k in numbers] == [True for _ in numbers]
    assert [(name, k) in said for k in numbers] == [False for _ in numbers]


@pytest.mark.deep
def test_settings_that_a_scene_gives_no_meaning():
    """Points on edges where no derivative is taken, and bounces where there are no mirrors."""
    knobs: dict[str, Any]
    for knobs in ({"edge_samples": 64}, {"max_depth": 0}, {"max_depth": 7}):
        assert case(**knobs).program() == traced("plain")[0], knobs
    assert case(MIRROR, max_depth=1).program() != traced("mirror")[0]


@pytest.mark.parametrize(
    ("lights", "knobs"), [((jaxhf.Point((1, 2, 3)), SKY), {}), ((SUN,), {"max_steps": 9}), ((SUN,), {"early_exit": False})]
)
def test_bounds_under_a_light_only_where_they_spare_walks(lights, knobs, monkeypatch):
    """Not where a walk is to take a number of steps, as its steps are those of the settings."""
    bounds = []
    everywhere(ceiling.make_ceiling)(monkeypatch, lambda: bounds.append(1))
    shadowed = case(lights=lights, shadows=True, **knobs)
    jax.clear_caches()
    jax.eval_shape(shadowed.picture, shadowed.scene)
    assert not bounds
