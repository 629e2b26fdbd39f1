"""Simulations that have terrains of their own, as those of MJX's models whose `hfield_data` is a batch."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
from hfields import model_of, mujoco, mujocos_rays

from jaxhf.mujoco import Geoms, HField, height_scan, ray

MODEL, _ = model_of(np.random.default_rng(5), 2, 6)
OWN = np.random.default_rng(0).uniform(size=(3, MODEL.nhfielddata)).astype(np.float32)
NAMES = [name for name in dir(MODEL) if name.startswith(("ngeom", "geom_", "hfield_", "body_", "mat_"))]


def with_data(data) -> types.SimpleNamespace:
    """What MJX's model would be: it has MuJoCo's arrays, and JAX's for the heights."""
    return types.SimpleNamespace(**{name: getattr(MODEL, name) for name in NAMES} | {"hfield_data": data})


def test_each_simulation_meets_its_own_terrain():
    """One that stands still and one that a joint moves, among primitives; all placed by a batch of data, also twice."""
    o, to = np.random.default_rng(1).uniform(-4, 4, (2, 3, 700, 3)).astype(np.float32).astype(float)
    states, wanted, kept = [], [], MODEL.hfield_data.copy()
    for k in range(3):
        state = mujoco.MjData(MODEL)
        state.qpos[:] += 0.3 * np.random.default_rng(k).normal(size=MODEL.nq)
        MODEL.hfield_data[:] = OWN[k]
        mujoco.mj_forward(MODEL, state)
        wanted.append(mujocos_rays(MODEL, state, o[k], to[k] - o[k]))
        states.append(state)
    MODEL.hfield_data[:] = kept
    batch = types.SimpleNamespace(
        geom_xpos=np.stack([state.geom_xpos for state in states]), geom_xmat=np.stack([state.geom_xmat for state in states])
    )
    geoms = Geoms.from_model(with_data(jnp.asarray(OWN)))
    assert geoms.fixed == (True, False)
    assert geoms.batch == (3,)
    one = Geoms.from_model(MODEL)
    replaced = dataclasses.replace(one, hfields=geoms.hfields)
    for given in (geoms, replaced, geoms.prepared(), geoms.at(batch)):
        scan = ray(given.at(batch), o, to - o)
        for k, (t, n, geom) in enumerate(wanted):
            # By the part of a difference that leads away from what was met: along a grazing ray roundings are drawn out.
            off = np.abs(np.asarray(scan.dist[k]) - t) * np.abs(((to[k] - o[k]) * n).sum(1))
            assert np.sum((np.asarray(scan.geom)[k] != geom) | (off > 1e-5)) <= 1  # past an edge
            assert np.isin([0, 1], geom).all()


def test_a_terrain_that_is_traced():
    """From a model whose heights `jit` and `vmap` trace."""

    def scan(data, pos):
        return height_scan(HField.from_model(with_data(data), 0), pos, (1.0, 0, 0, 0)).heights

    pos = HField.from_model(MODEL, 0).pos + np.random.default_rng(2).uniform(-0.3, 0.3, (3, 3))
    fields = HField.from_model(with_data(OWN), 0)
    heights = height_scan(fields, pos, np.tile([1.0, 0, 0, 0], (3, 1))).heights
    np.testing.assert_allclose(jax.jit(jax.vmap(scan))(OWN, pos), heights, atol=1e-5)
