"""A nominal model that is a little off: figures of the model are told from effects that it lacks."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.diagnose import diagnose
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import NOMINAL_FIGURES
from workbench.gap.prediction.residuals import FitData
from workbench.gap.report.verdict import _off_by
from workbench.gap.search.beside_nominal import figures
from workbench.gap.search.fit import cost_of, fit, sensitivity
from workbench.rig.elements import CoulombFriction, CubicSpring
from workbench.rig.rig import Rig

NOISE = 1e-5
FREQUENCIES, DAMPING = np.array([1.004, 0.997, 1.006, 0.995]), np.array([1.1, 0.95, 1.08, 0.9])


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(n_modes=4)


def off(rig: Rig) -> Rig:
    """The rig with frequencies and damping ratios a little off."""
    root = np.sqrt(FREQUENCIES * DAMPING)
    modes = rig.modes
    changed = replace(modes, omega=modes.omega * FREQUENCIES, damping=modes.damping * np.outer(root, root))
    return replace(rig, modes=changed)


@pytest.fixture(scope="module")
def measured(record_of):
    def make(real, name, level, seed):
        rng = np.random.default_rng(seed)
        return record_of(real, np.repeat(level * rng.normal(size=200), 5)[None], rng, name=name, substeps=8)

    return make


@pytest.fixture(scope="module")
def records(measured):
    return lambda real: [measured(real, "low", 0.1, 0), measured(real, "high", 1.0, 1)]


def test_residual_gives_way_to_figures_as_a_fit_of_them_would(rig, records):
    """To first order the projected cost is what least squares over the figures, with their beliefs, leaves."""
    data = FitData(tuple(records(off(rig))), np.full(4, NOISE))
    freed = fit(rig, (figures(rig),), data).effects
    jacobian, residual = sensitivity(rig, freed, data), data.residual(apply_all(rig, freed))
    projected = data.giving_way(jacobian)
    k = jacobian.shape[1]
    stacked = np.linalg.lstsq(np.r_[jacobian, np.eye(k)], np.r_[residual, np.zeros(k)], rcond=None)[0]
    left = residual - jacobian @ stacked
    expected = (left @ left + stacked @ stacked) / residual.size
    assert cost_of(rig, freed, projected) == pytest.approx(expected, rel=1e-9)
    # and a force that the figures can stand for nearly vanishes, one that they cannot does not
    moved = (replace(freed[0], values={**freed[0].values, "frequency_1": freed[0].values["frequency_1"] * 1.0003}),)
    assert cost_of(rig, moved, data) > 20.0 > 2.0 > cost_of(rig, moved, projected)


def test_figures_a_little_off_are_told_as_such(rig, records):
    verdict = diagnose(rig, records(off(rig)), free_nominal=True)
    assert verdict.outcome == "explained" and [e.kind.name for e in verdict.effects] == ["nominal_figures"]
    found = verdict.nominal_figures
    np.testing.assert_allclose([found[f"frequency_{r}"] for r in (1, 2, 3)], FREQUENCIES[:3], atol=2e-4)
    np.testing.assert_allclose([found[f"damping_{r}"] for r in (1, 2, 3)], DAMPING[:3], rtol=1e-2)
    assert "frequencies -0.5 to 0.6 %" in verdict.sentence


def test_friction_beside_figures_a_little_off(rig, measured, records):
    """Freed before it is known, the damping ratios would take the friction for theirs."""
    truth = CoulombFriction(1.37, 0.004, 1e-3)
    real = off(replace(rig, elements=(truth,)))
    held_out = [measured(real, "held out", 0.6, 9)]
    verdict = diagnose(rig, records(real), validation=held_out, free_nominal=True)
    named = {e.kind.name: e for e in verdict.effects}
    assert verdict.outcome == "explained" and set(named) == {"coulomb_friction", "nominal_figures"}
    friction = named["coulomb_friction"].values
    assert friction["force"] == pytest.approx(truth.force, rel=0.02) and abs(friction["at"] - truth.at) < 0.01
    assert verdict.nominal_figures["damping_1"] == pytest.approx(DAMPING[0], rel=0.02)
    assert verdict.shrinkage.overall > 0.99


@pytest.mark.slow
def test_nobody_has_to_say_that_figures_are_off(rig, records):
    real = off(replace(rig, elements=(CoulombFriction(1.37, 0.004, 1e-3),)))
    verdict = diagnose(rig, records(real))
    named = {e.kind.name: e for e in verdict.effects}
    assert verdict.outcome == "explained" and set(named) == {"coulomb_friction", "nominal_figures"}
    assert named["coulomb_friction"].values["force"] == pytest.approx(0.004, rel=1e-2)
    np.testing.assert_allclose(
        [verdict.nominal_figures[f"frequency_{r}"] for r in (1, 2, 3)], FREQUENCIES[:3], atol=2e-4
    )


@pytest.mark.slow
def test_two_effects_beside_figures_that_are_known_to_be_off(rig, records):
    two = replace(rig, elements=(CoulombFriction(1.37, 0.03, 1e-3), CubicSpring(0.62, 500.0)))
    verdict = diagnose(rig, records(off(two)), free_nominal=True)
    assert verdict.outcome == "explained"
    assert {e.kind.name for e in verdict.effects} == {"coulomb_friction", "cubic_spring", "nominal_figures"}


def test_a_single_figure_is_told_as_one():
    one = Effect(NOMINAL_FIGURES, None, {"frequency_1": 0.983, "damping_1": 0.9932, "modal_mass": 1.0})
    assert _off_by(one) == "frequency -1.7 %, damping ratio -0.68 %"
    two = Effect(NOMINAL_FIGURES, None, {**one.values, "frequency_2": 1.004, "damping_2": 0.9932})
    assert _off_by(two) == "frequencies -1.7 to 0.4 %, damping ratios -0.68 %"
