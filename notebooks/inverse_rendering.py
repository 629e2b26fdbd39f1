# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From pictures to heights
#
# Three pictures of a real terrain under three suns, and a blurred idea of its heights: `jaxhf.fit` finds the heights
# that make the renderer's pictures agree with the measured ones. The cell below runs all of it, in about a minute,
# most of which JAX spends on compiling; what follows says what was done.

# %%
import matplotlib.pyplot as plt
import numpy as np
from scipy.ndimage import gaussian_filter

import jaxhf

# A real terrain, 3.5 km by 4.3 km, and what is known before: the same, smoothed over five cells.
terrain = jaxhf.jacksboro()
truth = terrain.heights[256:304, 320:368].astype(np.float32)
coarse = gaussian_filter(truth, 5, mode="nearest")
prior = jaxhf.Prior(coarse, std=float((coarse - truth).std()))

# Seen from above and a little from the south, under three low suns.
middle = np.array([23.5 * terrain.dx, 23.5 * terrain.dy, truth.mean()])
camera = jaxhf.Orthographic.look_at(middle + np.array([0, -2000, 8000]), middle, extent=3300, width=56, height=64)
suns = [jaxhf.Directional.from_angles(azimuth, altitude) for azimuth, altitude in ((315, 22), (75, 28), (195, 35))]


def scenes(heights):
    ground = jaxhf.Object(jaxhf.Heightfield(heights, dx=terrain.dx, dy=terrain.dy), jaxhf.Matte(0.7))
    return [jaxhf.Scene([ground], camera, [sun]) for sun in suns]


def pictures(heights):
    return [np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=16)))[..., 0] for scene in scenes(heights)]


noise = 0.006
random = np.random.default_rng(0)
measured = [image + noise * random.standard_normal(image.shape) for image in pictures(truth)]

found = jaxhf.fit(scenes(coarse), measured, prior=prior, draws=100)


def error(heights):
    """In metres; blank where no picture shows the ground."""
    return np.where(found.seen, np.asarray(heights) - truth, np.nan)


def rmse(heights):
    return np.sqrt(np.nanmean(error(heights) ** 2))


columns = ["measured", "before", "after", "error before", "error after"]
figure, axes = plt.subplots(3, 5, figsize=(9.8, 6.2), dpi=55, layout="constrained")
rows = zip(measured, pictures(coarse), found.images, strict=True)
for row, images in zip(axes, rows, strict=True):
    for axis, image in zip(row, images, strict=False):
        axis.imshow(image, cmap="gray", vmin=0, vmax=0.7)
for axis, heights in ((axes[0, 3], coarse), (axes[0, 4], found.heights)):
    shown = axis.imshow(error(heights), origin="lower", cmap="RdBu_r", vmin=-prior.std, vmax=prior.std)
figure.colorbar(shown, ax=axes[0, 3:], label="m")
for axis, heights in zip(axes[1, 3:], (coarse, found.heights), strict=True):
    axis.imshow(heights, origin="lower", cmap="viridis", vmin=truth.min(), vmax=truth.max())
    axis.set_title("heights before" if heights is coarse else "heights after")
axes[2, 3].imshow(truth, origin="lower", cmap="viridis", vmin=truth.min(), vmax=truth.max())
axes[2, 3].set_title("true heights")
for axis, name in zip(axes[0], columns, strict=True):
    axis.set_title(name)
for axis in axes.flat:
    axis.set_axis_off()
plt.show()
print(f"error of the heights: {rmse(coarse):.1f} m before, {rmse(found.heights):.1f} m after")

# %% [markdown]
# ## What went in
#
# - **Scenes and pictures**, one scene for each, with its camera and its sun. The heights in the scenes are the start.
# - **A prior**, the coarse map, and how far it is off (`std`). Without any map the pictures would still show the
#   shape, but not at what height above the sea it stands: all of them are taken from one side.
#
# That is all. The rest was chosen by what the pictures show: their noise, a robust loss, and points on the edges of
# shadows, whose place tells how high a ridge is ([gradients](gradients.ipynb) shows how).

# %%
print(f"{found.result.value}, after {found.stats['steps']} steps; chi2 {found.stats['chi2']:.2f}")
print(f"noise {noise}, estimated {found.noise.round(4)}")
print("\n".join(found.warnings))

# %% [markdown]
# `chi2` is the mean square of what is left of the pictures, in units of their noise: far above 1, something in the
# scene is wrong. The lines below it are warnings: what else speaks against the result.
#
# ## How it went
#
# Coarse to fine: at first only the longest waves of the terrain may move. One `fit` that may take only a few steps
# shows what it looks like on the way.

# %%
early = jaxhf.fit(scenes(coarse), measured, prior=prior, max_steps=2)
print(f"error of the heights after 2 steps: {rmse(early.heights):.1f} m")
figure, axes = plt.subplots(1, 2, figsize=(5.4, 2.4), dpi=60, layout="constrained")
for axis, (name, heights) in zip(axes, {"2 steps": early.heights, "the end": found.heights}.items(), strict=True):
    shown = axis.imshow(error(heights), origin="lower", cmap="RdBu_r", vmin=-prior.std, vmax=prior.std)
    axis.set_title(name)
    axis.set_axis_off()
figure.colorbar(shown, ax=axes, label="error, m")
plt.show()

# %% [markdown]
# ## How sure it is
#
# `draws=100` drew a hundred terrains that the pictures and the map allow, `found.samples`; their spread is `std`. Here
# the truth is known, so they can be checked. One error all heights share: how high all of the terrain stands, which the
# pictures show least. So the mean is looked at by itself, and then each height about it: were the deviations right and
# the errors normal, 68 % of the heights would lie within one of them and 95 % within two.

# %%
off = error(found.heights)[found.seen]
drawn = found.samples[:, found.seen] - np.asarray(found.heights)[found.seen]
means = drawn.mean(axis=1)
print(f"mean of the heights: {off.mean():.1f} m off, ± {means.std():.1f} m")
ratio = (off - off.mean()) / (drawn - means[:, None]).std(axis=0)
for k in (1, 2):
    print(f"within {k} std: {np.mean(np.abs(ratio) <= k):.0%}")
figure, axes = plt.subplots(1, 2, figsize=(7, 2.8), dpi=60, layout="constrained")
shown = axes[0].imshow(found.std, origin="lower", cmap="magma", vmin=0)
figure.colorbar(shown, ax=axes[0], label="std, m")
axes[1].hist(ratio, bins=np.linspace(-5, 5, 41), density=True, color="0.6")
at = np.linspace(-5, 5, 201)
axes[1].plot(at, np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi), "k")
axes[1].set_xlabel("error about the mean / std")
plt.show()

# %% [markdown]
# ## From here
#
# The same without Python: a file that names the pictures, and `jaxhf fit case.toml -o heights.tif --report
# report.html`. [Heights from pictures](../docs/guides/fitting.md) also says what exposures, albedo, masks and checkpoints
# are for; [Fits](../docs/measurements/fits.md) measures what each part is worth.
