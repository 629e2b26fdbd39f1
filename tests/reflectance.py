"""Laws of reflectance in angles, double precision, as their papers have them: written apart from jaxhf.

Each takes angles of incidence and emission and the phase angle, radians, and gives the bidirectional reflectance, 1 / sr.
"""

from collections.abc import Callable

import numpy as np

import jaxhf

Law = Callable[[float, float, float], float]


def lommel_seeliger(albedo: float) -> Law:
    return lambda i, e, g: albedo / np.pi * 2 / (np.cos(i) + np.cos(e))


def lunar_lambert(albedo: float, limb: float | None = None) -> Law:
    """McEwen 1991; his polynomial for the Moon."""

    def law(i: float, e: float, g: float) -> float:
        share = max(np.polyval([-1.46e-6, 2.42e-4, -0.019, 1], np.degrees(g)), 0) if limb is None else limb
        lommel = np.cos(i) / (np.cos(i) + np.cos(e))
        return albedo / np.pi * (2 * share * lommel + (1 - share) * np.cos(i)) / np.cos(i)

    return law


def minnaert(albedo: float, k: float) -> Law:
    return lambda i, e, g: albedo / np.pi * np.cos(i) ** (k - 1) * np.cos(e) ** (k - 1)


def oren_nayar(albedo: float, roughness: float) -> Law:
    """Oren and Nayar 1994, equation 30, in its own angles."""

    def law(i: float, e: float, g: float) -> float:
        sigma = np.radians(roughness)
        a, b = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33), 0.45 * sigma**2 / (sigma**2 + 0.09)
        return albedo / np.pi * (a + b * max(0, np.cos(azimuth(i, e, g))) * np.sin(max(i, e)) * np.tan(min(i, e)))

    return law


def hapke(w: float, b: float, c: float, opposition: float = 0, width: float = 1, roughness: float | None = None) -> Law:
    """Hapke 2012: isotropic multiple scattering, shadow hiding, and roughness in its two cases."""
    gamma = np.sqrt(1 - w)
    r = (1 - gamma) / (1 + gamma)

    def h(x: float) -> float:
        return 1 / (1 - w * x * (r + (1 - 2 * r * x) / 2 * np.log((1 + x) / x)))

    def smooth(i: float, e: float, g: float, mu0: float, mu: float) -> float:
        lobes = [(1 + s * c) / 2 * (1 - b**2) / (1 - 2 * s * b * np.cos(g) + b**2) ** 1.5 for s in (1, -1)]
        surge = 1 + opposition / (1 + np.tan(g / 2) / width)
        return w / (4 * np.pi) * mu0 / (mu0 + mu) * (sum(lobes) * surge + h(mu0) * h(mu) - 1)

    def law(i: float, e: float, g: float) -> float:
        if roughness is None:
            return smooth(i, e, g, np.cos(i), np.cos(e)) / np.cos(i)
        tan = np.tan(np.radians(roughness))
        chi = 1 / np.sqrt(1 + np.pi * tan**2)
        psi = azimuth(i, e, g)
        half, f = np.sin(psi / 2) ** 2, np.exp(-2 * np.tan(psi / 2))

        def e1(y: float) -> float:
            return np.exp(-2 / np.pi / tan / np.tan(y))

        def e2(y: float) -> float:
            return np.exp(-1 / np.pi / tan**2 / np.tan(y) ** 2)

        def eta(y: float) -> float:
            return chi * (np.cos(y) + np.sin(y) * tan * e2(y) / (2 - e1(y)))

        if i <= e:
            below = 2 - e1(e) - psi / np.pi * e1(i)
            mu0 = chi * (np.cos(i) + np.sin(i) * tan * (np.cos(psi) * e2(e) + half * e2(i)) / below)
            mu = chi * (np.cos(e) + np.sin(e) * tan * (e2(e) - half * e2(i)) / below)
            last = np.cos(i) / eta(i)
        else:
            below = 2 - e1(i) - psi / np.pi * e1(e)
            mu0 = chi * (np.cos(i) + np.sin(i) * tan * (e2(i) - half * e2(e)) / below)
            mu = chi * (np.cos(e) + np.sin(e) * tan * (np.cos(psi) * e2(i) + half * e2(e)) / below)
            last = np.cos(e) / eta(e)
        shadowing = mu / eta(e) * np.cos(i) / eta(i) * chi / (1 - f + f * chi * last)
        return smooth(i, e, g, mu0, mu) * shadowing / np.cos(i)

    return law


def azimuth(i: float, e: float, g: float) -> float:
    """Between the planes of incidence and of emission."""
    return float(np.arccos(np.clip((np.cos(g) - np.cos(i) * np.cos(e)) / (np.sin(i) * np.sin(e)), -1, 1)))


# Of each: the material, and its law.
LAWS: dict[str, tuple[jaxhf.Material, Law]] = {
    "Lommel and Seeliger": (jaxhf.LommelSeeliger(0.3), lommel_seeliger(0.3)),
    "McEwen": (jaxhf.LunarLambert(0.3), lunar_lambert(0.3)),
    "a limb": (jaxhf.LunarLambert(0.3, 0.4), lunar_lambert(0.3, 0.4)),
    "Minnaert": (jaxhf.Minnaert(0.3, 0.6), minnaert(0.3, 0.6)),
    "Oren and Nayar": (jaxhf.OrenNayar(0.3, 25.0), oren_nayar(0.3, 25.0)),
    "smooth Hapke": (jaxhf.Hapke(0.4, 0.3, 0.6), hapke(0.4, 0.3, 0.6)),
    "Hapke": (jaxhf.Hapke(0.4, 0.3, 0.6, 1.2, 0.07, 20.0), hapke(0.4, 0.3, 0.6, 1.2, 0.07, 20.0)),
}


def brdf(law: Law, wi: np.ndarray, wo: np.ndarray, n: np.ndarray) -> np.ndarray:
    """For unit vectors, shapes (..., 3); 0 where light or eye stand below the surface."""
    cosines = [np.sum(a * b, -1) for a, b in ((wi, n), (wo, n), (wi, wo))]
    angles = [np.ravel(np.arccos(np.clip(cosine, -1, 1))) for cosine in np.broadcast_arrays(*cosines)]
    found = [law(*three) if max(three[:2]) < np.pi / 2 else 0.0 for three in zip(*angles, strict=True)]
    return np.reshape(found, np.broadcast_shapes(*(cosine.shape for cosine in cosines)))
