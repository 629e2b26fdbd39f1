"""Curvatures against closed forms of a sphere, a cylinder, a cone and a saddle, and a quadratic's own."""

import numpy as np
import pytest

import jaxhf
from jaxhf.maps.choices import CURVATURES, QUADRATICS

N, R = 41, 1000.0
Y, X = np.mgrid[:N, :N] - (N - 1) / 2


@pytest.mark.parametrize("quadratic", QUADRATICS)
@pytest.mark.parametrize(("dx", "dy"), [(4.0, 4.0), (3.0, 5.0)])
def test_of_round_surfaces(quadratic, dx, dy):
    x, y = X * dx + 300, Y * dy + 200  # beside the top, where the slope is 20 degrees

    def found(z, kind):
        return jaxhf.curvature(z, dx, dy, kind=kind, quadratic=quadratic)[1:-1, 1:-1].astype(np.float64)

    inner = np.s_[1:-1, 1:-1]
    away = np.hypot(x, y)[inner]
    ball = np.sqrt(R**2 - x**2 - y**2) - R  # near 0, where single precision tells heights apart
    wants = {"profile": 1 / R, "tangential": 1 / R, "mean": 1 / R, "gaussian": 1 / R**2, "plan": 1 / away}
    for kind, wanted in wants.items():
        np.testing.assert_allclose(found(ball, kind), wanted + 0 * away, rtol=2e-3, err_msg=kind)
        sign = 1 if kind == "gaussian" else -1
        np.testing.assert_allclose(found(-ball, kind), sign * found(ball, kind), rtol=1e-3)  # a bowl
    pipe = np.sqrt(R**2 - x**2) - R
    np.testing.assert_allclose(found(pipe, "mean"), 0.5 / R, rtol=2e-3)
    np.testing.assert_allclose(found(pipe, "profile"), 1 / R, rtol=2e-3)
    for kind in ("gaussian", "tangential", "plan"):
        np.testing.assert_allclose(found(pipe, kind), 0, atol=1e-6)
    cone = 180 - 0.5 * np.hypot(x, y)  # straight down the slope, round across it
    np.testing.assert_allclose(found(cone, "profile"), 0, atol=2e-6)
    np.testing.assert_allclose(found(cone, "plan"), 1 / away, rtol=2e-3)
    np.testing.assert_allclose(found(cone, "tangential"), 0.5 / np.sqrt(1.25) / away, rtol=2e-3)
    np.testing.assert_allclose(found(cone, "gaussian"), 0, atol=1e-8)


@pytest.mark.parametrize("quadratic", QUADRATICS)
def test_of_a_saddle_and_a_summit(quadratic):
    """Where the ground is level: principal curvatures are the second derivatives, and the slope has no direction."""
    middle = (N - 1) // 2

    def found(z, kind):
        return jaxhf.curvature(z, 2.0, 2.0, kind=kind, quadratic=quadratic)[middle, middle]

    saddle = 0.01 * (2 * X) ** 2 / 2 - 0.03 * (2 * Y) ** 2 / 2
    assert found(saddle, "mean") == pytest.approx(0.01)
    assert found(saddle, "gaussian") == pytest.approx(-0.0003)
    assert [found(saddle, kind) for kind in ("profile", "tangential", "plan")] == [0, 0, 0]
    assert found(saddle * 0, "mean") == 0


def test_units_and_holes():
    """Lengths twice as long bend half as much; vertical units count by `scale`; what has no neighbour has no value."""
    z = np.random.default_rng(0).normal(size=(9, 11)).astype(np.float32)
    once, twice = jaxhf.curvature(z, 1.0), jaxhf.curvature(2 * z, 2.0)
    np.testing.assert_allclose(twice[1:-1, 1:-1], once[1:-1, 1:-1] / 2, rtol=1e-5)
    feet = jaxhf.curvature(z / 0.3048, 1.0, scale=1 / 0.3048)
    np.testing.assert_allclose(feet[1:-1, 1:-1], once[1:-1, 1:-1], rtol=1e-4)
    assert (once[0] == -9999).all()
    z[4, 5] = np.nan
    assert (jaxhf.curvature(z, 1.0)[3:6, 4:7] == -9999).all()
    assert (jaxhf.curvature(z, 1.0, compute_edges=True) == -9999).sum() == 1


def test_says_what_is_wrong():
    with pytest.raises(ValueError, match=f"curvature: kind must be one of {', '.join(CURVATURES)}; it is 'max'"):
        jaxhf.curvature(np.zeros((3, 3)), 1.0, kind="max")
    with pytest.raises(ValueError, match=f"curvature: quadratic must be one of {', '.join(QUADRATICS)}; it is 'horn'"):
        jaxhf.curvature(np.zeros((3, 3)), 1.0, quadratic="horn")
