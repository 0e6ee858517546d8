from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from workbench.identification.free_decay.refinement import cramer_rao_bound
from workbench.identification.ring_down import ring_down
from workbench.identification.signal.synthesis import free_decay, impulse_response_modes
from workbench.identification.updating.distributions import Basis
from workbench.identification.updating.sensitivity import SeriesStructure
from workbench.identification.updating.structure_fit import choose_structure, fit_structure
from workbench.identification.updating.structure_problem import GaussianPrior
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar, Beam
from workbench.structure.supports import End, PointMass

X = np.linspace(0.02, 1.98, 9)
SENSORS = np.linspace(0.1, 1.93, 10)


def mass(x):
    return 1.5 + 0.3 * x


def stiffness(x):
    return 3.0 - 0.8 * x + 0.2 * x**2


def structure(kind, mass=mass, stiffness=stiffness):
    where = {"length": 2.0, "mass_per_length": mass, "right": "free"}
    if kind == "bar":
        return Bar(axial_stiffness=stiffness, left="fixed", **where)
    return Beam(bending_stiffness=stiffness, left="free" if kind == "free beam" else "clamped", **where)


def measured(kind, noise=1e-3):
    """Five elastic modes of the true structure, with the covariance that white noise in a record would leave."""
    rigid = 2 if kind == "free beam" else 0
    modes = structure(kind).modes(rigid + 5).select(slice(rigid, None))
    decay = impulse_response_modes(replace(modes, damping=np.full(5, 0.005)), at=1.73, positions=SENSORS)
    record = free_decay(decay, sample_time=1.0 / modes.omega[-1], n_samples=1500)
    return cramer_rao_bound(decay, record, noise_std=noise * float(np.sqrt((record.outputs**2).mean())))


def redrawn(exact, seed):
    """The same with errors of that covariance in frequencies and shapes."""
    rng, n = np.random.default_rng(seed), exact.modes.n_modes
    omega = rng.multivariate_normal(exact.modes.omega, exact.covariance[:n, :n])
    errors = np.array(
        [rng.multivariate_normal(np.zeros(SENSORS.size), c, method="eigh") for c in exact.shape_covariance]
    )
    return replace(exact, modes=replace(exact.modes, omega=omega, shapes=exact.modes.shapes + errors.T))


@pytest.mark.parametrize("kind", ["beam", "free beam", "bar"])
def test_exact_modes_give_exact_distributions(kind):
    """From a uniform start, whatever it is."""
    found = fit_structure(
        measured(kind),
        structure(kind, 1.0, 1.0),
        mass=Basis.polynomial(2),
        stiffness=Basis.splines(4, length=2.0),
        known_mass=[(0.5, 1.65), (1.5, 1.95)],
    )
    assert np.allclose(found.mass(X), mass(X), rtol=1e-6)
    assert np.allclose(found.stiffness(X), stiffness(X), rtol=1e-6)
    assert found.chi2 < 1e-6 and found.explains
    assert list(found.numbers) == [1, 2, 3, 4, 5]
    assert found.check.worst < 1e-9 and found.check.mac.min() > 1 - 1e-9
    assert np.ptp(found.mass.band(X), axis=0).max() < 1e-6  # two points hold a line


def test_as_many_terms_as_there_are():
    noisy = redrawn(measured("beam", 1e-2), seed=4)
    found = choose_structure(noisy, structure("beam", 1.0, 1.0), known_mass=[(1.0, 1.8)])
    assert found.n_terms == (2, 3)
    assert found.explains
    assert "explains the 5 modes" in str(found) and len(str(found).splitlines()) == 13 and not found.remarks
    assert repr(found.mass).startswith("<UncertainProfile: from 1.498 to 2.102")
    with pytest.warns(UserWarning, match="the modes are not explained: χ² is .*mass 1.8 to 1.8 kg/m"):
        few = fit_structure(
            noisy,
            structure("beam", 1.0, 1.0),
            mass=Basis.polynomial(1),
            stiffness=Basis.polynomial(2),
            known_mass=[(1.0, 1.8)],
        )
    assert not few.explains and few.criterion > found.criterion
    assert "does not explain the 5 modes" in str(few) and str(few).splitlines()[-1] == few.remarks[0]


