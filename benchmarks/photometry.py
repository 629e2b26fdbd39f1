"""Fits of scenes that do not explain their pictures: does a fit say so where its heights are worse than the prior?

A fractal of 48² heights from straight above, a pixel a height, 1 % noise, under three suns 30 to 40 degrees high, and under
one of them; the prior is the terrain smoothed over 3 cells, and its deviation is known. Six mistakes: Lambert's law for a
surface by Hapke's or by Lommel and Seeliger's, haze of a fifth of the brightness, a picture that was encoded for a screen,
suns 5 degrees off, and the pictures of another terrain. Beside them, the right scenes by each law.

    python benchmarks/photometry.py            the terrain on which the warning was chosen
    python benchmarks/photometry.py --held-out one that is drawn now; its seed is printed, and --seed repeats it
"""

import secrets

import benchmark
import numpy as np
from cases import names_of, smoothed, times_nearer

import jaxhf
from jaxhf.scene.procedural import fractal

SIZE, CELLS, NOISE, ALBEDO = 48, 3, 0.01, 0.3
SUNS = (100.0, 35.0), (220.0, 40.0), (340.0, 30.0)
MATTE, DUST = jaxhf.Matte(ALBEDO), jaxhf.LommelSeeliger(ALBEDO)
REGOLITH = jaxhf.Hapke(0.35, 0.25, 0.5, opposition=1.0, width=0.06, roughness=20.0)
SENTENCE = "do not use"


def scenes(heights: np.ndarray, material: jaxhf.Material, suns: tuple[tuple[float, float], ...]) -> list[jaxhf.Scene]:
    middle = (SIZE - 1) / 2
    field = jaxhf.Object(jaxhf.Heightfield(heights.astype(np.float32), dx=1.0), material)
    camera = jaxhf.Orthographic.look_at(
        (middle, middle, 500), (middle, middle, 0), (0, 1, 0), SIZE - 1.0, width=SIZE, height=SIZE
    )
    return [jaxhf.Scene([field], camera, [jaxhf.Directional.from_angles(*sun)]) for sun in suns]


def main() -> None:
    run = benchmark.Run(
        __doc__, claims="the sentence where heights are worse than the prior, and no such sentence about the right scenes"
    )
    run.parser.add_argument("--held-out", action="store_true", help="another terrain and other suns, drawn now")
    run.parser.add_argument("--seed", type=int, help="of these, to repeat a run")
    options = run.parse()
    seed, turn = 11, 0.0
    if options.held_out or options.seed is not None:
        seed = secrets.randbelow(2**31) if options.seed is None else options.seed
        turn = float(np.random.default_rng(seed).uniform(0, 360))
        print(f"drawn from --seed {seed}, suns turned by {turn:.0f} degrees", flush=True)
    rng = np.random.default_rng(seed)
    truth, other = (fractal([SIZE, SIZE], seed=seed + k, exponent=2.5, range=(0.0, 12.0)) for k in (0, 1))
    suns = tuple((azimuth + turn, altitude) for azimuth, altitude in SUNS)

    def pictures(material: jaxhf.Material, heights: np.ndarray = truth, off: float = 0.0) -> list[np.ndarray]:
        moved = tuple((azimuth + off * (-1) ** k, altitude + off * (k > 0)) for k, (azimuth, altitude) in enumerate(suns))
        exact = [
            np.asarray(jaxhf.render(scene, jaxhf.Settings(samples=16)))[..., 0] for scene in scenes(heights, material, moved)
        ]
        return [image + NOISE * np.mean(exact) * rng.standard_normal(image.shape) for image in exact]

    plain = pictures(MATTE)
    bright = float(np.mean(plain))
    asked = {
        "right: Lambert's law": (plain, MATTE),
        "right: Lommel and Seeliger's law": (pictures(DUST), DUST),
        "right: Hapke's law": (pictures(REGOLITH), REGOLITH),
        "Lambert's law for Hapke's": (pictures(REGOLITH), jaxhf.Matte(0.1)),
        "Lambert's law for Lommel and Seeliger's": (pictures(DUST), MATTE),
        "haze": ([image + 0.2 * bright for image in plain], MATTE),
        "a picture for a screen": ([np.clip(image, 0, None) ** (1 / 2.2) for image in plain], MATTE),
        "suns off by 5 degrees": (pictures(MATTE, off=5.0), MATTE),
        "another terrain": (pictures(MATTE, other), MATTE),
    }
    prior = smoothed(truth, CELLS)
    known = jaxhf.Prior(prior.astype(np.float32), float(np.std(prior - truth)))
    for name, (targets, material) in asked.items():
        for count in (3, 1):
            found = jaxhf.fit(scenes(prior, material, suns[:count]), targets[:count], prior=known, draws=20)
            ratio, off = times_nearer(known, found.heights, truth), np.abs(np.asarray(found.heights) - truth)
            within = [float(np.mean(off <= k * np.asarray(found.std))) for k in (1, 2)]
            said, case = names_of(found.warnings), f"{name}, {count} picture{'s' * (count > 1)}"
            if name.startswith("right"):
                run.claim(SENTENCE not in said, f"{case}: {ratio:.3g} times nearer, and it may be used")
            else:
                run.claim(ratio > 1 or SENTENCE in said, f"{case}: {ratio:.3g} times nearer, or it says not to use it")
            numbers = {"ratio": ratio, "within 1": within[0], "within 2": within[1], "chi2": found.stats["chi2"]}
            run.row(case, numbers | {"said": "; ".join(one for one in said if len(one) < 30)})
    run.end()


if __name__ == "__main__":
    main()
