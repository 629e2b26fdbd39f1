# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A robot that walks by a height scan
#
# Six legs on rubble, in MJX, MuJoCo's simulation in JAX. The yellow dots are what the robot knows of the ground:
# `jaxhf.mujoco.height_scan` round each foot. Below it walks by them, and without them, on 16 terrains. All of it takes
# about a minute, and needs `pip install mujoco mujoco-mjx` besides jaxhf.

# %%
import contextlib
import os
import sys

if sys.platform == "linux":
    os.environ.setdefault("MUJOCO_GL", "egl")  # pictures without a window

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from jaxhf.mujoco import HField, grid_pattern, height_scan

with contextlib.redirect_stdout(None):  # it says that Warp is not installed, which is not used
    from mujoco import mjx

# A leg swings about its hip and changes its length. Feet are balls, and they alone touch the ground.
HEIGHT, HIPS = 0.3, np.array([(x, y) for x in (0.28, 0, -0.28) for y in (0.2, -0.2)])
leg = """<body pos="{x} {y} 0"><joint name="swing{k}" axis="0 -1 0" damping="1" armature="0.01"/>
  <geom class="limb" fromto="0 0 0 0 0 -0.18" size="0.022" mass="0.2"/>
  <body pos="0 0 -0.3"><joint name="length{k}" type="slide" axis="0 0 1" damping="40" armature="0.05"/>
    <geom class="limb" fromto="0 0 0 0 0 0.18" size="0.014" mass="0.1"/>
    <geom name="foot{k}" size="0.035" mass="0.05" contype="2" rgba="0.1 0.1 0.12 1"/></body></body>"""
motors = """<position joint="swing{k}" kp="60" forcerange="-30 30"/>
  <position joint="length{k}" kp="2500" forcerange="-120 120" ctrllimited="true" ctrlrange="-0.12 0.2"/>"""
SIZE = (6, 1.5, 0.5, 0.2)  # of the height field: half of its extent in x and in y, the height of 1, the base
# Sparse matrices and conjugate gradients do without batches of Cholesky factors, in which jaxlib 0.10.2 may hang on a CPU.
model = mujoco.MjModel.from_xml_string(f"""<mujoco>
  <option timestep="0.005" solver="CG" iterations="8" ls_iterations="5" jacobian="sparse"/>
  <custom><numeric name="max_contact_points" data="12"/></custom>
  <visual><headlight ambient="0.45 0.45 0.48" diffuse="0.1 0.1 0.1"/><global offwidth="960" offheight="400"/></visual>
  <default><default class="limb"><geom type="capsule" contype="0" conaffinity="0" rgba="0.75 0.77 0.8 1"/></default></default>
  <asset><hfield name="rubble" nrow="31" ncol="121" size="{" ".join(map(str, SIZE))}"/>
    <texture type="skybox" builtin="gradient" rgb1="0.75 0.83 0.92" rgb2="0.4 0.55 0.75" width="32" height="192"/></asset>
  <worldbody><light directional="true" pos="0 0 4" dir="0.6 0.7 -0.6" diffuse="0.85 0.8 0.7"/>
    <geom type="hfield" hfield="rubble" contype="0" conaffinity="2" rgba="0.58 0.5 0.4 1"/>
    <body pos="-5.3 0 0.34"><freejoint/>
      <geom type="box" size="0.34 0.12 0.04" mass="3" contype="0" conaffinity="0" rgba="0.85 0.4 0.15 1"/>
      {"".join(leg.format(k=k, x=x, y=y) for k, (x, y) in enumerate(HIPS))}</body></worldbody>
  <actuator>{"".join(motors.format(k=k) for k in range(6))}</actuator></mujoco>""")
FEET = np.array([model.geom(f"foot{k}").id for k in range(6)])
PLACES = grid_pattern((0.2, 0.08), 0.04) + np.array([0.06, 0])  # 6 x 3 round a foot, most of them ahead
HERE = np.hypot(*PLACES.T).argmin()