def test_a_series_that_dips_between_the_points_of_integration_is_no_structure():
    """A trough of one thousandth of the length, where a finished structure is checked."""
    trough = Basis(lambda x: np.exp(-(((np.asarray(x)[:, None] - 2.0 * 0.98804) / 1e-3) ** 2)), 1)
    series = SeriesStructure(structure("beam", 1.0, 1.0), Basis.polynomial(0), trough, SENSORS, 3)
    assert series.solve(np.zeros(0), np.array([-0.9])) is not None
    assert series.solve(np.zeros(0), np.array([-1.1])) is None
    with pytest.raises(ValueError, match="must be positive inside"):
        structure("beam", 1.0, lambda x: 1.0 - 1.1 * trough.functions(np.ravel(x))[:, 0].reshape(np.shape(x)))


def test_without_terms_the_nominal_structure_is_compared_with_the_modes():
    """It has no free parameter; this ended in an error of numpy."""
    none = {"mass": Basis.polynomial(0), "stiffness": Basis.polynomial(0)}
    found = fit_structure(measured("beam"), structure("beam"), **none)
    assert found.n_terms == (0, 0) and found.explains and found.stiffness.std(X).max() < 1e-12
    with pytest.warns(UserWarning, match="the modes are not explained"):
        stiffer = fit_structure(measured("beam"), structure("beam", stiffness=lambda x: 1.1 * stiffness(x)), **none)
    np.testing.assert_allclose(stiffer.check.frequency_errors, np.sqrt(1.1) - 1.0, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["beam", pytest.param("bar", marks=pytest.mark.slow)])
def test_intervals_hold_the_truth_as_often_as_they_say(kind):
    """Share of draws whose nominal 95 % band holds the truth at each place, within what chance allows."""
    exact, draws = measured(kind, 1e-2), 120
    inside = np.zeros((2, X.size))
    for seed in range(draws):
        found = fit_structure(
            redrawn(exact, seed),
            structure(kind, 1.0, 1.0),
            mass=Basis.polynomial(2),
            stiffness=Basis.polynomial(3),
            known_mass=[(1.0, 1.8)],
        )
        for row, (profile, truth) in enumerate(((found.mass, mass(X)), (found.stiffness, stiffness(X)))):
            low, high = profile.band(X)
            inside[row] += (low - 1e-9 <= truth) & (truth <= high + 1e-9)
    least, most = binom.ppf([0.0005, 0.9995], draws, 0.95)
    assert ((inside >= least) & (inside <= most)).all(), inside / draws


def test_a_prior_weighs_what_is_believed_against_what_is_measured():
    """Far from sure, the prior changes nothing; sure, it is the answer; between, the band narrows."""
    noisy = redrawn(measured("beam", 1e-2), seed=1)
    terms = {"mass": Basis.polynomial(0), "stiffness": Basis.splines(8, length=2.0)}
    nominal = structure("beam", stiffness=2.6)
    free = fit_structure(noisy, nominal, **terms)
    with pytest.warns(UserWarning, match="stiffness 2.6 to 2.6 N m²"):  # of the one that is sure
        loose, fair, sure = (
            fit_structure(noisy, nominal, stiffness_prior=GaussianPrior(std, 0.5), **terms) for std in (1e3, 0.2, 1e-7)
        )
    assert np.allclose(loose.stiffness(X), free.stiffness(X), atol=0.05 * free.stiffness.std(X).max())
    assert np.allclose(sure.stiffness(X), 2.6, rtol=1e-4)
    assert (fair.stiffness.std(X) < free.stiffness.std(X)).all()
    assert np.abs(fair.stiffness(X) - stiffness(X)).max() < np.abs(free.stiffness(X) - stiffness(X)).max()


