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
# Three pictures of a real terrain, under three suns, and a blurred idea of its heights: `jaxhf.fit` finds the heights
# that make the renderer's pictures agree with the measured ones. Every picture is rendered, compared and
# differentiated; no step here is specific to this terrain. It takes a few minutes on two cores, most of
# which JAX spends on compiling.

# %%
import time

import matplotlib.pyplot as plt
import numpy as np

import jaxhf

plt.rcParams.update({"figure.dpi": 70, "image.cmap": "gray", "figure.constrained_layout.use": True})

# %% [markdown]
# ## A terrain and its pictures
#
# 48 x 48 heights of the valley of the Jacksboro fault in Tennessee, about 3.5 km by 4.3 km, seen from above and a
# little from the south. The suns stand low, so ridges throw shadows. The measurement is made with four times as many
# rays a pixel as the fit will use, and with noise: one percent of the brightest pixel.

# %%
terrain = jaxhf.jacksboro()
truth = terrain.heights[256:304, 320:368].astype(np.float32)
width, depth = 47 * terrain.dx, 47 * terrain.dy
middle = (width / 2, depth / 2, float(truth.mean()))
camera = jaxhf.Orthographic.look_at((middle[0], middle[1] - 2000, middle[2] + 8000), middle, extent=3300, width=56, height=64)
suns = [jaxhf.Directional.from_angles(azimuth, altitude) for azimuth, altitude in ((315, 22), (75, 28), (195, 35))]


def scenes(heights):
    field = jaxhf.Object(jaxhf.Heightfield(heights, dx=terrain.dx, dy=terrain.dy), jaxhf.Matte(0.7))
    return [jaxhf.Scene([field], camera, [sun]) for sun in suns]


def pictures(heights, samples=4):
    return [np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=samples)))[..., 0] for scene in scenes(heights)]


rng = np.random.default_rng(0)
targets = pictures(truth, samples=16)
noise = 0.01 * max(float(target.max()) for target in targets)
targets = [target + noise * rng.standard_normal(target.shape) for target in targets]


def show(rows, names, vmax):
    _, axes = plt.subplots(len(rows), 3, figsize=(7.5, 2.75 * len(rows)), squeeze=False)
    for line, row, name in zip(axes, rows, names, strict=True):
        for axis, image in zip(line, row, strict=True):
            axis.imshow(image, vmin=0, vmax=vmax)
            axis.set_xticks([])
            axis.set_yticks([])
        line[0].set_ylabel(name)
    plt.show()


brightest = max(float(target.max()) for target in targets)
show([targets], ["measured"], brightest)

# %% [markdown]
# ## What is known before
#
# A coarse map: the same terrain, smoothed over five cells. How far it is off is taken as known too (`prior_std`): it
# is what balances the map against the pictures. Without any map the pictures would still show the shape, but not at
# what height above the sea it stands: all of them are taken from one side.


# %%
def smoothed(heights, cells):
    for axis, count in enumerate(heights.shape):
        at = np.arange(count)
        kernel = np.exp(-0.5 * ((at[:, None] - at) / cells) ** 2)
        heights = np.moveaxis(np.tensordot(kernel / kernel.sum(1, keepdims=True), heights, (1, axis)), 0, axis)
    return heights.astype(np.float32)


coarse = smoothed(truth, 5)
prior_std = float((coarse - truth).std())
print(f"relief {np.ptp(truth):.0f} m; the coarse map is off by {prior_std:.1f} m")

# %% [markdown]
# ## The fit: before, during and after
#
# Scenes, pictures, and the map with how far it is off: the rest is chosen by what the pictures show. The noise is
# estimated, too. A fit that may take only a few steps shows what it looks like on the way.

# %%
FIT = dict(prior=coarse, prior_std=prior_std)


def run(settings=None, **options):
    begin = time.perf_counter()
    found = jaxhf.fit(scenes(coarse), targets, settings=settings, **{**FIT, "max_steps": 40, **options})
    return found, time.perf_counter() - begin


def rmse(found):
    """Over the heights that are in sight, metres."""
    return float(np.sqrt(np.mean((np.asarray(found.heights) - truth)[found.seen] ** 2)))


after, seconds = run(uncertainty=12)
during, _ = run(max_steps=4)
before = float(np.sqrt(np.mean((coarse - truth)[after.seen] ** 2)))
print(f"{after.result.value}, after {after.stats['steps']} steps and {seconds:.0f} s, chi2 {after.stats['chi2']:.2f}")
print(f"RMSE before {before:.1f} m, during {rmse(during):.1f} m, after {rmse(after):.2f} m")
print(f"noise {noise:.4f}, estimated {after.noise.round(4)}")
print("\n".join(after.warnings))

# %%
show(
    [targets, pictures(coarse), during.images, after.images],
    ["measured", "before", "after 4 steps", f"after {after.stats['steps']} steps"],
    brightest,
)

