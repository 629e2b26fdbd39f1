"""`Settings(early_exit=False)`: loops of fixed length, the same results, and a program that can be exported."""

import jax
import numpy as np
import pytest

import jaxhf
from jaxhf.scene.procedural import fractal

HEIGHTS = fractal([17, 13], seed=2, exponent=2.0, range=(0.0, 0.4)).astype(np.float32)
SHEET = np.array([[0.6, 0, 0.1, 0.1], [0, 0.6, 0.2, 0.1], [-0.1, 0.1, 1, 0.5], [0, 0, 0, 1]])
CAMERA = jaxhf.Perspective.look_at((0.5, -0.9, 1.1), (0.5, 0.4, 0.2), width=24, height=20)
AOVS = ("depth", "cell", "shadow", "steps", "exhausted")


def terrain(heights) -> jaxhf.Scene:
    """With a hole, under a low sun."""
    return jaxhf.Scene([jaxhf.Object(jaxhf.Heightfield(heights))], CAMERA, [jaxhf.Directional((1, 0.3, 0.3))])


def mirrors(heights) -> jaxhf.Scene:
    """A mirror, and a tilted sheet over it."""
    objects = [jaxhf.Object(jaxhf.Heightfield(heights), jaxhf.Mirror()), jaxhf.Object(jaxhf.Heightfield(HEIGHTS), None, SHEET)]
    return jaxhf.Scene(objects, CAMERA, [jaxhf.Point((0.8, -0.3, 1.4))])


@pytest.mark.deep
@pytest.mark.optimised  # to the bit
@pytest.mark.parametrize(
    ("scene", "aovs", "knobs"),
    [
        (terrain, AOVS, {"traversal": "pyramid"}),
        (terrain, AOVS, {"traversal": "dda", "max_steps": 5}),
        pytest.param(mirrors, (), {"max_depth": 1}, marks=pytest.mark.slow),
    ],
)
def test_a_fixed_number_of_steps_gives_the_same_picture(scene, aovs, knobs):
    """Rays of the camera, shadow rays and mirrored ones, and how many steps each took; by a program that was exported."""
    heights = np.where(HEIGHTS > 0.37, np.nan, HEIGHTS)

    def renderer(early_exit: bool):
        settings = jaxhf.Settings(early_exit=early_exit, shading="flat", chunk=64, **knobs)
        return jax.jit(lambda heights: jaxhf.render(scene(heights), settings, aovs=aovs))

    usual, fixed = renderer(True), renderer(False)
    assert [" while[" in str(render.trace(heights).jaxpr) for render in (usual, fixed)] == [True, False]
    exported = jax.export.export(fixed, platforms=["cpu"])(heights)
    expected = usual(heights)
    jax.tree.map(np.testing.assert_array_equal, exported.call(heights), expected)
    assert np.ptp(expected[0]) > 0.1
    if aovs:
        assert 0 < np.mean(expected[1]["shadow"]) < 1
        assert (np.max(expected[1]["exhausted"]) > 0) == ("max_steps" in knobs)
