"""Height fields and rays for MuJoCo, and what MuJoCo itself says of them."""

import importlib
from typing import Any

import numpy as np

mujoco: Any = importlib.import_module("mujoco")  # its functions are unknown to type checkers

SIZE = np.array([3.0, 5.0, 0.7, 0.2])
KINDS = ("outside", "inside", "below", "vertical", "grazing", "walls", "edges")
MORE_KINDS = ("buried", "beneath")  # for benchmarks alone


def heights(nrow: int, ncol: int, seed: int = 0) -> np.ndarray:
    data = np.random.default_rng(seed).uniform(size=(nrow, ncol)).astype(np.float32)
    return (data - data.min()) / (data.max() - data.min())


def matrix(quat: Any) -> np.ndarray:
    """MuJoCo's rotation by a quaternion of any length."""
    found = np.empty(9)
    mujoco.mju_quat2Mat(found, np.asarray(quat, float) / np.linalg.norm(quat))
    return found.reshape(3, 3)


def rays(kind: str, data: np.ndarray, size: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions in the height field's frame."""
    random, (nrow, ncol), (rx, ry, top, base) = np.random.default_rng(seed), data.shape, size

    def points(times: float = 1.0) -> np.ndarray:
        return random.uniform([-rx * times, -ry * times, -base * times], [rx * times, ry * times, top * times], (count, 3))

    o = points({"inside": 1.0, "below": 1.0, "vertical": 1.1, "walls": 1.5}.get(kind, 3.0))
    d = points() - o
    every = np.arange(count)
    if kind == "buried":  # within the solid, over the base's upper face or under it, to all sides
        r, c = random.integers(0, nrow - 1, count), random.integers(0, ncol - 1, count)
        u, v = random.uniform(size=(2, count))
        corner, between, last = data[r, c], np.where(v > u, data[r + 1, c], data[r, c + 1]), data[r + 1, c + 1]
        low, high = np.minimum(u, v), np.maximum(u, v)
        roof = (corner + high * (between - corner) + low * (last - between)) * top
        o = np.stack([rx * (2 * (c + u) / (ncol - 1) - 1), ry * (2 * (r + v) / (nrow - 1) - 1), roof], 1)
        o[:, 2] = np.where(every % 2, roof * random.uniform(0.01, 0.99, count), -base * random.uniform(0.01, 0.99, count))
        d = random.normal(size=(count, 3)) * [rx, ry, (top + base) * random.choice([0.1, 1, 10])]
    elif kind == "beneath":  # from below the floor, beside the footprint too: at walls, at the floor and along its border
        o = points(random.choice([0.5, 1.5]))
        o[:, 2] = -base * random.uniform(1, 4, count)
        end = points()
        axis = random.integers(0, 2, count)
        end[every, axis] = random.choice([-1, 1], count) * size[axis] * random.choice([1, 1 - 1e-3, 1 + 1e-3], count)
        d = np.where((every % 3 == 0)[:, None], points() - o, end - o)
    elif kind == "below":
        o[:, 2] = -base * random.uniform(1, 2, count)
    elif kind == "vertical":
        d = random.choice([-1, 1], (count, 1)) * random.uniform(0.1, 3, (count, 1)) * [[0, 0, 1]]
    elif kind == "grazing":
        o[:, 2], d[:, 2] = random.uniform(-0.1, 1.1, count) * top, random.normal(size=count) * 0.02 * top
    elif kind == "walls":  # beside a wall and almost along it
        axis = random.integers(0, 2, count)
        o[every, axis] = random.choice([-1, 1], count) * size[axis] * (1 + random.choice([1e-3, -1e-3], count))
        d[every, axis] = random.choice([0, 1e-4, -1e-4], count)
    elif kind == "edges":  # from above at vertices and at points on edges
        r, c = random.integers(0, nrow - 1, count), random.integers(0, ncol - 1, count)
        step, along = np.array([[0, 1], [1, 0], [1, 1]])[random.integers(0, 3, count)], random.choice([0, 0.25, 0.5], count)
        x, y = c + step[:, 1] * along, r + step[:, 0] * along
        z = data[r, c] * (1 - along) + data[r + step[:, 0], c + step[:, 1]] * along
        o[:, 2] = top * random.uniform(1.2, 3, count)
        d = np.stack([rx * (2 * x / (ncol - 1) - 1), ry * (2 * y / (nrow - 1) - 1), z * top], 1) - o
    return o, d


class Reference:
    """MuJoCo's model of a height field, in a body that may be elsewhere."""

    def __init__(self, data: np.ndarray, size: np.ndarray, geom: str = "", body: str = ""):
        (nrow, ncol), numbers = data.shape, " ".join(map(repr, size.tolist()))
        self.model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><asset><hfield name="h" nrow="{nrow}" ncol="{ncol}" size="{numbers}"/></asset>
            <worldbody><geom type="sphere" size="1" contype="0" rgba="0 0 0 0"/><body {body}>
            <geom name="ground" type="hfield" hfield="h" {geom}/></body></worldbody></mujoco>"""
        )
        self.model.hfield_data[:] = data.ravel()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def in_world(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rotation = self.data.geom_xmat[1].reshape(3, 3)
        return o @ rotation.T + self.data.geom_xpos[1], d @ rotation.T

    def __call__(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return mujocos_rays(self.model, self.data, o, d)[:2]


def mujocos_rays(model: Any, data: Any, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances, normals and geoms' numbers by `mj_ray`."""
    t, n, geom, number = np.empty(len(o)), np.empty((len(o), 3)), np.empty(len(o), int), np.zeros(1, np.int32)
    for k in range(len(o)):
        t[k] = mujoco.mj_ray(model, data, o[k], d[k], None, True, -1, number, n[k])
        geom[k] = number[0]
    return t, n, geom


PRIMITIVES = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box")


def model_of(random: np.random.Generator, hfields: int, primitives: int) -> tuple[Any, Any]:
    """A model of height fields and primitives anywhere in a room, some of which joints move, and its data after a move.

    Of the height fields the first stands still; there is a primitive of each kind where there are enough.
    """

    def placed() -> str:
        pos, quat = random.uniform(-3, 3, 3), random.normal(size=4)
        return f'pos="{" ".join(map(str, pos))}" quat="{" ".join(map(str, quat))}"'

    assets, bodies = "", ""
    for k in range(hfields):
        (nrow, ncol), size = random.integers(2, 20, 2), random.uniform([0.5, 0.5, 0.2, 0.05], [3, 3, 1, 0.5])
        assets += f'<hfield name="h{k}" nrow="{nrow}" ncol="{ncol}" size="{" ".join(map(str, size))}"/>'
        geom = f'<geom type="hfield" hfield="h{k}" mass="1" {placed()}/>'
        bodies += f"<body {placed()}><freejoint/>{geom}</body>" if k else geom
    kinds = [*PRIMITIVES, *random.choice(PRIMITIVES, max(0, primitives - len(PRIMITIVES)))][:primitives]
    for kind in kinds:
        size = random.uniform(0.2, 1.2, 3) * (random.choice([0, 3], 3) if kind == "plane" else 1)
        geom = f'<geom type="{kind}" size="{size[0]} {size[1]} {max(size[2], 0.1)}" {placed()}/>'
        bodies += geom if kind == "plane" else f'<body {placed()}><joint type="hinge"/>{geom}</body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>")
    for k in range(hfields):
        first, (nrow, ncol) = model.hfield_adr[k], (model.hfield_nrow[k], model.hfield_ncol[k])
        model.hfield_data[first : first + nrow * ncol] = heights(nrow, ncol, k).ravel()
    data = mujoco.MjData(model)
    data.qpos += 0.3 * random.normal(size=model.nq)
    mujoco.mj_forward(model, data)
    return model, data
