"""Intervals of effects on a nominal rig that was itself identified: they hold by the doubt of its modes."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.effects.nominal import IdentifiedPrior, nominal_errors
from workbench.gap.prediction.residuals import FitData
from workbench.gap.search.fit import fit
from workbench.gap.search.intervals import with_intervals
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes, PointShapes

OMEGA, ZETA, MASS, NOISE, DOUBT = 10.0, 0.02, 2.0, 1e-4, 3e-3
VAGUE = 0.2  # relative, of the shape: the frequency alone then tells the mass


def rig(omega=OMEGA, covariance=None):
    modes = Modes(
        omega=[omega],
        damping=[ZETA],
        shapes=PointShapes(np.full((2, 1), MASS**-0.5)),
        domain=NamedPoints(("F", "y")),
        covariance=covariance,
        shape_covariance=None if covariance is None else np.full((1, 2, 2), (VAGUE**2) / MASS),
    )
    return Rig(modes, (Actuator("F", "F"),), (Sensor("y", "y", noise_std=NOISE),))


def record(real, seed=2):
    rng = np.random.default_rng(seed)
    clean = simulate(real, rng.normal(size=(1, 600)), sample_time=0.05, name="test")
    return replace(clean, outputs=clean.outputs + NOISE * rng.normal(size=clean.outputs.shape))


def test_errors_have_the_covariance_that_was_identified():
    covariance = np.array([[4e-4, 1e-6], [1e-6, 1e-6]])
    prior = IdentifiedPrior.of_modes(rig(covariance=covariance))
    found = prior.root @ prior.root.T
    np.testing.assert_allclose(found[:2, :2], covariance, rtol=1e-9)
    np.testing.assert_allclose(found[2:, 2:], VAGUE**2 / MASS, rtol=1e-9)
    z = np.arange(prior.root.shape[1]) - 0.5
    off = nominal_errors(rig(), prior, {f"identified_{k + 1}": value for k, value in enumerate(z)}).apply(rig()).modes
    expected = np.array([OMEGA, ZETA]) + (prior.root @ z)[:2]
    np.testing.assert_allclose([off.omega[0], off.zeta[0]], expected, rtol=1e-12)
    assert IdentifiedPrior.of_modes(rig()) is None


def test_an_added_mass_is_as_doubtful_as_the_frequency_it_is_told_by():
    """ω² = k / (M + m): one standard deviation of ω off, m is off by 2 M of it, and that is its own deviation."""
    added = 0.06
    truth = Effect(kind_named("point_mass"), None, {"at": "y", "mass": added}).apply(rig())
    off = OMEGA * (1.0 + DOUBT)
    data = FitData((record(truth),), np.array([NOISE]))
    found = {}
    for name, covariance in (("sure", None), ("doubtful", np.diag([(DOUBT * OMEGA) ** 2, 1e-8]))):
        nominal = rig(off, covariance)
        prior = IdentifiedPrior.of_modes(nominal)
        beside = () if prior is None else (nominal_errors(nominal, prior),)
        mass = Effect(kind_named("point_mass"), None, {"at": "y", "mass": 0.03})
        fitted = with_intervals(nominal, fit(nominal, (mass, *beside), data), data, wide=True).effects[0]
        found[name] = fitted.values["mass"], fitted.std["mass"]
    value, deviation = found["doubtful"]
    assert deviation == pytest.approx(2.0 * MASS * DOUBT, rel=0.25)
    assert abs(value - added) < 1.96 * deviation
    assert abs(found["sure"][0] - added) > 3.0 * found["sure"][1], "without the doubt the interval misses"
