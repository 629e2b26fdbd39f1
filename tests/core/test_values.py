"""What becomes of a caller's arrays: they are copied, nan stands where they are masked, and any real numbers will do."""

import re

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

import jaxhf
import jaxhf.mujoco
from jaxhf.core.types import array_leaf
from jaxhf.fitting.model.pictures import checked_pictures
from jaxhf.fitting.model.unknowns import make_heights

RNG = np.random.default_rng(0)
HEIGHTS = RNG.uniform(0.1, 0.5, (5, 6)).astype(np.float32)
FIELD = jaxhf.Heightfield(HEIGHTS, 1.0)
CAMERA = jaxhf.Orthographic.look_at((2.5, 2, 5), (2.5, 2, 0), (0, 1, 0), 5, width=6, height=5)
SCENE = jaxhf.Scene([jaxhf.Object(FIELD)], CAMERA, [jaxhf.Directional((0, 0, 1))])
GREYS = RNG.uniform(size=(4, 5)).astype(np.float32)
POSE = np.eye(4)
VECTOR = np.array([0.1, 0.2, 0.9])
QUAT = np.array([1.0, 0.0, 0.0, 0.0])


def aligned(values: np.ndarray) -> np.ndarray:
    """A copy whose memory JAX on a CPU would share."""
    room = np.empty(values.nbytes + 64, np.uint8)
    start = -room.ctypes.data % 64
    copy = room[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy


# What is made of which arrays. Each array is edited afterwards.
MADE = {
    "Heightfield": (jaxhf.Heightfield, HEIGHTS),
    "with_heights": (SCENE.with_heights, HEIGHTS),
    "prepare": (lambda z: jaxhf.prepare(jaxhf.Heightfield(z), jaxhf.Settings(shading="flat")), HEIGHTS),
    "ImageTexture": (jaxhf.ImageTexture, GREYS[..., None] * np.ones(3)),
    "grey ImageTexture": (jaxhf.ImageTexture, GREYS.astype(np.float64)),
    "Matte": (jaxhf.Matte, VECTOR),
    "Mirror": (jaxhf.Mirror, VECTOR),
    "Object": (lambda pose: jaxhf.Object(FIELD, None, pose), POSE),
    "Perspective": (jaxhf.Perspective, POSE, np.array(40.0)),
    "Orthographic": (jaxhf.Orthographic, POSE, np.array(4.0)),
    "look_at": (jaxhf.Perspective.look_at, VECTOR, -VECTOR, VECTOR[::-1]),
    "from_intrinsics": (
        lambda pose: jaxhf.Perspective.from_intrinsics(9, 9, 4, 4, world_from_camera=pose, width=8, height=8), POSE),
    "Directional": (jaxhf.Directional, VECTOR, VECTOR),
    "Sun": (jaxhf.Sun, VECTOR, VECTOR, np.array(0.5)),
    "Point": (jaxhf.Point, VECTOR, VECTOR),
    "Sky": (jaxhf.Sky, VECTOR),
    "Cylinder": (jaxhf.Cylinder, np.array(2.0), np.array(-1.0), np.array(1.0)),
    "Skirt": (lambda *arrays: jaxhf.Skirt(*arrays, dx=1.0, dy=1.0, x0=0.0, y0=0.0),
              HEIGHTS[0], HEIGHTS[-1], HEIGHTS[:, 0], HEIGHTS[:, -1], np.array(0.0)),
    "HField": (jaxhf.mujoco.HField, HEIGHTS, np.ones(4), VECTOR, QUAT),
    "rays of cast": (lambda rays: array_leaf(rays, np.float32), HEIGHTS),
    "horizon": (lambda z: jaxhf.horizon(z, 2, dx=1.0), HEIGHTS),
    "hillshade": (lambda z: jaxhf.hillshade(z, 1.0), HEIGHTS),
    "start of a fit": (lambda z: make_heights("fit", "start", z, FIELD), HEIGHTS.astype(np.float64)),
    "targets and weights of a fit": (lambda image, weight: checked_pictures([SCENE], [image], [weight], None),
                                     HEIGHTS.astype(np.float64), HEIGHTS.astype(np.float64)),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_what_is_done_to_arrays_afterwards_changes_nothing(name):
    make, *arrays = MADE[name]
    arrays = [aligned(array) for array in arrays]
    made = make(*arrays)
    before = jax.tree.map(np.array, made)
    for array in arrays:
        array += 1
    jax.tree.map(np.testing.assert_array_equal, made, before)


# Heights in, heights or a map of them out.
OF_HEIGHTS = {
    "Heightfield": lambda z: jaxhf.Heightfield(z, 1.0).heights,
    "with_heights": lambda z: SCENE.with_heights(z).heights,
    "Terrain": lambda z: jaxhf.Terrain(z).heightfield().heights,
    "slope": lambda z: jaxhf.slope(z, 1.0),
    "hillshade": lambda z: jaxhf.hillshade(z, 1.0),
    "color_relief": lambda z: jaxhf.color_relief(z, "terrain"),
    "horizon": lambda z: jaxhf.horizon(z, 2, dx=1.0),
    "sky_view": lambda z: jaxhf.sky_view(z, 2, dx=1.0, weighting="horizontal"),
}
FILL = -9999
WHOLE = RNG.integers(0, 9, HEIGHTS.shape)
HOLE = np.zeros(HEIGHTS.shape, bool)
HOLE[1, 2] = True


def each_of(kinds):
    """Entrances and kinds of numbers; a Terrain takes floats only."""
    kept = [(name, kind) for name in OF_HEIGHTS for kind in map(np.dtype, kinds) if name != "Terrain" or kind.kind == "f"]
    return [(OF_HEIGHTS[name], kind, f"{name} of {kind}") for name, kind in kept if (name, kind.char) != ("Terrain", "g")]


def test_masked_heights_are_holes():
    expected = {name: of_heights(np.where(HOLE, np.nan, WHOLE).astype(np.float32)) for name, of_heights in OF_HEIGHTS.items()}
    for of_heights, kind, said in each_of((np.float32, np.float64, ">f4", np.int16, np.int64)):
        result = of_heights(np.ma.array(np.where(HOLE, FILL, WHOLE).astype(kind), mask=HOLE))
        np.testing.assert_allclose(result, expected[said.split()[0]], rtol=1e-6, err_msg=said)


def test_heights_of_any_real_kind_are_taken():
    """The whole numbers 0 to 8 have the same value in each."""
    expected = {name: np.asarray(of_heights(WHOLE.astype(np.float32))) for name, of_heights in OF_HEIGHTS.items()}
    for of_heights, kind, said in each_of((">f4", ">f8", ">i2", np.float16, ml_dtypes.bfloat16, np.longdouble, np.uint8)):
        result = np.asarray(of_heights(WHOLE.astype(kind)))
        np.testing.assert_allclose(result, expected[said.split()[0]], rtol=1e-6, err_msg=said)
        assert result.dtype == expected[said.split()[0]].dtype, said
    for kind in (jnp.float16, jnp.bfloat16, jnp.int8):
        heights = jaxhf.Heightfield(jnp.asarray(WHOLE, kind)).heights
        np.testing.assert_array_equal(heights, WHOLE.astype(np.float32))
        assert heights.dtype == np.float32


def mask_first(values: np.ndarray) -> np.ma.MaskedArray:
    masked = np.ma.array(values, mask=np.zeros(values.shape, bool))
    masked[(0,) * values.ndim] = np.ma.masked
    return masked


IMAGE = mask_first(np.ones((5, 6)))
REFUSED = {
    "Matte: albedo must be finite, it is [nan, ": lambda: jaxhf.Matte(mask_first(VECTOR)),
    "Object: world_from_object must be finite, it is [[nan, ": lambda: jaxhf.Object(FIELD, None, mask_first(POSE)),
    "Perspective: world_from_camera must be finite": lambda: jaxhf.Perspective(mask_first(POSE)),
    "look_at: eye must be finite, it is [nan, ": lambda: jaxhf.Perspective.look_at(mask_first(VECTOR), VECTOR),
    "Directional: towards must be finite, it is [nan, ": lambda: jaxhf.Directional(mask_first(VECTOR)),
    "ImageTexture: texels must be finite, row 0 column 0 is [nan, ": lambda: jaxhf.ImageTexture(mask_first(np.ones((2, 2, 3)))),
    "HField: data must lie from 0 to 1, it goes from nan": lambda: jaxhf.mujoco.HField(IMAGE, np.ones(4)),
    "fit: targets[0] must be finite where it has a weight; row 0 column 0": lambda: jaxhf.fit([SCENE], [IMAGE]),
    "fit: weights[0] must be finite": lambda: jaxhf.fit([SCENE], [np.ones((5, 6))], weights=[IMAGE]),
    "fit: start must be finite, row 0 column 0 is nan": lambda: jaxhf.fit([SCENE], [np.ones((5, 6))], start=IMAGE, noise=1.0),
    "Prior: std must be finite, from 0 on, not all 0; it is nan": lambda: jaxhf.Prior(0.0, IMAGE),
}


@pytest.mark.parametrize("message", REFUSED)
def test_masked_numbers_are_refused_where_there_can_be_no_hole(message):
    with pytest.raises(ValueError, match=re.escape(message)):
        REFUSED[message]()


def test_a_masked_pixel_of_a_picture_is_saved_as_nan(tmp_path):
    jaxhf.save_image(tmp_path / "a.npy", IMAGE)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), np.ma.filled(IMAGE, np.nan))


def test_a_grey_texture_is_one_of_three_equal_channels():
    for greys in (GREYS, jnp.asarray(GREYS)):
        np.testing.assert_array_equal(jaxhf.ImageTexture(greys).texels, np.repeat(GREYS[..., None], 3, axis=2))
