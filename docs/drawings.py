"""Draws the pages' figures into images/: `python docs/drawings.py`. On dark pages they change their colours."""

from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Arc, FancyArrowPatch, Polygon, Rectangle

IMAGES = Path(__file__).parent / "images"
INK, GROUND, RED, BLUE, PALE, PAPER = "#333333", "#c8b088", "#c8402c", "#2c5fa8", "#e9e2d3", "#ffffff"
DARK = {INK: "#dddddd", GROUND: "#77664a", RED: "#ff8a70", BLUE: "#8ab8ff", PALE: "#3b4252", PAPER: "#1e2129"}
plt.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "jaxhf", "font.family": "sans-serif", "font.size": 11,
                     "text.color": INK, "axes.edgecolor": INK, "axes.labelcolor": INK,
                     "lines.solid_capstyle": "round"})  # fmt: skip


def canvas(width: float, height: float, columns: int = 1):
    figure, axes = plt.subplots(1, columns, figsize=(width, height), squeeze=False)
    figure.subplots_adjust(0, 0, 1, 1, wspace=0)
    for axis in axes[0]:
        axis.set_aspect("equal")
        axis.set_axis_off()
    return figure, axes[0]


def save(figure, name: str) -> None:
    """Writes a drawing on paper of its own, so that it can be read also where page and reader's system differ."""
    path = IMAGES / f"{name}.svg"
    figure.patch.set_facecolor(PAPER)
    figure.savefig(path, metadata={"Date": None}, bbox_inches="tight", pad_inches=0.12)
    plt.close(figure)
    rules = "\n".join(
        f'  [style*="{part}: {light}"] {{ {part}: {dark} !important }}'
        for light, dark in DARK.items()
        for part in ("fill", "stroke")
    )
    text = path.read_text()
    head = text.index("<defs>")
    path.write_text(f"{text[:head]}<style>@media (prefers-color-scheme: dark) {{\n{rules}\n}}</style>\n {text[head:]}")


def arrow(axis, start, end, colour=INK, **style) -> None:
    axis.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=14, color=colour, shrinkA=0, shrinkB=0, **style)
    )


def frames() -> None:
    figure, (grid, angles) = canvas(9, 3.6, 2)
    for k in range(5):
        grid.plot([0, 4], [min(k, 3)] * 2, color=INK, lw=0.8)
        grid.plot([k, k], [0, 3], color=INK, lw=0.8)
    for i in range(4):
        for j in range(3):
            grid.plot([i, i + 1], [j, j + 1], color=INK, lw=0.4)
    grid.plot(*np.array([(i, j) for i in range(5) for j in range(4)]).T, "o", color=GROUND, ms=6, mec=INK, mew=0.6)
    grid.plot([0, 2], [0, 1], "o", color=RED, ms=8)
    grid.text(0.1, -0.42, "heights[0, 0]\nat (x0, y0)", color=RED, va="center", ha="center")
    grid.text(2.12, 0.78, "heights[1, 2]", color=RED, va="center", backgroundcolor="white")
    arrow(grid, (4.9, 0), (5.6, 0))
    arrow(grid, (4.9, 0), (4.9, 0.7))
    grid.text(5.65, 0, "x, east", va="center")
    grid.text(4.9, 0.85, "y, north", ha="center")
    grid.text(2.5, -0.3, "dx", ha="center", va="center")
    grid.text(4.15, 2.5, "dy", va="center")
    grid.text(2, 3.3, "row 0 lies in the south", ha="center")
    grid.set_xlim(-1.0, 6.8)
    grid.set_ylim(-0.8, 3.7)
    angles.add_patch(plt.Circle((0, 0), 1.5, fill=False, color=INK, lw=0.8))
    for name, (x, y) in {"N 0°": (0, 1), "E 90°": (1, 0), "S 180°": (0, -1), "W 270°": (-1, 0)}.items():
        angles.text(2.1 * x, 1.75 * y, name, ha="center", va="center")
    sun = np.array([np.sin(np.deg2rad(315)), np.cos(np.deg2rad(315))]) * 1.5
    angles.plot(*sun, "o", color="#e0a020", ms=14)
    arrow(angles, sun * 0.93, (0, 0), "#e0a020", lw=1.6)
    angles.add_patch(Arc((0, 0), 1.5, 1.5, theta1=135, theta2=90 - 0.1 + 360, color=RED, lw=1.4))
    angles.text(0, -1.08, "azimuth 315°", color=RED, ha="center")
    angles.plot([2.9, 5.1], [-0.6, -0.6], color=INK)
    high = np.array([2.9, -0.6]) + 1.9 * np.array([np.cos(np.deg2rad(35)), np.sin(np.deg2rad(35))])
    angles.plot(*high, "o", color="#e0a020", ms=14)
    angles.plot([2.9, high[0]], [-0.6, high[1]], color="#e0a020", lw=1.4)
    angles.add_patch(Arc((2.9, -0.6), 1.7, 1.7, theta1=0, theta2=35, color=RED, lw=1.4))
    angles.text(3.9, -0.35, "altitude 35°", color=RED)
    angles.text(4, -0.95, "horizon", ha="center")
    angles.set_xlim(-2.6, 5.6)
    angles.set_ylim(-2.0, 2.0)
    save(figure, "frames")


