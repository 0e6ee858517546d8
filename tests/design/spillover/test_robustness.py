"""Draws have the covariance given, robustness the share that theory gives; closed loops give back the structure."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from workbench.design.estimation.controller import filtered
from workbench.design.estimation.modal_filter import hermite_filter
from workbench.design.laws.coupled import coupled_lqr
from workbench.design.laws.imsc import imsc
from workbench.design.laws.law import DesignError, Law
from workbench.design.loop.closed_loop import close_loop, impulse_state
from workbench.design.loop.reidentify import open_loop, updated
from workbench.design.spillover.robustness import draw_modes, perturbed_modes, robustness, stable_share
from workbench.rig.actuators import Actuator
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Beam

PLACES = [Actuator("F1", 2.0), Actuator("F2", 4.5), Actuator("F3", 7.0)]


def beam(n=6, zeta=0.01, stiffness=1.0):
    damping = ModalDamping(zeta)
    return Beam(
        length=10.0, mass_per_length=1.0, bending_stiffness=stiffness, left="hinged", right="hinged", damping=damping
    ).modes(n)


def test_draws_have_the_covariance_they_were_given():
    root = np.random.default_rng(0).standard_normal((4, 4)) * [[1e-3], [1e-3], [1e-4], [1e-4]]
    modes = replace(beam(2), covariance=root @ root.T)
    draws = np.array([np.r_[m.omega, m.zeta] for m in draw_modes(modes, 4000)])
    scale = np.sqrt(np.diag(modes.covariance))
    np.testing.assert_allclose(
        np.cov(draws.T) / np.outer(scale, scale), modes.covariance / np.outer(scale, scale), atol=0.08
    )


def test_shape_errors_have_their_size_at_the_sensors():
    modes = replace(beam(6), covariance=np.zeros((12, 12)))
    positions = np.linspace(1.0, 9.0, 6)
    covariance = np.array([0.01**2 * np.eye(6)] * 6)
    drawn = draw_modes(modes, 800, shape_covariance=covariance, positions=positions)
    errors = np.array([m.phi(positions) for m in drawn]) - modes.phi(positions)
    largest = np.abs(modes.phi(positions)).max(axis=0)
    np.testing.assert_allclose(errors.std(axis=0) / largest, 0.01, rtol=0.12)


def test_models_are_wrong_by_what_was_asked():
    modes = beam(6)
    wrong = perturbed_modes(modes, 0.02, count=600)
    x = np.linspace(0.0, 10.0, 401)
    missed = np.array([m.phi(x) for m in wrong]) - modes.phi(x)
    size = np.sqrt(np.trapezoid(missed**2, x, axis=1).mean(axis=0))  # shapes of unit size: ∫ m φ² dx = 1
    np.testing.assert_allclose(size, 0.02, rtol=0.08)
    np.testing.assert_allclose(np.std([m.omega / modes.omega for m in wrong], axis=0), 0.02, rtol=0.12)
    idle = Law(np.zeros((1, 2)), (0,), (PLACES[0],))
    assert stable_share(wrong, idle) == 1.0
    # a damping ratio that is its own standard error wide is negative in norm.cdf(-1) of the draws
    assert stable_share(perturbed_modes(beam(1), 1.0, count=1200), idle) == pytest.approx(norm.cdf(1.0), abs=0.05)
    with pytest.raises(DesignError, match=r"between 0 and 1, .* got nan"):
        perturbed_modes(modes, np.nan)


def test_models_that_are_hardly_wrong_keep_the_damping_that_couples_the_modes():
    damping = np.diag(np.diag(beam().damping)) + 0.02 * (np.ones((6, 6)) - np.eye(6))
    modes = replace(beam(), damping=damping)
    covariance = 1e-22 * np.eye(12)
    for model in (*perturbed_modes(modes, 1e-9, count=1), *draw_modes(replace(modes, covariance=covariance), 1)):
        np.testing.assert_allclose(model.damping, damping, rtol=1e-7)


@pytest.mark.slow
def test_robustness_is_the_share_of_positive_damping():
    """Without gain a loop is stable where every damping ratio drawn is positive: normal, so known."""
    covariance = np.zeros((2, 2))
    covariance[1, 1] = 0.01**2
    modes = replace(beam(1), covariance=covariance)
    law = Law(np.zeros((1, 2)), (0,), (PLACES[0],))
    idle = filtered(law, hermite_filter(modes, np.linspace(0.0, 10.0, 5), 1.0))
    found = robustness(draw_modes(modes, 1200), {"idle": idle}, state=impulse_state(modes, 6.3), final_time=1.0)["idle"]
    assert found.share == pytest.approx(norm.cdf(1.0), abs=4 * found.standard_error)
    assert np.isnan(found.work).mean() == pytest.approx(1 - found.share)


@pytest.mark.parametrize("design", [imsc, coupled_lqr])
def test_a_closed_loop_gives_back_the_drifted_structure(design):
    old, new = beam(), beam(stiffness=1.1)
    law = design(old, 3, PLACES, weight=30.0)
    # what moves is the new beam under the old law; the shapes of a uniform beam stay
    own = new.select(range(3))
    values, vectors = np.linalg.eig(close_loop(own, law).matrix)
    upper = np.flatnonzero(values.imag > 0)
    found = open_loop(old, law, values[upper], vectors[:3, upper])
    np.testing.assert_allclose(found.omega, own.omega, rtol=1e-9)
    np.testing.assert_allclose(found.damping, own.damping, atol=1e-9)
    assert found.coupling < 1e-9
    np.testing.assert_allclose(updated(old, range(3), found).omega[:3], new.omega[:3], rtol=1e-9)


def test_refusals():
    with pytest.raises(DesignError, match="carry no covariance"):
        draw_modes(beam(), 2)
    law = imsc(beam(), 3, PLACES, weight=30.0)
    with pytest.raises(DesignError, match="3 controlled modes need 3 poles"):
        open_loop(beam(), law, [1j], np.ones((3, 1)))
    with pytest.raises(DesignError, match="nearly dependent"):
        open_loop(beam(), law, [-0.1 + 1j] * 3, np.ones((3, 3)))


def test_a_loop_on_the_axis_counts_as_it_does_elsewhere():
    undamped = beam(zeta=0.0)
    law = imsc(undamped, 3, PLACES, weight=30.0)
    drawn = perturbed_modes(undamped, 0.01, count=12)
    found = robustness(drawn, {"IMSC": law}, state=impulse_state(undamped, 6.3), final_time=5.0)["IMSC"]
    assert found.share == stable_share(drawn, law) == 1.0 and np.isfinite(found.work).all()
