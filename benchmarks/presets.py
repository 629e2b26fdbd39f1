"""The plots that chose the presets: error over samples, over points on edges and over time on four scenes.

Each scene is swept by the command `tradeoff` over these two knobs alone, the derivative over its points only, with four
samples; what was measured before is not measured again. After a change of jaxhf's source another folder is needed.
"""

from collections.abc import Sequence
from pathlib import Path

import benchmark

import jaxhf
from jaxhf.study.plan import plan
from jaxhf.study.sweep import run as run_sweep
from jaxhf.study.table import FIGURES, Row

SCENES = ("jacksboro", "landsea", "texture", "debug4x4")
PRESETS = {"draft": jaxhf.Settings.draft(), "balanced": jaxhf.Settings.balanced(), "exact": jaxhf.Settings.exact()}


def by_knob(knob: str, rows: Sequence[Row]) -> dict[int, dict[str, float]]:
    """The figures of each row, by the value of a knob that is a number."""
    return dict(sorted((row[knob] or 0, {name: row[name] for name in FIGURES if name in row}) for row in rows))


def plot(
    found: dict[str, dict[int, dict[str, float]]], derivatives: dict[str, dict[int, dict[str, float]]], path: Path
) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.5), layout="constrained")
    by_count, by_time, by_edges = figure.subplots(1, 3)
    for scene, rows in found.items():
        errors = [figures["rmse"] for figures in rows.values()]
        by_count.plot(list(rows), errors, "o-", label=scene)
        by_time.plot([figures["against_base"] for figures in rows.values()], errors, "o-", label=scene)
    for scene, rows in derivatives.items():
        errors = [figures["relative_error"] for figures in rows.values()]
        by_edges.errorbar(list(rows), errors, [figures["spread"] for figures in rows.values()], fmt="o-", label=scene)
    for name, settings in PRESETS.items():
        for axes, value in ((by_count, settings.samples), (by_edges, settings.edge_samples)):
            axes.axvline(value, color="0.7", linestyle=":")
            axes.text(
                value, 0.99, f"{name} ", color="0.4", transform=axes.get_xaxis_transform(), va="top", ha="right", rotation=90
            )
    by_count.set(xscale="log", yscale="log", xlabel="samples a pixel", ylabel="RMSE, of the mean radiance")
    by_time.set(xscale="log", yscale="log", xlabel="time, of that of 4 samples")
    by_edges.set(yscale="log", xlabel="points on edges", ylabel="relative error of the derivative")
    by_edges.set_xscale("symlog", linthresh=1000)
    by_edges.set_xticks([0, 1000, 10_000, 100_000, 300_000], ["0", "1000", "10 000", "100 000", "300 000"], rotation=30)
    by_edges.set_xticks([], minor=True)
    by_edges.set_xlim(-100, 600_000)
    by_count.set_xticks([1, 4, 9, 16, 64], ["1", "4", "9", "16", "64"])
    by_count.set_xticks([], minor=True)
    by_count.set_xlim(0.8, 110)
    by_time.legend()
    for axes in (by_count, by_time, by_edges):
        axes.grid(True, alpha=0.3)
    figure.savefig(path)


def main() -> None:
    claims = "that each preset's picture is nearer than the one before it, 'balanced' off by less than 0.02, 'exact' by 0.005"
    run = benchmark.Run(__doc__, needs="matplotlib (Jacksboro's heights, the plot)", claims=claims)
    parser = run.parser
    parser.add_argument("-o", "--output", type=Path, default=Path("presets"), help="folder of the sweeps and of presets.png")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--repeats", type=int, default=5)
    options = run.parse()
    benchmark.need("matplotlib")
    print("eight sweeps, about 17 minutes on two free cores", flush=True)
    scenes = Path(__file__).parents[1] / "scenes"
    found, derivatives = {}, {}

    def swept(name: str, knob: str) -> list[Row]:
        sweep = plan(scenes / f"{name}.toml", options.output / name, width=options.width, knobs=(knob,))
        failures = run_sweep(sweep, options.repeats, lambda line: print(line, flush=True), lambda done, total, what: None)
        assert not failures, failures
        return sweep.measured()

    for name in options.scenes:
        found[name] = by_knob("samples", swept(name, "samples"))
        points = [row for row in swept(name, "edge_samples") if row["task"] == "derivative"]
        derivatives[name] = by_knob("edge_samples", points)
    plot(found, derivatives, options.output / "presets.png")
    for by, tables in (("samples", found), ("edge_samples", derivatives)):
        presets = {getattr(settings, by): preset for preset, settings in PRESETS.items()}
        for scene, rows in tables.items():
            for count, figures in rows.items():
                run.row(f"{scene}, {by} {count}", {"preset": presets.get(count, "")} | figures)
    for scene, rows in found.items():
        draft, balanced, exact = (rows[settings.samples or 0]["rmse"] for settings in PRESETS.values())
        nearer = draft > balanced > exact and balanced < 0.02 and exact < 0.005
        run.claim(
            nearer, f"{scene}: RMSE of draft {draft:.4f} > balanced {balanced:.4f}, below 0.02 > exact {exact:.4f}, below 0.005"
        )
    run.end()


if __name__ == "__main__":
    main()
