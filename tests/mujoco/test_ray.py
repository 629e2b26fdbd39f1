"""`jaxhf.mujoco.ray` against MuJoCo's own rays, closed forms where those are wrong, and central differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hfields import KINDS, SIZE, Reference, heights, rays

import jaxhf
from jaxhf.mujoco import HField, ray
from jaxhf.mujoco.pose import rotation

COUNT = 400  # of each kind of ray
GROUND = heights(9, 6)
TILTED = Reference(GROUND, SIZE, 'pos="1 -2 .5" quat=".9 .1 -.2 .4"', 'pos="-3 1 2" euler="20 -30 140"')


def cases(reference: Reference, data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    parts = [rays(kind, data, SIZE, COUNT, seed) for seed, kind in enumerate(KINDS)]
    o, d = (np.concatenate(part) for part in zip(*parts, strict=True))
    return reference.in_world(o, d)


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-10), (np.float32, 1e-5)])
def test_equals_mujoco(dtype, tolerance):
    """In double precision but for a handful of the rays at edges, where MuJoCo's answer hangs on a rounding."""
    field = HField.from_model(TILTED.model, "ground")
    field = HField(field.data.astype(dtype), field.size, field.pos, field.quat)
    o, d = (value.astype(dtype).astype(np.float64) for value in cases(TILTED, GROUND))
    t, n = TILTED(o, d)
    ours, normals = (np.asarray(value) for value in ray(field, o, d))
    # By the part of a difference that leads away from what was met: along a grazing ray roundings are drawn out.
    length = np.linalg.norm(d, axis=1)
    off = np.abs(ours - t) * (length if dtype == np.float64 else np.abs((d * n).sum(1))) / np.linalg.norm(SIZE[:2])
    wrong = ((ours < 0) != (t < 0)) | (off > tolerance) | (np.abs(normals - n).max(1) > 1e3 * tolerance)
    at_edge = np.repeat([kind == "edges" for kind in KINDS], COUNT)
    assert not (wrong & ~at_edge).any(), np.flatnonzero(wrong & ~at_edge)
    # There ours is what MuJoCo says of one of the rays a hair beside it.
    beside = np.random.default_rng(1).normal(size=(64, 1, 3)) * 1e-6
    close = [TILTED(o[wrong] + shift, d[wrong])[0] for shift in beside]
    assert (np.abs(np.array(close) - ours[wrong]) < 1e-4).any(0).all()
    assert 0.05 < (t < 0).mean() < 0.5


def test_no_ray_slips_through_where_mujoco_loses_some():
    """A steep ray from above at a vertex or an edge inside of the border has nothing before it, so that its t is 1."""
    data = heights(*GROUND.shape, seed=3) * 0.02
    o, d = rays("edges", data, SIZE, len(KINDS) * COUNT, 5)
    end = o + d
    inside = (np.abs(end[:, :2]) < 0.99 * SIZE[:2]).all(1)
    o, d = end - d * [0.02, 0.02, 1], d * [0.02, 0.02, 1]
    upright = HField(data.astype(np.float64), SIZE, quat=(2, 0, 0, 0))
    t = np.asarray(ray(upright, o, d)[0])
    np.testing.assert_allclose(t[inside], 1, atol=1e-9)
    lost = np.abs(Reference(data, SIZE)(o[inside], d[inside])[0] - 1) > 1e-9
    assert lost.sum() > 10  # else MuJoCo is mended, and the docstring of `ray` says too much


def test_gradients_match_central_differences():
    """Of distances and normals of triangles, walls and base, in the heights, size, pose and rays; none at a miss."""
    o, d = cases(TILTED, GROUND)
    pick = np.concatenate([np.arange(k * COUNT, k * COUNT + 8) for k in range(4)])
    field = HField.from_model(TILTED.model, "ground")
    numbers = tuple(map(jnp.asarray, (GROUND.astype(np.float64), SIZE, field.pos, field.quat, o[pick], d[pick])))

    def weighted(numbers, weights):
        t, n = ray(HField(*numbers[:4]), *numbers[4:])
        return weights @ t + (weights @ n).sum(), t

    program = jax.jit(jax.value_and_grad(weighted, has_aux=True), compiler_options=jaxhf.compiler_options())
    random, eps = np.random.default_rng(0), 1e-6
    weights = jnp.asarray(random.normal(size=len(pick)))
    tangents = tuple(jnp.asarray(random.normal(size=value.shape)) for value in numbers)
    (_, t), slopes = program(numbers, weights)
    (ahead, _), (behind, _) = (
        program(tuple(value + sign * eps * tangent for value, tangent in zip(numbers, tangents, strict=True)), weights)[0]
        for sign in (1, -1)
    )
    along = [jnp.vdot(slope, tangent) for slope, tangent in zip(slopes, tangents, strict=True)]
    assert all(abs(part) > 1e-2 for part in along)
    np.testing.assert_allclose(sum(along), (ahead - behind) / (2 * eps), rtol=1e-6)
    missed = np.asarray(t) < 0
    assert 3 < missed.sum() < 20
    assert all((slope == 0).all() for slope in program(numbers, jnp.asarray(missed.astype(np.float64)))[1])


def test_prepared_and_replaced():
    """Bounds at hand change no bit; `dataclasses.replace` makes a height field anew; a quat of zero turns nothing."""
    o, d = cases(Reference(GROUND, SIZE), GROUND)
    upright = HField(GROUND.astype(np.float64), SIZE)
    t, n = ray(upright, o, d)
    np.testing.assert_array_equal(ray(upright.prepared(), o, d)[0], t)
    turned = dataclasses.replace(upright.prepared(), quat=(0, 0, 0, 1))
    assert turned._grid is None
    np.testing.assert_allclose(ray(turned, o * [-1, -1, 1], d * [-1, -1, 1])[1], np.asarray(n) * [-1, -1, 1], atol=1e-12)
    np.testing.assert_array_equal(rotation(jnp.zeros(4)), np.eye(3))
    assert jnp.isfinite(jax.jacobian(rotation)(jnp.zeros(4))).all()


def test_says_what_is_wrong():
    with pytest.raises(ValueError, match="HField: data must lie from 0 to 1, it goes from 0 to 2"):
        HField(2 * GROUND, SIZE)
    with pytest.raises(ValueError, match="HField: data must lie from 0 to 1, it goes from nan to nan"):
        HField(np.full((2, 2), np.nan), SIZE)
    with pytest.raises(ValueError, match="HField: quat must not be zero"):
        HField(GROUND, SIZE, quat=jnp.zeros(4))
    with pytest.raises(ValueError, match="HField: pos must be finite"):
        HField(GROUND, SIZE, pos=(0, np.inf, 0))
    with pytest.raises(ValueError, match="HField: size must be positive"):
        HField(GROUND, (1, 1, 0, 1))
    with pytest.raises(ValueError, match=r"HField: quat must have shape \(4,\), its shape is \(3,\)"):
        HField(GROUND, SIZE, quat=(1, 0, 0))
    with pytest.raises(ValueError, match="geom must be a height field, 0 is none"):
        HField.from_model(TILTED.model, 0)
    with pytest.raises(ValueError, match=r"geom must be a number from 0 to \d+, it is 99"):
        HField.from_model(TILTED.model, 99)
    with pytest.raises(ValueError, match="no geom there is named 'none'"):
        HField.from_model(TILTED.model, "none")
    with pytest.raises(ValueError, match="ray: pnt must begin with the axes"):
        ray(HField(np.stack([GROUND, GROUND]), SIZE), np.zeros(3), np.ones(3))
