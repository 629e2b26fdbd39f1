"""Under `jax.transfer_guard("disallow")`, by which programs find copies to the device that they did not mean."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

HEIGHTS = np.random.default_rng(0).uniform(0.0, 0.3, (5, 6)).astype(np.float32)
FIELD = jaxhf.Heightfield(jnp.asarray(HEIGHTS), 1.0)
CAMERA = jaxhf.Orthographic.look_at((2.5, 2, 5), (2.5, 2, 0), (0, 1, 0), 5, width=6, height=5)
SCENE = jaxhf.Scene([jaxhf.Object(FIELD)], CAMERA, [jaxhf.Directional((0, 0.5, 1))])
RAYS = np.array([2.5, 2.5, 9.0]), np.array([0.0, 0.0, -1.0])

CALLS = {
    "render": lambda: jaxhf.render(SCENE),
    "prepare": lambda: jaxhf.render(jaxhf.prepare(SCENE).with_lights([jaxhf.Directional((0.5, 0, 1))])),
    "cast": lambda: jaxhf.cast(FIELD, *RAYS).p,
    "cast into what is prepared": lambda: jaxhf.cast(jaxhf.prepare(FIELD), *RAYS).p,
    "sky_view": lambda: jaxhf.sky_view(FIELD, 2, weighting="slope"),
    "Skirt.of": lambda: jaxhf.Skirt.of(FIELD, -0.1).south,
}


FURTHER = ("prepare", "cast into what is prepared")


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.deep) if name in FURTHER else name for name in CALLS])
def test_numbers_that_are_given_are_no_mistake(name):
    with jax.transfer_guard("disallow"):
        guarded = CALLS[name]()
    np.testing.assert_array_equal(guarded, CALLS[name]())