# %%
figure, axes = plt.subplots(2, 3, figsize=(8.5, 6.2))
for column, (name, heights) in enumerate((("before", coarse), ("during", during.heights), ("after", after.heights))):
    heights = np.asarray(heights)
    axes[0, column].imshow(heights, origin="lower", cmap="viridis", vmin=truth.min(), vmax=truth.max())
    axes[0, column].set_title(f"heights {name}")
    error = np.where(after.seen, heights - truth, np.nan)
    shown = axes[1, column].imshow(error, origin="lower", cmap="RdBu_r", vmin=-prior_std, vmax=prior_std)
    axes[1, column].set_title("their error")
figure.colorbar(shown, ax=axes[1], label="m")
plt.show()

# %% [markdown]
# White round the error maps is what no picture shows (`seen`).
#
# ## The role of shadows
#
# A shadow is dark because something else stands in the light: darkness there says nothing about the slope of the
# ground on which it lies. A renderer without shadows takes it for a steep slope. A renderer with shadows knows
# better, and its derivative tells how the shadow's edge moves with the ridge (`docs/concepts/boundary.md`). A fit includes that
# by itself where shadows or silhouettes are in sight; `edge_samples=0` leaves it out. The loss is robust: it lets the few
# pixels go that the scene cannot explain. `loss="squares"` does not. Here the scene explains them all, so squares, which
# forget nothing, come a little nearer.

# %%
trials = {
    "no shadows": run(jaxhf.Settings(shadows=False)),
    "shadows, still edges": run(jaxhf.Settings(edge_samples=0)),
    "shadows, squares": run(loss="squares"),
    "shadows": (after, seconds),
}
for name, (found, elapsed) in trials.items():
    print(f"{name:34} RMSE {rmse(found):5.2f} m, {found.stats['steps']:3} steps, {elapsed:3.0f} s with compiling")

# %%
figure, axes = plt.subplots(1, len(trials), figsize=(10, 3))
for axis, (name, (found, _)) in zip(axes, trials.items(), strict=True):
    error = np.where(found.seen, np.asarray(found.heights) - truth, np.nan)
    shown = axis.imshow(error, origin="lower", cmap="RdBu_r", vmin=-prior_std, vmax=prior_std)
    axis.set_title(name, fontsize=9)
    axis.set_axis_off()
figure.colorbar(shown, ax=axes, label="error, m")
plt.show()

# %% [markdown]
# ## Accuracy against time
#
# Fewer steps cost less and leave more error. From coarse to fine (the default levels) against all modes at once; the
# times are those of compiled programs. And fewer pictures: a very large `noise` takes a picture out of the balance.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2))
for name, levels in (("coarse to fine", None), ("all at once", [1.0])):
    line = []
    for steps in (2, 4, 8, 16):
        found, elapsed = run(levels=levels, max_steps=steps)
        line.append((elapsed, rmse(found)))
        print(f"{name:15} {steps:3} steps: RMSE {line[-1][1]:5.2f} m in {elapsed:5.1f} s")
    left.loglog(*zip(*line, strict=True), "o-", label=name)
left.set_xlabel("seconds")
left.set_ylabel("RMSE, m")
left.legend()
errors = [before]
for count in (1, 2):
    found, _ = run(noise=[noise if k < count else 1e6 * noise for k in range(3)])
    errors.append(float(np.sqrt(np.mean((np.asarray(found.heights) - truth)[after.seen] ** 2))))
errors.append(rmse(after))
right.semilogy(range(4), errors, "o-")
right.set_xticks(range(4))
right.set_xlabel("pictures")
plt.show()
print("RMSE with 0, 1, 2 and 3 pictures:", ", ".join(f"{error:.2f} m" for error in errors))

# %% [markdown]
# ## How sure it is
#
# `uncertainty=12` drew twelve terrains that the pictures and the map allow; their spread is `std`. Here the truth is
# known, so the deviations can be checked: were they right and the errors normal, 68 % of the heights would lie within
# one of them and 95 % within two.

# %%
ratio = ((np.asarray(after.heights) - truth) / after.std)[after.seen]
for k in (1, 2):
    print(f"within {k} std: {np.mean(np.abs(ratio) <= k):.0%}")
figure, axes = plt.subplots(1, 2, figsize=(7, 3))
shown = axes[0].imshow(after.std, origin="lower", cmap="magma", vmin=0)
figure.colorbar(shown, ax=axes[0], label="std, m")
axes[1].hist(ratio, bins=np.linspace(-5, 5, 41), density=True, color="0.6")
at = np.linspace(-5, 5, 201)
axes[1].plot(at, np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi), "k")
axes[1].set_xlabel("error / std")
plt.show()

# %% [markdown]
# ## From here
#
# The same without Python: a file that names the pictures, and `jaxhf fit case.toml -o heights.tif --report
# report.html`; see `docs/guides/fitting.md`, which also says what exposures, albedo, masks and checkpoints are for.
