"""`jaxhf.mujoco.ray` against MuJoCo's own rays and their differences, and closed forms where those are wrong."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hfields import KINDS, SIZE, Reference, heights, matrix, rays

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


DOUBLE = [pytest.mark.x64, pytest.mark.deep]  # to the last bits of MuJoCo's numbers, which are double


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-5), pytest.param(np.float64, 1e-10, marks=DOUBLE)])
def test_equals_mujoco(dtype, tolerance):
    """In double precision but for a handful of the rays at edges, where MuJoCo's answer hangs on a rounding."""
    field = HField.from_model(TILTED.model, "ground")
    field = HField(field.data.astype(dtype), field.size, field.pos, field.quat)
    o, d = (value.astype(dtype).astype(np.float64) for value in cases(TILTED, GROUND))
    t, n = TILTED(o, d)
    scan = ray(field, o, d)
    ours, normals = np.asarray(scan.dist), np.asarray(scan.n)
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


def test_rays_along_an_axis_meet_what_mujocos_do():
    """From above, from below the surface, from within the base, and from beside the field."""
    reference = Reference(GROUND, SIZE)
    places = np.random.default_rng(4).uniform(-1.2, 1.2, (40, 3)) * [*SIZE[:2], SIZE[2:].max()]
    o, d = np.repeat(places.astype(np.float32).astype(float), 6, axis=0), np.tile(np.vstack([np.eye(3), -np.eye(3)]), (40, 1))
    scan, (t, n) = ray(HField(GROUND, SIZE), o, d), reference(o, d)
    np.testing.assert_allclose(scan.dist, t, atol=1e-5)
    np.testing.assert_allclose(scan.n, n, atol=1e-4)
    assert 0.2 < np.mean(t < 0) < 0.8


def test_no_ray_slips_through_where_mujoco_loses_some():
    """A steep ray from above at a vertex or an edge inside of the border has nothing before it, so that its t is 1."""
    data = heights(*GROUND.shape, seed=3) * 0.02
    o, d = rays("edges", data, SIZE, len(KINDS) * COUNT, 5)
    end = o + d
    inside = (np.abs(end[:, :2]) < 0.99 * SIZE[:2]).all(1)
    o, d = end - d * [0.02, 0.02, 1], d * [0.02, 0.02, 1]
    t = np.asarray(ray(HField(data, SIZE, quat=(2, 0, 0, 0)), o, d).dist)
    np.testing.assert_allclose(t[inside], 1, atol=1e-5)  # a ray's own numbers are single ones
    lost = np.abs(Reference(data, SIZE)(o[inside], d[inside])[0] - 1) > 1e-9
    assert lost.sum() > 10  # else MuJoCo is mended, and the docstring of `ray` says too much


