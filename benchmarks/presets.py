"""The curves that chose the presets: error over samples and over time on four scenes, and what each preset gives there.

Each scene is swept by the command `tradeoff` over its samples alone; what was measured before is not measured again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jaxhf
from jaxhf._curves import screenless_pyplot
from jaxhf._sweeping import run
from jaxhf._tradeoff import Measured, Sweep, plan

SCENES = ("jacksboro", "landsea", "texture", "debug4x4")
PRESETS = {"draft": jaxhf.Settings.draft(), "balanced": jaxhf.Settings.balanced(), "exact": jaxhf.Settings.exact()}


def by_samples(measured: Sequence[Measured]) -> dict[int, dict[str, float]]:
    return dict(sorted((int(row.knobs["samples"]), row.figures) for row in measured))


def table(found: dict[str, dict[int, dict[str, float]]]) -> str:
    lines = ["| scene | samples | RMSE | 99.9 % | wrong hits | time, of 4 samples | |", "|---|---|---|---|---|---|---|"]
    names = {settings.samples: name for name, settings in PRESETS.items()}
    for scene, rows in found.items():
        for samples, figures in rows.items():
            lines.append(
                f"| {scene} | {samples} | {figures['rmse']:.4f} | {figures['p999']:.3f} | {figures['wrong_hits']:.1e} | "
                f"{figures['against_base']:.2f} | {names.get(samples, '')} |"
            )
    return "\n".join(lines)


def plot(found: dict[str, dict[int, dict[str, float]]], path: Path) -> None:
    plt = screenless_pyplot()
    figure, (by_count, by_time) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", sharey=True)
    for scene, rows in found.items():
        errors = [figures["rmse"] for figures in rows.values()]
        by_count.plot(list(rows), errors, "o-", label=scene)
        by_time.plot([figures["against_base"] for figures in rows.values()], errors, "o-", label=scene)
    for name, settings in PRESETS.items():
        by_count.axvline(settings.samples, color="0.7", linestyle=":")
        by_count.text(settings.samples, 1.0, f" {name}", color="0.4", transform=by_count.get_xaxis_transform(), va="top")
    by_count.set(xscale="log", yscale="log", xlabel="samples a pixel", ylabel="RMSE, of the mean radiance")
    by_time.set(xscale="log", xlabel="time, of that of 4 samples")
    by_count.set_xticks([1, 4, 9, 16, 64], ["1", "4", "9", "16", "64"])
    by_count.set_xticks([], minor=True)
    by_count.set_xlim(0.8, 110)
    by_time.legend()
    for axes in (by_count, by_time):
        axes.grid(True, alpha=0.3)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("presets"), help="folder of the sweeps and of presets.png")
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    print("four sweeps, about 6 minutes on two free cores", flush=True)
    scenes = Path(__file__).parents[1] / "scenes"
    found = {}
    for name in SCENES:
        sweep: Sweep = plan(scenes / f"{name}.toml", options.output / name, width=options.width, knobs=("samples",))
        failures = run(sweep, options.repeats, lambda line: print(line, flush=True), lambda done, total, what: None)
        assert not failures, failures
        found[name] = by_samples(sweep.measured())
    plot(found, options.output / "presets.png")
    print(table(found))


if __name__ == "__main__":
    main()