def rubble(seed):
    """Data of the height field: blocks of 0.3 m, up to 0.12 m high, beyond a metre of level ground."""
    blocks = np.kron(np.random.default_rng(seed).uniform(0, 0.12, (11, 41)), np.ones((3, 3)))[:31, :121]
    level = np.linspace(-SIZE[0], SIZE[0], 121) < -4.85
    return np.where(level, 0, blocks / SIZE[2]).astype(np.float32)


def picture(heights, qpos):
    """The robot, and what scans round its feet meet."""
    model.hfield_data[:], data = heights.ravel(), mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = data.qpos[:3] - [0, 0, 0.15], 1.5, 125, -20
    with mujoco.Renderer(model, 400, 960) as renderer:
        renderer.update_scene(data, camera)
        scan = height_scan(HField(heights, SIZE), data.geom_xpos[FEET], np.tile(data.qpos[3:7], (6, 1)), PLACES)
        for p in np.asarray(scan.p, float).reshape(-1, 3):
            dot = renderer.scene.geoms[renderer.scene.ngeom]
            mujoco.mjv_initGeom(dot, mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.011), p, np.eye(3).ravel(), [1, 0.85, 0.1, 1])
            renderer.scene.ngeom += 1
        return renderer.render()


# It stands at x = -1: each leg is as much shorter as its foot stands higher.
ground = height_scan(HField(rubble(100), SIZE), (-1, 0, 0), (1, 0, 0, 0), HIPS).heights
standing = np.zeros(model.nq)
standing[:7] = -1, 0, ground.mean() + HEIGHT + 0.03, 1, 0, 0, 0
standing[8::2] = ground - ground.mean()
figure, axis = plt.subplots(figsize=(9.6, 4), dpi=64, layout="constrained")
axis.imshow(picture(rubble(100), standing))
axis.set_axis_off()
plt.show()

# %% [markdown]
# ## The gait
#
# Three legs carry the robot, three swing forward, and then the others. So far it is a clock, the same for all. Two
# things come from the scan: a leg is as much shorter as its foot stands higher, and a swinging foot is lifted over the
# highest of the places round it.
#
# All of it is a program for one robot on one terrain. `jax.vmap` makes it one for 128 walks: blind or not, four clearances,
# 16 terrains.

# %%
PERIOD, STRIDE, CARRIES = 1.0, 0.24, 0.55  # seconds, metres, and the share of a period for which a foot carries
simulated = mjx.put_model(model)


def targets(field, data, t, clearance, looks):
    """Where the motors are to hold the joints (12,), and which feet are in the middle of their swing."""
    phase = (t / PERIOD + np.array([0, 0.5, 0.5, 0, 0, 0.5])) % 1
    carries, swung = phase < CARRIES, jnp.clip((phase - CARRIES) / (1 - CARRIES), 0, 1)
    x = STRIDE * jnp.where(carries, 0.5 - phase / CARRIES, swung**2 * (3 - 2 * swung) - 0.5)
    w, i, j, k = quat = data.qpos[3:7]
    left = jnp.arctan2(2 * (w * k + i * j), 1 - 2 * (j**2 + k**2)) + 0.5 * data.qpos[1]  # of the line that it is to keep
    x = x * (1 + jnp.clip(left, -0.5, 0.5) * np.sign(HIPS[:, 1]))
    lift = jnp.sin(jnp.pi * swung)
    scan = height_scan(field, data.geom_xpos[FEET], jnp.tile(quat, (6, 1)), PLACES)
    here, highest = scan.heights[:, HERE], scan.heights.max(1)
    ground = here + lift * (highest - here) - jnp.sum(here * carries) / jnp.sum(carries)
    z = clearance * lift - HEIGHT + jnp.where(looks, ground, 0)
    return jnp.stack([jnp.arctan2(x, -z), HEIGHT - jnp.hypot(x, z)], 1).ravel(), (swung > 0.25) & (swung < 0.75)


