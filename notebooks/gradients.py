# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What a derivative of a picture is
#
# Lift a mountain a little: which pixels get brighter (red), which darker (blue)? The cell below asks the renderer twice,
# without and with its boundary term, and takes differences of pictures as a judge. JAX compiles for half a minute first.

# %%
from functools import partial

import jax
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import gaussian_filter

import jaxhf

# Rolling ground, 3 by 2, and a mountain on it. All of it is lit from the left.
y, x = np.mgrid[-1:1:97j, -1.5:1.5:145j].astype(np.float32)
ground = 0.03 * np.sin(7 * x + 2 * y) * np.cos(5 * y - 2 * x) + 0.015 * np.cos(11 * x - 6 * y)
mountain = np.exp(-((x + 0.55) ** 2) / 0.03 - (y - 0.1) ** 2 / 0.12) * (1 + 0.25 * np.sin(9 * y + 1))
camera = jaxhf.Perspective.look_at((0.3, -3.0, 2.2), (0.0, -0.02, 0.05), fov=30, width=192, height=96)


def picture(height, azimuth, edge_samples=0, samples=4):
    """Grey, (96, 192): with a mountain of this height, and the sun in this direction, degrees clockwise from north."""
    field = jaxhf.Heightfield(ground + height * mountain, dx=1 / 48, dy=1 / 48, x0=-1.5, y0=-1.0)
    lights = [jaxhf.Directional.from_angles(azimuth, 22.0), jaxhf.Sky(0.25)]
    scene = jaxhf.Scene([jaxhf.Object(field, jaxhf.Matte(0.8))], camera, lights)
    return jaxhf.render(scene, jaxhf.Settings(samples=samples, edge_samples=edge_samples))[..., 0]


@partial(jax.jit, static_argnums=2)
def derivative(at, along, edge_samples):
    """The picture of `at` = (height, azimuth), and how it changes `along` such a pair."""
    return jax.jvp(partial(picture, edge_samples=edge_samples), at, along)


def differences(at, along, step):
    """The same from two pictures that are `step` apart on either side, with 576 samples a pixel."""
    plus, minus = (picture(*(a + sign * step * b for a, b in zip(at, along, strict=True)), samples=576) for sign in (1, -1))
    return (plus - minus) / (2 * step)


def show(pictures, scale):
    _, axes = plt.subplots(2, 2, figsize=(10, 5.4), dpi=64, layout="constrained")
    for axis, (name, image) in zip(axes.flat, pictures.items(), strict=True):
        if name == "picture":
            axis.imshow(np.clip(image, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        else:
            axis.imshow(image, cmap="RdBu_r", vmin=-scale, vmax=scale)
        axis.set_title(name)
        axis.set_axis_off()
    plt.show()


here, up = (0.4, 285.0), (1.0, 0.0)
view, shading = derivative(here, up, 0)
_, whole = derivative(here, up, 30_000)
judge = differences(here, up, step=0.004)
show({"picture": view, "derivative of the shading": shading, "with the boundary term": whole, "differences": judge}, 2)

# %% [markdown]
# ## Two parts of one derivative
#
# Inside a triangle, slopes get steeper or gentler, and shading follows. That is the *derivative of the shading*:
# each sample says how its own radiance changes. At the edge of a shadow nothing happens to a sample in the light,
# nor to one in the dark. But the edge moves, and pixels on its way change most. This *boundary term* is what
# `edge_samples` adds: points on the terrain's edges, followed to where their shadows fall.
#
# In numbers, beside the differences:


# %%
def compare(name, found, reference):
    cosine = np.vdot(found, reference) / np.linalg.norm(found) / np.linalg.norm(reference)
    error = np.linalg.norm(found - reference) / np.linalg.norm(reference)
    print(f"{name:25} cosine {cosine:.3f}   relative error {error:.2f}")


compare("derivative of the shading", shading, judge)
compare("with the boundary term", whole, judge)

# %% [markdown]
# Differences are no truth either. With a smaller step, fewer of their samples cross a moving edge; with a larger one,
# they blur it. Halve the step, and they differ from themselves by this much:

# %%
compare("half the step", differences(here, up, step=0.002), judge)

# %% [markdown]
# ## The same for the sun
#
# Any number of a scene will do. Turn the sun by a degree clockwise: slopes that face it change a little, shadows
# swing round. The programs are the ones from above, along another direction.

# %%
turn = (0.0, 1.0)
_, shading = derivative(here, turn, 0)
_, whole = derivative(here, turn, 30_000)
judge = differences(here, turn, step=0.3)
show({"picture": view, "derivative of the shading": shading, "with the boundary term": whole, "differences": judge}, 0.03)
compare("derivative of the shading", shading, judge)
compare("with the boundary term", whole, judge)

# %% [markdown]
# ## What it is good for
#
# Somebody made the mountain higher, turned the sun, and left a photograph. It shows only the plain on the right, with
# the tip of the mountain's shadow. By how much?
#
# Gauss and Newton's method asks, again and again, which step along the two derivatives explains what is left. Both
# pictures are blurred first, so that shadows that do not overlap yet can feel each other.


# %%
def blurred(image):
    """The plain beyond the mountain, as one long vector."""
    return gaussian_filter(np.asarray(image)[40:, 95:], 6).ravel()


photograph = picture(0.5, 291.0, samples=576)
figure, axes = plt.subplots(1, 2, figsize=(7, 2.1), dpi=64, layout="constrained")
for axis, (name, image) in zip(axes, {"photograph": photograph, "where it begins": view}.items(), strict=True):
    axis.imshow(np.clip(image[40:, 95:], 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    axis.set_title(name)
    axis.set_axis_off()
plt.show()
for name, edge_samples in {"with the boundary term": 30_000, "derivative of the shading": 0}.items():
    at = np.array(here)
    for step in range(5):
        (now, lifted), (_, turned) = (derivative(tuple(at), along, edge_samples) for along in (up, turn))
        left = blurred(photograph - now)
        at += np.linalg.lstsq(np.stack([blurred(lifted), blurred(turned)], 1), left)[0]
        print(f"{name:25} step {step + 1}: height {at[0]:9.3f}, azimuth {at[1]:7.2f}")

# %% [markdown]
# With the boundary term: a height of 0.5 and 291 degrees, after three steps. Without it the plain knows nothing of the
# mountain but the foot of its slope, and the steps run away.
#
# `jaxhf.fit` does the same for all heights at once, and chooses the number of points by what is in sight. The
# page [Exact derivatives](../docs/tutorials/exactness.md) computes one by hand, and
# [The boundary term](../docs/concepts/boundary.md) says how the points are drawn.