def walk() -> None:
    figure, (axis,) = canvas(9, 3.9)
    z = np.array([0.6, 0.9, 0.7, 0.5, 0.8, 1.1, 0.9, 1.4, 2.0, 1.7, 2.3, 2.8, 2.5, 2.2, 2.6, 2.1, 1.6])
    x = np.arange(17)
    axis.add_patch(Polygon([(0, 0), *zip(x, z, strict=True), (16, 0)], color=GROUND, lw=0))
    for first, last, skipped in ((0, 4, True), (4, 8, True), (8, 10, True), (10, 12, False)):
        top = z[first : last + 1].max()
        axis.add_patch(Rectangle((first, 0), last - first, top, fill=False, ec=BLUE, lw=1.4, ls="-" if skipped else "--"))
    axis.plot(x, z, color=INK, lw=1.2)
    axis.plot(x, z, "o", color=INK, ms=3)

    def at(s):
        return 4.9 - 0.235 * s

    hit = np.array([10.33, at(10.33)])
    k = np.linspace(10, 11, 1001)
    k = k[np.argmin(abs(at(k) - np.interp(k, x, z)))]
    hit = np.array([k, at(k)])
    axis.plot([-0.8, hit[0]], [at(-0.8), hit[1]], color=RED, lw=1.8)
    for s in (0, 4, 8, 10):
        axis.plot(s, at(s), "o", color="white", mec=RED, ms=7, mew=1.6)
    axis.plot(*hit, "o", color=RED, ms=9)
    axis.text(2, z[:5].max() + 0.12, "skipped at once", color=BLUE, ha="center")
    axis.text(6, z[4:9].max() + 0.12, "skipped", color=BLUE, ha="center")
    axis.text(12.1, 2.95, "looked at cell by cell", color=BLUE)
    axis.text(hit[0], hit[1] + 1.3, "g changes sign: hit", color=RED, ha="center")
    axis.text(-0.8, 5.35, "g > 0: the ray is above the ground", color=RED)
    axis.set_xlim(-1.1, 18.2)
    axis.set_ylim(-0.1, 5.8)
    save(figure, "walk")


def boundary() -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 2.7))
    x = np.linspace(0, 10, 500)

    def smooth(s):
        return 0.55 + 0.18 * np.sin(0.9 * x + s)

    def step(edge):
        return np.where(x < edge, 0.85, 0.15)

    left, right = axes
    left.plot(x, smooth(0), color=INK)
    left.plot(x, smooth(0.4), color=RED, ls="--")
    left.set_title("inside: shading changes everywhere, a little", fontsize=11)
    right.plot(x, step(5), color=INK)
    right.plot(x, step(5.9), color=RED, ls="--")
    right.fill_between(x, 0.15, 0.85, where=(x > 5) & (x < 5.9), color=RED, alpha=0.2, lw=0)
    right.annotate("", (6.9, 0.5), (5.0, 0.5), arrowprops={"arrowstyle": "->", "color": RED})
    right.text(7, 0.5, "jump times\nspeed of the edge", color=RED, va="center")
    right.set_title("at an edge: nothing changes, but the edge moves", fontsize=11)
    for axis in axes:
        axis.set_ylim(0, 1)
        axis.set_xlabel("across the picture")
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[["top", "right"]].set_visible(False)
    left.set_ylabel("radiance")
    figure.tight_layout()
    save(figure, "boundary")


