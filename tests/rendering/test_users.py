"""What users do, as they do it: terrain of 30 m cells in UTM coordinates, in single precision, with `jax.grad` as it comes.

Pictures, and derivatives to which moving silhouettes and shadows belong, against NumPy in double precision.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracle

import jaxhf

UTM, ORIGIN = (5e5, 5e6), (0.0, 0.0)  # single precision has steps of 0.03 there, and of 0.5
CELL, WIDTH, HEIGHT, FOV = 30.0, 24, 16, 35.0
EYE, TARGET, TOWARDS = np.array([70.25, -120.75, 110.0]), np.array([92.0, 80.0, 10.0]), (-0.8, 0.1, 0.4)
X, Y = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7))
PEAK = np.exp(-((X - 0.35) ** 2 + (Y - 0.5) ** 2) / 0.03)
TERRAIN = (80 * PEAK + 5 * np.sin(5 * X + 3 * Y)).astype(np.float32)
# Positive at the peak's silhouette and negative at its shadow's end, so that what both add to a derivative has one sign.
WEIGHTS = np.broadcast_to(np.cos(np.pi * (np.arange(WIDTH) + 0.5) / WIDTH), (HEIGHT, WIDTH)).astype(np.float32)
SAMPLES = 4  # along each side of a pixel


@functools.cache
def found(corner: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The picture, and the gradient of its weighted sum by the heights."""
    offset = np.array([*corner, 0.0])
    camera = jaxhf.Perspective.look_at(EYE + offset, TARGET + offset, fov=FOV, width=WIDTH, height=HEIGHT)
    settings = jaxhf.Settings(shading="flat", samples=SAMPLES**2, edge_samples=20_000)

    def loss(heights: jax.Array) -> tuple[jax.Array, jax.Array]:
        field = jaxhf.Heightfield(heights, CELL, x0=corner[0], y0=corner[1])
        scene = jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(1.0))], camera, [jaxhf.Directional(TOWARDS)])
        image = jaxhf.render(scene, settings)
        return jnp.sum(WEIGHTS * image[..., 0]), image[..., 0]

    (_, image), slope = jax.value_and_grad(loss, has_aux=True)(jnp.asarray(TERRAIN))
    assert (image.dtype, slope.dtype) == (np.float32, np.float32)
    return np.asarray(image), np.asarray(slope)


def samples(heights: np.ndarray, side: int) -> np.ndarray:
    """All of a picture's samples by the oracle, those of a pixel in its last axes."""
    d = oracle.view_rays(EYE, TARGET, FOV, WIDTH * side, HEIGHT * side).reshape(-1, 3)
    light = oracle.sunlit(heights, CELL, CELL, *ORIGIN, np.broadcast_to(EYE, d.shape), d, TOWARDS)
    return light.reshape(HEIGHT, side, WIDTH, side).swapaxes(1, 2)


def test_a_picture_in_utm_coordinates_is_that_at_the_origin():
    """To the bit, and so is its gradient; the picture is the oracle's, but for samples within a rounding of an edge."""
    (image, slope), (far_image, far_slope) = found(ORIGIN), found(UTM)
    np.testing.assert_array_equal(far_image, image)
    np.testing.assert_array_equal(far_slope, slope)
    off = np.abs(image - samples(TERRAIN.astype(float), SAMPLES).mean((2, 3)))
    assert np.mean(off < 1e-5) > 0.98
    assert off.max() < 1.5 / SAMPLES**2
    assert 0.2 < np.mean(image == 0) < 0.8


def test_a_gradient_has_the_boundaries_share():
    """Against a central difference of pictures with 64 samples a pixel, in whose large step many of them change sides.

    In a tiny step none does, which leaves the derivative without the boundaries: a hundredth of it. The differences with steps
    and samples of half this size are 2 % off each other.
    """
    change = 24 * PEAK

    def along(step: float, side: int) -> float:
        ahead, behind = (samples(TERRAIN + sign * step * change, side).mean((2, 3)) for sign in (1, -1))
        return float(np.sum(WEIGHTS * (ahead - behind)) / (2 * step))

    numeric = along(0.2, 8)
    assert abs(along(1e-7, 4)) < 0.1 * abs(numeric)
    np.testing.assert_allclose(np.vdot(found(UTM)[1], change), numeric, rtol=0.05)
