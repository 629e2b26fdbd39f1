"""Terrain of every size: as few heights as there may be, and on either side of where XLA hands work to libraries.

It does so with sums and extrema of 4096 numbers and more. A skirt's walls have as many round 1024 x 1024 heights, and round
2 x 2050, which are cheaper to try.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhf

THIN = (2, 2050)
OTHERS = [(2, 2), (2050, 2), (1025, 3), (1023, 1023), (1024, 1024), (1201, 1201), (700, 1800), (2049, 2049)]
SIZES = [THIN, *(pytest.param(shape, marks=pytest.mark.slow) for shape in OTHERS)]


def heights(ny: int, nx: int) -> np.ndarray:
    """Rolling ground, with a hole where there is room for one."""
    y, x = np.mgrid[:ny, :nx]
    z = 5 * np.sin(x / 40) * np.cos(y / 60) + np.random.default_rng(0).random((ny, nx))
    z[ny // 3 : ny // 3 + ny // 10, nx // 3 : nx // 3 + nx // 10] = np.nan
    return z.astype(np.float32)


def block(z: np.ndarray) -> jaxhf.Scene:
    """It as a square with walls under it and a plate over its east, seen whole from the south."""
    ny, nx = z.shape
    dx, dy = 100 / (nx - 1), 100 / (ny - 1)
    field, plate = jaxhf.Heightfield(z, dx, dy), jaxhf.Heightfield(np.full((2, 2), 20, np.float32), 50.0, 50.0, x0=50.0)
    camera = jaxhf.Perspective.look_at((50, -100, 100), (50, 50, 0), fov=60, width=32, height=24)
    objects = [jaxhf.Object(field), jaxhf.Object(jaxhf.Skirt.of(field, -30.0)), jaxhf.Object(plate)]
    return jaxhf.Scene(objects, camera, [jaxhf.Directional.from_angles(225, 35)])


@pytest.mark.parametrize("shape", SIZES)
def test_pictures_and_gradients(shape):
    """Those of one's own program are those of `render`, and of its derivative; all have a finite one."""
    scene = block(heights(*shape))

    def picture(z):
        return jaxhf.render(scene.with_heights(z))

    plain, aovs = jaxhf.render(scene, aovs=("object",))
    assert set(np.unique(aovs["object"])) == {-1, 0, 1, 2}
    (_, inside), gradient = jax.jit(jax.value_and_grad(lambda z: ((image := picture(z)).sum(), image), has_aux=True))(
        scene.heights
    )
    same = np.isclose(plain, inside, atol=2e-3)
    assert same.mean() > 0.99  # a ray beside an edge may see the other side
    known = np.isfinite(heights(*shape))
    assert np.isfinite(gradient[known]).all()
    assert np.abs(gradient[known]).max() > 0


@pytest.mark.deep
@pytest.mark.parametrize("shape", SIZES)
def test_rays_and_maps(shape):
    z = heights(*shape)
    ny, nx = shape
    field = jaxhf.Heightfield(z, 1.0)
    iy, ix = np.argwhere(np.isfinite(z)).T
    iy, ix = iy[:: max(1, len(iy) // 50)], ix[:: max(1, len(ix) // 50)]
    o = np.stack([ix, iy, np.full(len(ix), 50.0)], -1).astype(np.float32)
    hit = jaxhf.cast(field, o, jnp.array([0.0, 0, -1]))
    np.testing.assert_allclose(hit.t[hit.status == jaxhf.Status.HIT], 50 - z[iy, ix][hit.status == jaxhf.Status.HIT], atol=1e-4)
    assert (hit.status == jaxhf.Status.HIT).mean() > 0.9  # a vertex beside a hole may be none
    down = jaxhf.mujoco.ray(
        jaxhf.mujoco.HField(np.clip(np.nan_to_num(z) / 20 + 0.5, 0, 1), (nx / 2, ny / 2, 10, 1)), (0, 0, 50), (0, 0, -1)
    )
    assert 40 <= down.dist <= 50
    maps = [
        jaxhf.hillshade(z, dx=1.0),
        jaxhf.slope(z, dx=1.0),
        jaxhf.aspect(z),
        jaxhf.relief(z, dx=1.0, shadows=True)[..., 0],
        jaxhf.sky_view(z, 4, dx=1.0),
        jaxhf.horizon(z, [315.0], dx=1.0)[0],
        jaxhf.vertex_normals(jnp.asarray(z), 1.0, 1.0, "six")[..., 0],
    ]
    assert all(values.shape == shape for values in maps)
    np.testing.assert_array_equal(np.isnan(maps[4]), np.isnan(z))