def test_refusals():
    exact = measured("beam")
    nominal, one = structure("beam", 1.0, 1.0), Basis.polynomial(1)
    with pytest.raises(ValueError, match="give known_mass at a point"):
        fit_structure(exact, nominal, mass=one, stiffness=one)
    with pytest.raises(ValueError, match="cannot take the 2 known masses"):
        fit_structure(exact, nominal, mass=one, stiffness=one, known_mass=[(0.0, 1.5), (2.0, 2.1)])
    with pytest.raises(ValueError, match="51 terms cannot be found from 50 data"):
        fit_structure(exact, nominal, mass=one, stiffness=Basis.splines(51, length=2.0), known_mass=[(1.0, 1.8)])
    with pytest.raises(ValueError, match="a known mass must be positive and finite; got -1 at x = 1"):
        fit_structure(exact, nominal, mass=one, stiffness=one, known_mass=[(1.0, -1.0)])
    with pytest.raises(ValueError, match="resembles no mode of the nominal"):
        scrambled = replace(exact.modes, shapes=exact.modes.shapes[::-1] * np.arange(1, 11)[:, None] ** 2)
        fit_structure(replace(exact, modes=scrambled), nominal, mass=one, stiffness=one, known_mass=[(1.0, 1.8)])
    with pytest.raises(ValueError, match="5 different modes"):
        fit_structure(exact, nominal, mass=one, stiffness=one, known_mass=[(1.0, 1.8)], numbers=[1, 2, 3])
    unplaced = replace(exact, modes=replace(exact.modes, positions=np.r_[np.nan, SENSORS[1:]]))
    with pytest.raises(ValueError, match="sensor 1 has no place"):
        fit_structure(unplaced, nominal, mass=one, stiffness=one, known_mass=[(1.0, 1.8)])
    with pytest.raises(ValueError, match="a prior needs a positive standard deviation"):
        GaussianPrior(0.0, 1.0)


def test_a_beam_on_springs_with_a_mass_from_its_ring_down():
    """A record with noise (40 dB) to modes, mass, stiffness and eigenfunctions; wrong ends do not explain it."""

    def known(mass, stiffness, *ends, parts=()):
        return Beam(length=2.0, mass_per_length=mass, bending_stiffness=stiffness, left=ends[0], right=ends[1],
                    damping=ModalDamping(0.008), attachments=parts)  # fmt: skip

    def heavy(x):
        return 1.5 + 0.15 * x

    def stiff(x):
        return 30.0 - 9.0 * np.sin(np.pi * x / 2.0) ** 2

    ends, parts = (End(3e4, 50.0), End(2e4)), (PointMass(at=1.3, mass=0.25),)
    truth = known(heavy, stiff, *ends, parts=parts).modes(6)
    window = {"sample_time": 0.4 / truth.frequencies_hz[-1], "n_samples": 1500, "quantity": "acceleration"}
    decay = impulse_response_modes(truth, at=0.77, positions=np.linspace(0.05, 1.95, 10))
    level = np.sqrt((free_decay(decay, **window).outputs ** 2).mean())
    told = ring_down(free_decay(decay, noise_std=0.01 * level, seed=1, **window))
    assert told.modes.n_modes == 6 and not any(told.remarks)
    assert np.abs((told.modes.omega - truth.omega) / told.refined.omega_std).max() < 4.0
    found = choose_structure(
        told.refined,
        known(1.5, 30.0, *ends, parts=parts),
        known_mass=[(0.1, heavy(0.1))],
        mass_terms=[3],
        stiffness_terms=[7],
    )
    assert found.explains
    for profile, exact in ((found.mass, heavy), (found.stiffness, stiff)):
        low, high = profile.band(X)
        assert ((low <= exact(X)) & (exact(X) <= high)).mean() > 0.7
        assert np.abs(profile(X) / exact(X) - 1.0).max() < 0.02
    own = found.structure.modes(6).phi(X)
    assert np.abs(np.abs(own) - np.abs(truth.phi(X))).max() < 2e-3 * np.abs(own).max()
    hinged = known(1.5, 30.0, "hinged", "hinged")
    with pytest.warns(UserWarning, match="Put point masses, springs and the true ends into the nominal structure"):
        wrong = choose_structure(told.refined, hinged, known_mass=[(0.1, 1.515)], mass_terms=[3], stiffness_terms=[4])
    assert not wrong.explains
