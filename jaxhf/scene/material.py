"""Materials: how a surface reflects light.

mu0 and mu are the cosines of the angles of incidence and of emission, g is the phase angle, between the light and the eye.
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from ..core.types import COLOUR, FINITE, AnyArray, Number, Scalar, ScalarLeaf, Vector, float_leaf, rgb_leaf
from ..core.vector import GRAZING, angle, dot, greater, lesser, root, rounded_clamp
from .record import Record
from .texture import FlatTexture, ImageTexture

if TYPE_CHECKING:  # where a `brdf` is asked for textures have been looked up
    _Colour = jax.Array
else:
    _Colour = Float[AnyArray, "3"] | ImageTexture

_PER_CHANNEL = "be one number or three, or an ImageTexture"
_ALBEDO = Number(shape=(3,), shape_words=_PER_CHANNEL)
_PROBABILITY = Number("lie between 0 and 1", lambda value: (value >= 0) & (value <= 1), (3,), _PER_CHANNEL)
_SHARPNESS = Number("be at least 0 and below 1", lambda value: 0 <= value < 1)
_NOT_NEGATIVE = Number("be at least 0", lambda value: value >= 0)
_SLOPE = Number("be at least 0 and below 60 degrees", lambda value: 0 <= value < 60)
# A cosine by which something is divided; 0 within rounding.
_LEAST_COSINE = 1e-6


def _colour(value: Any) -> Any:
    return value if isinstance(value, ImageTexture) else rgb_leaf(value)


def _optional(value: Any) -> Any:
    return None if value is None else float_leaf(value)


class Material(Record):
    """A surface with two sides that scatters light into all directions, on the side on which it arrives.

    A material of your own is a subclass with a `brdf`. Its fields are the numbers on which that depends; an `ImageTexture`
    among them stands for its colour at the point that is looked at. A field `albedo` must be a factor of the whole: so a fit
    can seek it.
    """

    @abc.abstractmethod
    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Scalar | Vector:
        """The bidirectional reflectance distribution function, 1 / sr: radiance towards the eye by irradiance of the surface.

        Args:
          wi, wo: unit vectors towards the light and towards the eye, world frame.
          n: unit shading normal on the side that is seen. As it is interpolated, it may face away from light and eye a little.

        Returns:
          One number, or one for each channel, shape (3,). It must be finite, and so must its derivatives.
        """


class _Scaled(Material):
    """A material whose BRDF is proportional to its albedo."""

    albedo: _Colour = eqx.field(converter=_colour, metadata={"rule": _ALBEDO})


class Matte(_Scaled):
    """A Lambertian surface: albedo / pi, whatever the directions.

    Attributes:
      albedo: the reflected share of the light: a number, three numbers (r, g, b), or an `ImageTexture` over the shape's uv.
    """

    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Vector:
        return self.albedo / jnp.pi


class LommelSeeliger(_Scaled):
    """A layer of dark grains, which scatter each photon once: albedo / pi * 2 / (mu0 + mu).

    Seeliger, Zur Photometrie zerstreut reflectirender Substanzen, 1888; Hapke, Theory of Reflectance and Emittance
    Spectroscopy, 2nd edition 2012, chapter 8.

    Attributes:
      albedo: normal albedo: as bright as a `Matte` surface of that albedo is, where light and eye stand upright above it.
    """

    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Vector:
        mu0, mu = _cosines(wi, wo, n)
        return self.albedo / jnp.pi * (2 / (mu0 + mu))


class LunarLambert(_Scaled):
    """Part Lommel and Seeliger's law, part Lambert's: albedo / pi * (2 L / (mu0 + mu) + 1 - L).

    McEwen, Photometric functions for photoclinometry and other applications, Icarus 92, 1991.

    Attributes:
      albedo: as that of `LommelSeeliger`.
      limb: L, a number. None: McEwen's for the Moon, 1 - 0.019 g + 2.42e-4 g² - 1.46e-6 g³ with g in degrees, and 0 where that
        is negative, from 105 degrees on.
    """

    limb: ScalarLeaf | None = eqx.field(converter=_optional, default=None, metadata={"rule": FINITE})

    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Vector:
        mu0, mu = _cosines(wi, wo, n)
        limb = self.limb
        if limb is None:
            g = jnp.rad2deg(angle(*_phase(wi, wo)))
            limb = 1 + g * (-0.019 + g * (2.42e-4 - 1.46e-6 * g))
            limb = greater(limb, jnp.zeros_like(limb))
        return self.albedo / jnp.pi * (2 * limb / (mu0 + mu) + 1 - limb)


class Minnaert(_Scaled):
    """Limb darkening by a power: albedo / pi * (mu0 mu)^(k - 1).

    Minnaert, The reciprocity principle in lunar photometry, Astrophysical Journal 93, 1941.

    Attributes:
      albedo: as that of `LommelSeeliger`.
      k: 1 is Lambert's law, 0.5 a dark surface. The law has no bound where it is seen along the surface: within 0.6 degrees of
        that it counts as 0.6 degrees off.
    """

    k: ScalarLeaf = eqx.field(converter=float_leaf, default=0.5, metadata={"rule": FINITE})

    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Vector:
        mu0, mu = _cosines(wi, wo, n)
        mu = greater(mu, jnp.full_like(mu, GRAZING))
        return self.albedo / jnp.pi * jnp.exp((self.k - 1) * jnp.log(mu0 * mu))


class OrenNayar(_Scaled):
    """Lambertian facets, steeper than can be seen: albedo / pi * (A + B max(0, cos(phi)) sin(alpha) tan(beta)).

    Oren and Nayar, Generalization of Lambert's reflectance model, SIGGRAPH 1994, equation 30: the form without reflections
    between facets, which pbrt and others use.

    Attributes:
      albedo: of the facets, as that of `Matte`.
      roughness: standard deviation of their slopes' angles, degrees; 0 is Lambert's law.
    """

    roughness: ScalarLeaf = eqx.field(converter=float_leaf, default=20.0, metadata={"rule": _NOT_NEGATIVE})

    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Vector:
        mu0, mu = _cosines(wi, wo, n)
        square = jnp.deg2rad(self.roughness) * jnp.deg2rad(self.roughness)
        a, b = 1 - square / (2 * (square + 0.33)), 0.45 * square / (square + 0.09)
        # cos(phi) sin sin is cos(g) - mu0 mu; the smaller angle, whose tangent is asked for, has the greater cosine.
        together = dot(wi, wo) - mu0 * mu
        return self.albedo / jnp.pi * (a + b * greater(together, jnp.zeros_like(together)) / greater(mu0, mu))


class Hapke(Material):
    """A regolith: grains that scatter light one after the other, and shadow each other.

    Hapke, Theory of Reflectance and Emittance Spectroscopy, 2nd edition 2012, chapters 8, 9 and 12, for isotropic multiple
    scattering and no porosity (K = 1):
    w / (4 pi) / (mu0 + mu) * [p(g) (1 + opposition / (1 + tan(g / 2) / width)) + H(mu0) H(mu) - 1].

    Attributes:
      w: single-scattering albedo, 0 to 1: a number, three, or an `ImageTexture`.
      b, c: of a grain's phase function, two lobes of Henyey and Greenstein's: their sharpness, at least 0 and below 1, and by
        how much the backward one outweighs the forward one, -1 to 1: p(g) = sum over both signs of
        (1 ± c) / 2 * (1 - b²) / (1 ∓ 2 b cos(g) + b²)^1.5.
      opposition, width: height and half width (as tan(g / 2)) of the brightening near g = 0, where grains hide their own
        shadows. None: there is none.
      roughness: mean slope of what is too small to be seen, degrees, below 60. None: it is smooth.
    """

    w: _Colour = eqx.field(converter=_colour, metadata={"rule": _PROBABILITY})
    b: ScalarLeaf = eqx.field(converter=float_leaf, default=0.25, metadata={"rule": _SHARPNESS})
    c: ScalarLeaf = eqx.field(converter=float_leaf, default=0.5, metadata={"rule": FINITE})
    opposition: ScalarLeaf | None = eqx.field(converter=_optional, default=None, metadata={"rule": _NOT_NEGATIVE})
    width: ScalarLeaf = eqx.field(converter=float_leaf, default=0.06, metadata={"rule": Number("be above 0", lambda x: x > 0)})
    roughness: ScalarLeaf | None = eqx.field(converter=_optional, default=None, metadata={"rule": _SLOPE})

    def brdf(self, wi: Vector, wo: Vector, n: Vector) -> Vector:
        mu0, mu = _cosines(wi, wo, n)
        if self.roughness is None:
            once = 1 / (mu0 + mu)
        else:
            mu0, mu, once = _roughened(jnp.deg2rad(self.roughness), wi, wo, n)
        sine, cosine = _phase(wi, wo)
        square = self.b * self.b
        backward, forward = (1 + square - 2 * sign * self.b * cosine for sign in (1, -1))
        lobes = (
            (1 + sign * self.c) / 2 * (1 - square) / (lobe * jnp.sqrt(lobe)) for sign, lobe in ((1, backward), (-1, forward))
        )
        single = sum(lobes)
        if self.opposition is not None:
            tangent = sine / greater(1 + cosine, jnp.full_like(cosine, _LEAST_COSINE))
            single = single * (1 + self.opposition / (1 + tangent / self.width))
        return self.w / (4 * jnp.pi) * once * (single + self._chandrasekhar(mu0) * self._chandrasekhar(mu) - 1)

    def _chandrasekhar(self, x: Scalar) -> Vector:
        """Chandrasekhar's function H, by Hapke's approximation of 2002, within 1 %."""
        gamma = root(1 - self.w)
        r = (1 - gamma) / (1 + gamma)
        return 1 / (1 - self.w * x * (r + (0.5 - r * x) * jnp.log((1 + x) / x)))


# By the names that files and commands have for them; the first field of each is a colour or a texture.
SCATTERING: dict[str, Callable[..., Material]] = {
    "matte": Matte,
    "lommel-seeliger": LommelSeeliger,
    "lunar-lambert": LunarLambert,
    "minnaert": Minnaert,
    "oren-nayar": OrenNayar,
    "hapke": Hapke,
}


def map_textures(material: Any, fun: Callable[[Any], Any]) -> Any:
    """A material with something else in place of its textures."""

    def is_texture(leaf: Any) -> bool:
        return isinstance(leaf, ImageTexture | FlatTexture)

    return jax.tree.map(lambda leaf: fun(leaf) if is_texture(leaf) else leaf, material, is_leaf=is_texture)


def _cosines(wi: Vector, wo: Vector, n: Vector) -> tuple[Scalar, Scalar]:
    """mu0 and mu, above 0; where they are below 0.01 rounded off as the irradiance is."""
    mu0, mu = (rounded_clamp(dot(w, n)) for w in (wi, wo))
    least = jnp.full_like(mu0, _LEAST_COSINE)
    return greater(mu0, least), greater(mu, least)


def _phase(wi: Vector, wo: Vector) -> tuple[Scalar, Scalar]:
    """Sine and cosine of g; the derivative is 0 where the light stands behind the eye."""
    return _sine(wi, wo), dot(wi, wo)


def _sine(a: Vector, b: Vector) -> Scalar:
    """Length of a x b."""
    across = jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    return root(dot(across, across))


def _roughened(slope: Scalar, wi: Vector, wo: Vector, n: Vector) -> tuple[Scalar, Scalar, Scalar]:
    """Hapke's roughness (Icarus 59, 1984; chapter 12): effective cosines mu0e and mue, and
    S mu0e / (mu0e + mue) / mu0, which stands for 1 / (mu0 + mu)."""
    mu0, mu = _cosines(wi, wo, n)
    tangent = greater(jnp.tan(slope), jnp.full_like(slope, 1e-3))
    chi = 1 / jnp.sqrt(1 + jnp.pi * tangent * tangent)
    higher = mu0 > mu  # the light than the eye
    near, far = jnp.where(higher, mu0, mu), jnp.where(higher, mu, mu0)

    def of(cosine: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        sine = root(greater(1 - cosine * cosine, jnp.zeros_like(cosine)))
        cot = lesser(cosine / greater(sine, jnp.full_like(sine, 1e-3)) / tangent, jnp.full_like(cosine, 30.0))
        return sine, jnp.exp(-2 / jnp.pi * cot), jnp.exp(-cot * cot / jnp.pi)

    (sine_near, e1_near, e2_near), (sine_far, e1_far, e2_far) = of(near), of(far)
    # The azimuth between the two, of what they are across n.
    across_i, across_o = wi - dot(wi, n) * n, wo - dot(wo, n) * n
    opposite, beside = _sine(across_i, across_o), dot(across_i, across_o)
    psi, size = angle(opposite, beside), root(opposite * opposite + beside * beside)
    cosine = jnp.where(size > 0, beside / jnp.where(size > 0, size, 1), 1)
    half = (1 - cosine) / 2  # sin(psi / 2) squared
    whole = 2 - e1_far - psi / jnp.pi * e1_near
    near_e = chi * (near + sine_near * tangent * (cosine * e2_far + half * e2_near) / whole)
    far_e = chi * (far + sine_far * tangent * (e2_far - half * e2_near) / whole)
    eta_near, eta_far = (
        chi * (c + s * tangent * e2 / (2 - e1))
        for c, s, e1, e2 in ((near, sine_near, e1_near, e2_near), (far, sine_far, e1_far, e2_far))
    )
    f = jnp.exp(-2 * root(half) / greater(root((1 + cosine) / 2), jnp.full_like(half, 1e-3)))
    mu0_e, mu_e = jnp.where(higher, near_e, far_e), jnp.where(higher, far_e, near_e)
    shadowing = mu_e / (eta_near * eta_far) * chi / (1 - f + f * chi * near / eta_near)
    return mu0_e, mu_e, mu0_e / (mu0_e + mu_e) * shadowing


class Mirror(Record):
    """A perfect mirror with two sides.

    Attributes:
      reflectance: the reflected share: a number or three; pbrt's default is 0.9.
    """

    reflectance: Float[AnyArray, "3"] = eqx.field(converter=rgb_leaf, default=0.9, metadata={"rule": COLOUR})
