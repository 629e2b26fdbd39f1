"""Heights that lose their shape in single precision are warned of wherever they enter; others are taken in silence."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf
import jaxhf.mujoco
from jaxhf.core.precision import rounding
from jaxhf.fitting.model.unknowns import make_heights
from jaxhf.io.terrain.terrain import Terrain, heights_of

RELIEF = np.random.default_rng(0).uniform(size=(5, 6))  # of about 1 m
RADII = 3.39e6 + RELIEF  # of Mars, where float32 has steps of 0.25
WARNING = r"heights are rounded to float32, which moves one by 1\d\.?\d* % of the relief: subtract a constant from them"
FLAT = jaxhf.Heightfield(np.zeros((5, 6), np.float32), 1.0)
SCENE = jaxhf.Scene([jaxhf.Object(FLAT)], jaxhf.Perspective(np.eye(4)))


def by_toml(heights: np.ndarray, folder: Any) -> Any:
    camera = "[camera]\ntype = 'perspective'\neye = [0, 0, 9]\ntarget = [0, 0, 0]\nup = [0, 1, 0]\n"
    (folder / "a.toml").write_text(f"{camera}[[objects]]\nshape = 'heightfield'\nheights = {heights.tolist()}\n")
    return jaxhf.load_scene(folder / "a.toml")


ENTRANCES = {
    "Heightfield": lambda z, _: jaxhf.Heightfield(z, 1.0),
    "lists": lambda z, _: jaxhf.Heightfield(z.tolist(), 1.0),
    "with_heights": lambda z, _: SCENE.with_heights(z),
    "Terrain": lambda z, _: Terrain(z).heightfield(),
    "hillshade": lambda z, _: jaxhf.hillshade(z, 1.0),
    "slope": lambda z, _: jaxhf.slope(z, 1.0),
    "horizon": lambda z, _: jaxhf.horizon(z, 2, dx=1.0),
    "file": by_toml,
    "prior of a fit": lambda z, _: make_heights("Prior", "heights", z, FLAT),
}


@pytest.mark.parametrize("name", ENTRANCES)
def test_a_shape_that_single_precision_loses_is_warned_of(name, tmp_path):
    with pytest.warns(UserWarning, match=WARNING):
        ENTRANCES[name](RADII, tmp_path)
    ENTRANCES[name](RADII - 3.39e6, tmp_path)  # any warning is an error


def test_mujocos_data():
    with pytest.warns(UserWarning, match="^HField: heights are rounded to float32"):
        jaxhf.mujoco.HField(0.5 + 1e-6 * RELIEF, np.ones(4))
    jaxhf.mujoco.HField(RELIEF, np.ones(4))


SHAPES_KEPT = {
    "float32": RADII.astype(np.float32),
    "flat": np.full((3, 3), 0.1),  # all move alike
    "holes": np.array([[np.inf, 1.1], [np.nan, 2.3]]),
    "nothing": np.full((2, 2), np.nan),
    "whole": np.array([[0, 2**24 + 1], [3, 4]]),
    "denormal": np.array([[1e-43, 3e3], [3, 4]]),
}


@pytest.mark.parametrize("name", SHAPES_KEPT)
def test_what_keeps_its_shape_is_taken_in_silence(name):
    field = jaxhf.Heightfield(SHAPES_KEPT[name], 1.0)
    assert field.heights.dtype == np.float32
    np.testing.assert_allclose(field.heights, SHAPES_KEPT[name], rtol=1e-7, atol=1e-45)


@pytest.mark.x64
def test_double_precision_and_tracers_are_left_alone():
    assert jaxhf.Heightfield(RADII, 1.0).heights.dtype == np.float64
    shown = jax.jit(lambda z: jaxhf.Heightfield(z, 1.0).heights)(jnp.asarray(RADII, jnp.float32))
    assert shown.dtype == np.float32


def test_what_single_precision_cannot_hold_is_refused():
    """Infinite heights are holes, and 64-bit whole numbers wrapped round in silence."""
    with pytest.raises(jaxhf.ArgumentError, match=r"^Heightfield: heights must fit into float32, the largest is 1e\+39"):
        jaxhf.Heightfield(np.array([[1, 2], [-1e39, np.inf]]), 1.0)
    np.testing.assert_array_equal(jaxhf.Heightfield([[0, 2**40], [1, 2]], 1.0).heights, [[0, 2**40], [1, 2]])
    with pytest.warns(UserWarning, match="moves one by 100 % of the relief"):
        jaxhf.Heightfield([[2**40, 2**40 + 1], [2**40, 2**40]], 1.0)


def test_rounding_is_that_of_the_worst_height():
    """Against the definition, on either side of the bound below which nothing is compared."""
    for offset in 10.0 ** np.arange(0, 12):
        heights = np.vstack([offset + RELIEF, np.full((1, 6), np.nan)])
        share = np.nanmax(np.abs(heights.astype(np.float32) - heights)) / np.ptp(offset + RELIEF)
        found = rounding(heights, np.float32)
        assert found == pytest.approx(share) if share > 1e-3 else found <= 1e-3


def test_a_files_offset_keeps_its_relief():
    """Whole numbers with a scale and an offset, as GeoTIFF and netCDF have them."""
    stored = np.array([[0, 1000], [2000, 30_000]], np.int16)
    far, near = heights_of(stored, None, 1e-4, 3.39e6), heights_of(stored, None, 0.1, 100.0)
    assert (far.dtype, near.dtype) == (np.float64, np.float32)
    np.testing.assert_allclose(far - 3.39e6, stored * 1e-4, atol=1e-9)