def test_derivatives_are_differences_of_mujocos_rays():
    """Ray by ray along one change of everything, in single precision; backwards the same sum; none at a miss.

    MuJoCo holds heights in single precision, and steps are 1e-3: a difference is good to some 1e-4, but where a step leads
    into another triangle, as two sizes of steps tell.
    """
    o, d = cases(TILTED, GROUND)
    pick = np.concatenate([np.arange(k * COUNT, k * COUNT + 8) for k in range(4)])
    field, random = HField.from_model(TILTED.model, "ground"), np.random.default_rng(0)
    numbers = GROUND, SIZE, field.pos, field.quat, o[pick], d[pick]
    tangents = [random.normal(size=value.shape) for value in numbers]

    def met(eps):
        data, size, pos, quat, o, d = (
            np.asarray(value, float) + eps * tangent for value, tangent in zip(numbers, tangents, strict=True)
        )
        moved = Reference(data, size)
        moved.data.geom_xpos[1], moved.data.geom_xmat[1] = pos, matrix(quat).ravel()
        t, n = moved(o, d)
        return np.column_stack([t, n])

    whole, half = ((met(eps) - met(-eps)) / (2 * eps) for eps in (1e-3, 5e-4))
    smooth = np.abs(whole - half).max(1) < 2e-3 * (1 + np.abs(whole).max(1))
    assert smooth.sum() >= 26

    def both(numbers, tangents, weights):
        def cast(*numbers):
            scan = ray(HField(*numbers[:4]), *numbers[4:])
            return jnp.column_stack([scan.dist, scan.n])

        found, forward = jax.linearize(cast, *numbers)
        return found, forward(*tangents), jax.linear_transpose(forward, *numbers)(weights)

    singles = [tuple(np.asarray(value, np.float32) for value in values) for values in (numbers, tangents)]
    weights = random.normal(size=whole.shape).astype(np.float32)
    program = jax.jit(both, compiler_options=jaxhf.compiler_options())
    found, along, slopes = program(*singles, weights)
    np.testing.assert_allclose(along[smooth], whole[smooth], rtol=3e-3, atol=3e-3)
    assert np.abs(whole[smooth]).max(0).min() > 1e-2
    back = sum(np.vdot(slope, tangent) for slope, tangent in zip(slopes, tangents, strict=True))
    np.testing.assert_allclose(back, np.vdot(weights, along), rtol=1e-3)
    missed = np.asarray(found[:, 0]) < 0
    assert 3 < missed.sum() < 20
    assert not any(np.any(slope) for slope in program(*singles, weights * missed[:, None])[2])


@pytest.mark.deep
@pytest.mark.optimised  # to the bit
def test_bounds_at_hand_change_no_bit():
    rays, upright = cases(Reference(GROUND, SIZE), GROUND), HField(GROUND, SIZE)
    np.testing.assert_array_equal(ray(upright.prepared(), *rays).dist, ray(upright, *rays).dist)


def test_prepared_and_replaced():
    """`dataclasses.replace` makes a height field anew; a quat of zero turns nothing."""
    o, d = cases(Reference(GROUND, SIZE), GROUND)
    upright = HField(GROUND, SIZE)
    n = ray(upright, o, d).n
    turned = dataclasses.replace(upright.prepared(), quat=(0, 0, 0, 1))
    assert turned._grid is None
    np.testing.assert_allclose(
        ray(turned, o * [-1, -1, 1], d * [-1, -1, 1]).n, np.asarray(n) * np.array([-1, -1, 1], np.float32), atol=1e-5
    )
    np.testing.assert_array_equal(rotation(jnp.zeros(4)), np.eye(3))
    assert jnp.isfinite(jax.jacobian(rotation)(jnp.zeros(4))).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HField(2 * GROUND, SIZE), "HField: data must lie from 0 to 1, it goes from 0 to 2"),
        (lambda: HField(np.full((2, 2), np.nan), SIZE), "HField: data must lie from 0 to 1, it goes from nan to nan"),
        (lambda: HField(GROUND, SIZE, quat=jnp.zeros(4)), "HField: quat must not be zero"),
        (lambda: HField(GROUND, SIZE, pos=(0, np.inf, 0)), "HField: pos must be finite"),
        (lambda: HField(GROUND, (1, 1, 0, 1)), "HField: size must be positive"),
        (lambda: HField(GROUND, SIZE, quat=(1, 0, 0)), r"HField: quat must have shape \(4,\), its shape is \(3,\)"),
        (lambda: HField.from_model(TILTED.model, 0), "geom must be a height field, 0 is none"),
        (lambda: HField.from_model(TILTED.model, 99), r"geom must be a number from 0 to \d+, it is 99"),
        (lambda: HField.from_model(TILTED.model, "none"), "no geom there is named 'none'"),
        (lambda: ray(HField(np.stack([GROUND, GROUND]), SIZE), np.zeros(3), np.ones(3)), "ray: pnt must begin with the axes"),
    ],
)
def test_says_what_is_wrong(make, message):
    with pytest.raises(ValueError, match=message):
        make()