def normals() -> None:
    figure, (axis,) = canvas(9, 2.6)
    x, z = np.array([0, 2, 4, 6, 8, 10.0]), np.array([0.2, 0.7, 1.6, 1.5, 0.7, 0.4])
    axis.add_patch(Polygon([(0, -0.3), *zip(x, z, strict=True), (10, -0.3)], color=GROUND, lw=0))
    axis.plot(x, z, "-o", color=INK, ms=5)
    facets = np.stack([-np.diff(z), np.diff(x)], 1)
    facets /= np.linalg.norm(facets, axis=1)[:, None]
    for k in range(5):
        middle = np.array([x[k] + x[k + 1], z[k] + z[k + 1]]) / 2
        arrow(axis, middle, middle + 0.8 * facets[k], BLUE, lw=1.3)
    vertex = np.concatenate([facets[:1], facets[:-1] + facets[1:], facets[-1:]])
    vertex /= np.linalg.norm(vertex, axis=1)[:, None]
    for s in np.linspace(0.25, 9.75, 20):
        n = np.array([np.interp(s, x, vertex[:, 0]), np.interp(s, x, vertex[:, 1])])
        foot = np.array([s, np.interp(s, x, z)])
        axis.plot(*np.stack([foot, foot + 0.5 * n / np.linalg.norm(n)]).T, color=RED, lw=1)
    axis.text(10.2, 1.1, "the triangles' own normals", color=BLUE)
    axis.text(10.2, 0.6, "interpolated normals", color=RED)
    axis.set_xlim(-0.2, 14.4)
    axis.set_ylim(-0.3, 2.7)
    save(figure, "normals")


def wall() -> None:
    figure, (axis,) = canvas(9, 2.9)
    x = np.linspace(0, 10, 400)
    z = 1.5 * np.exp(-((x - 3.1) ** 2) / 0.3)
    axis.add_patch(Polygon([(0, -0.25), *zip(x, z, strict=True), (10, -0.25)], color=GROUND, lw=0))
    end = 3.1 + 1.5 / np.tan(np.deg2rad(30))
    axis.plot([0.6, end], [1.5 + 2.5 * np.tan(np.deg2rad(30)), 0], color="#e0a020", lw=1.8)
    axis.plot(0.45, 1.5 + 2.65 * np.tan(np.deg2rad(30)), "o", color="#e0a020", ms=15)
    axis.plot([3.7, end], [0, 0], color="#504a60", lw=5)
    axis.plot([end, 9], [0, 0], color="#f2d060", lw=5)
    axis.add_patch(Arc((end, 0), 2.6, 2.6, theta1=150, theta2=180, color=INK))
    axis.text(end - 1.0, 0.16, "30°")
    axis.text(3.25, 1.6, "a wall of height h")
    axis.text(4.7, -0.2, "shadow, h / tan 30°", ha="center", va="top")
    axis.text(7.4, 0.15, "lit ground: 0.5", ha="center")
    axis.plot([4, 4, 9, 9], [3.0, 3.15, 3.15, 3.0], color=BLUE)
    axis.text(6.5, 3.25, "what the camera sees, from above", ha="center", color=BLUE)
    axis.set_xlim(-0.2, 10.4)
    axis.set_ylim(-0.7, 3.7)
    save(figure, "wall")


def recovery() -> None:
    figure, (axis,) = canvas(9, 2.6)
    boxes = [
        "heights\n(coarse first)",
        "render\neach picture",
        "compare\nin units of noise",
        "linearise\nsample by sample",
        "step\nor more damping",
    ]
    for k, text in enumerate(boxes):
        axis.add_patch(Rectangle((3.1 * k, 0), 2.6, 1.2, fc=PALE, ec=INK, lw=1))
        axis.text(3.1 * k + 1.3, 0.6, text, ha="center", va="center")
        if k:
            arrow(axis, (3.1 * k - 0.48, 0.6), (3.1 * k - 0.02, 0.6))
    axis.plot([13.7, 13.7, 1.3], [-0.02, -0.8, -0.8], color=INK, lw=1.2)
    arrow(axis, (1.3, -0.8), (1.3, -0.02))
    axis.text(7.5, -1.15, "until a step changes less than the noise leaves open; then finer waves join", ha="center")
    axis.text(4.4, 1.9, "the prior: a coarse map and how far it may be off", ha="left", color=BLUE)
    arrow(axis, (10.6, 1.7), (10.6, 1.22), BLUE)
    axis.set_xlim(-0.2, 15.3)
    axis.set_ylim(-1.5, 2.2)
    save(figure, "recovery")


if __name__ == "__main__":
    for draw in (frames, walk, boundary, normals, wall, recovery):
        draw()