def walk(heights, clearance, looks):
    """Twelve seconds: joints and feet at 50 Hz, and which feet touch the ground in the middle of their swing."""
    field, terrain = HField(heights, SIZE), simulated.replace(hfield_data=heights.ravel())

    def tick(data, t):
        ctrl, swings = targets(field, data, t, clearance, looks)
        data = jax.lax.fori_loop(0, 4, lambda _, data: mjx.step(terrain, data), data.replace(ctrl=ctrl))
        contact = data._impl.contact
        touches = jnp.any((contact.geom[:, 1, None] == FEET) & (contact.dist[:, None] < 0), 0)
        return data, (data.qpos, data.geom_xpos[FEET], swings, touches & swings)

    return jax.lax.scan(tick, mjx.make_data(model), jnp.arange(600) * 0.02)[1]


terrains = np.stack([rubble(seed) for seed in range(100, 116)])
clearances = np.array([0.04, 0.08, 0.12, 0.16])
shape = (2, len(clearances), len(terrains))  # looks or not, clearance, terrain
given = np.broadcast_to(terrains, (*shape, 31, 121)), np.broadcast_to(clearances[:, None], shape), np.indices(shape)[0] == 0
walked = jax.jit(jax.vmap(walk))(*(value.reshape(-1, *value.shape[3:]) for value in given))
qpos, feet, swings, stumbles = (np.asarray(value).reshape(*shape, *value.shape[1:]) for value in walked)

# %% [markdown]
# ## How far it gets
#
# A walk counts until the robot leans by more than 60 degrees. A foot that touches the ground in the middle of its swing
# is a stumble.

# %%
upright = np.cumprod(1 - 2 * (qpos[..., 4] ** 2 + qpos[..., 5] ** 2) > 0.5, -1)
last = upright.sum(-1) - 1
distance = np.take_along_axis(qpos[..., 0], last[..., None], -1)[..., 0] - qpos[..., 0, 0]
walking = upright[..., None] == 1
share = np.sum(stumbles & walking, (2, 3, 4)) / np.sum(swings & walking, (2, 3, 4))
colours = {"by the scan": "C0", "blind": "C3"}
for k, name in enumerate(colours):
    for j, clearance in enumerate(clearances):
        print(f"{name:11}  clearance {clearance:.2f} m: {distance[k, j].mean():.1f} m, stumbles {share[k, j]:5.1%},", end=" ")
        print(f"{np.sum(last[k, j] == 599)} of {len(terrains)} stand")

figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.4), dpi=64, layout="constrained", width_ratios=(1, 1.7))
left.set(xlabel="clearance of a swinging foot, cm", ylabel="distance in 12 s, m", xticks=100 * clearances, ylim=(-0.3, 8))
right.set(xlabel="x, m", yticks=[], title="path of a foot over the ground, clearance 8 cm")
for k, (name, colour) in enumerate(colours.items()):
    left.plot(100 * clearances + 0.4 * k - 0.2, distance[k], "o", color=colour, alpha=0.3, markersize=4)
    left.plot(100 * clearances + 0.4 * k - 0.2, distance[k].mean(1), "-", color=colour, label=name)
    foot, level = feet[k, 1, 0, : last[k, 1, 0] + 1, 1] - [0, 0, 0.035], 0.3 * (1 - k)
    sorted_foot = foot[foot[:, 0].argsort()]
    straight = np.tile([1.0, 0, 0, 0], (len(foot), 1))
    ground = height_scan(HField(terrains[0], SIZE), sorted_foot, straight, np.zeros((1, 2))).heights[:, 0]
    right.fill_between(sorted_foot[:, 0], level - 0.03, level + ground, color="0.8")
    right.plot(foot[:, 0], level + foot[:, 2], color=colour, linewidth=1)
left.legend(loc="upper center", ncols=2)
plt.show()

# %% [markdown]
# By the scan any clearance will do, as each foot knows how high to go. Without it a low foot catches on the blocks, and the
# higher a foot swings, the more robots tip over; the best of the four clearances takes them two thirds of the way. The
# terrains were not looked at while the gait was made. Neither robot has reflexes: a blind one that feels its contacts would
# do better than this one.
#
# [A height scan for a robot](../docs/tutorials/robots.md) has the other sensors, and batches of terrains for training;
# [Robots](../docs/measurements/robots.md) measures them.
