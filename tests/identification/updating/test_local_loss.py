import importlib.util
from pathlib import Path

import numpy as np
import pytest
import skfem
from scipy.sparse.linalg import eigsh
from skfem.helpers import dd, ddot, dot, grad

from workbench.identification.free_decay.order import identify
from workbench.identification.signal.synthesis import free_decay
from workbench.identification.updating.distributions import Basis
from workbench.identification.updating.local_loss import LOSS, locate_damage, scan
from workbench.identification.updating.sensitivity import LocalLoss
from workbench.identification.updating.structure_fit import fitted
from workbench.identification.updating.structure_problem import Problem, Task
from workbench.structure.member import Bar, Beam
from workbench.structure.modes import SampledModes

SENSORS = np.arange(1, 13) / 12
STRUCK = 47
NOMINAL = {
    "bar": Bar(length=1.0, mass_per_length=1.0, axial_stiffness=1.0, left="fixed", right="free"),
    "beam": Beam(length=1.0, mass_per_length=1.0, bending_stiffness=1.0, left="clamped", right="free"),
}


def measured(kind, *, lost, centre, added=0.0, step=0.0):
    """Six modes identified from 12 noisy sensors (40 dB) of a structure that scikit-fem solved, with a point mass at
    0.6 or a mass that jumps there."""
    x = np.linspace(0.0, 1.0, 241)
    element = skfem.ElementLineHermite() if kind == "beam" else skfem.ElementLineP2()
    basis = skfem.Basis(skfem.MeshLine(x), element, intorder=8)

    @skfem.BilinearForm
    def stiff(u, v, w):
        at = w.x[0]
        k = (1.3 - 0.2 * at**2) * np.where(np.abs(at - centre) < 0.05, 1.0 - lost, 1.0)
        return k * (ddot(dd(u), dd(v)) if kind == "beam" else dot(grad(u), grad(v)))

    @skfem.BilinearForm
    def mass(u, v, w):
        return (1.1 - 0.2 * w.x[0] + step * (w.x[0] > 0.6)) * u * v

    free = np.setdiff1d(np.arange(basis.N), basis.nodal_dofs[:, 0])
    k, m = stiff.assemble(basis), mass.assemble(basis).tolil()
    at = basis.nodal_dofs[0, 144]
    m[at, at] += added
    k, m = (matrix.tocsc()[np.ix_(free, free)] for matrix in (k, m))
    values, vectors = eigsh(k, 6, m, sigma=0.0)
    shapes = np.zeros((basis.N, 6))
    shapes[free] = vectors
    shapes = shapes[basis.nodal_dofs[0]]
    omega = np.sqrt(values)
    at_sensors = shapes[np.rint(SENSORS * 240).astype(int)]
    truth = SampledModes(omega, np.full(6, 0.01), -1j * at_sensors * shapes[STRUCK] / omega, SENSORS)
    options = {"sample_time": 0.8 * np.pi / omega[-1], "n_samples": 2000, "quantity": "acceleration"}
    level = np.sqrt((free_decay(truth, **options).outputs ** 2).mean())
    return identify(free_decay(truth, noise_std=0.01 * level, seed=1, **options)).refined


@pytest.mark.parametrize(("kind", "centre"), [("beam", 0.625), pytest.param("bar", 0.3, marks=pytest.mark.slow)])
def test_a_fifth_of_the_stiffness_lost_over_a_tenth_of_the_length_is_found(kind, centre):
    """Neither mass nor stiffness is known, but for the mass at one place."""
    found = locate_damage(
        measured(kind, lost=0.2, centre=centre),
        NOMINAL[kind],
        known_mass=[(0.5, 1.0)],
        mass_terms=[2],
        stiffness_terms=[2, 3],
    )
    assert found.detected and found.damaged.explains and not found.undamaged.explains and not found.remarks
    assert str(found).startswith("a loss of stiffness is detected") and "share" in str(found)
    assert abs(found.loss.centre - centre) < 0.005
    low, high = found.interval(0.999).T
    assert (low < [0.2, centre, 0.1]).all() and ([0.2, centre, 0.1] < high).all()
    x = np.array([0.01, centre - 0.06, centre - 0.04, centre, centre + 0.04, centre + 0.06, 0.9])
    truth = (1.3 - 0.2 * x**2) * np.where(np.abs(x - centre) < 0.05, 0.8, 1.0)
    assert np.abs(found.best.stiffness(x) / truth - 1).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["beam", "bar"])
def test_nothing_is_found_where_nothing_is_lost(kind):
    found = locate_damage(
        measured(kind, lost=0.0, centre=0.5),
        NOMINAL[kind],
        known_mass=[(0.5, 1.0)],
        mass_terms=[2],
        stiffness_terms=range(1, 4),
    )
    assert not found.detected and found.loss is None
    assert found.best is found.undamaged and found.undamaged.explains


@pytest.mark.parametrize("added", [0.02, pytest.param(0.2, marks=pytest.mark.slow)])
def test_a_point_mass_that_the_nominal_lacks_is_no_damage(added):
    with pytest.warns(UserWarning, match="kg at 0.6 m, which the nominal structure lacks"):
        found = locate_damage(
            measured("beam", lost=0.0, centre=0.5, added=added),
            NOMINAL["beam"],
            known_mass=[(0.5, 1.0)],
            mass_terms=[2],
            stiffness_terms=[3],
        )
    assert found.statistic > found.threshold and not found.detected and found.loss is None
    part = found.best.structure.attachments[-1]
    assert (
        found.best.explains and part.at == pytest.approx(0.6, abs=1e-3) and part.mass == pytest.approx(added, rel=0.01)
    )
    assert str(found).startswith("no loss of stiffness is detected")


def test_what_a_loss_leaves_unexplained_is_not_told_as_damage():
    with pytest.warns(UserWarning, match="the modes are not explained: χ² is .*: no proof of damage"):
        found = locate_damage(
            measured("beam", lost=0.0, centre=0.5, step=-0.4),
            NOMINAL["beam"],
            known_mass=[(0.5, 1.0)],
            mass_terms=[1],
            stiffness_terms=[1],
        )
    assert found.statistic > found.threshold and not found.detected
    assert str(found).startswith("whether stiffness is lost is unknown")


def test_the_first_look_points_at_the_place():
    task = Task.of(measured("beam", lost=0.02, centre=0.4), NOMINAL["beam"], known_mass=[(0.5, 1.0)])
    problem = Problem.of(task, Basis.polynomial(2), Basis.polynomial(3))
    places, gains = scan(problem, fitted(problem))
    assert abs(places[np.argmax(gains[LOSS.trial_widths.index(0.1)])] - 0.4) < 0.05


@pytest.fixture(scope="module")
def beside_the_end():
    """Lost from 0.87 to 0.97 of a beam; near its free end the moment is next to nothing."""
    return measured("beam", lost=0.2, centre=0.92)


def test_an_edge_that_passes_the_end_comes_back(beside_the_end):
    task = Task.of(beside_the_end, NOMINAL["beam"], known_mass=[(0.5, 1.0)])
    problem = Problem.of(task, Basis.polynomial(2), Basis.polynomial(3))
    from_truth = fitted(problem, loss=LocalLoss(0.2, 0.92, 0.1))
    from_beyond = fitted(problem, loss=LocalLoss(0.2, 0.98, 0.2))
    assert from_beyond.chi2 == pytest.approx(from_truth.chi2, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("centre", [0.92, pytest.param(0.96, marks=pytest.mark.slow)])
def test_what_of_a_loss_passes_the_end_is_not_told(centre, beside_the_end):
    modes = beside_the_end if centre == 0.92 else measured("beam", lost=0.2, centre=centre)
    found = locate_damage(modes, NOMINAL["beam"], known_mass=[(0.5, 1.0)], mass_terms=[2], stiffness_terms=[3])
    loss, truth = found.loss, LocalLoss(0.2, centre, 0.1).within(1.0)
    assert loss.centre + 0.5 * loss.width <= 1.0 + 1e-12
    low, high = found.interval().T
    assert (low < [truth.share, truth.centre, truth.width]).all() and (high > [0.2, truth.centre, truth.width]).all()
    assert high[2] - low[2] > 0.01  # the edge near the end is all but unknown


@pytest.mark.slow
def test_a_loss_is_found_where_few_terms_lead_to_a_false_place():
    """A bar recorded as loud as the noise: with three terms each, the likeliest loss is a sliver near an end."""
    root = Path(__file__).parents[3]
    spec = importlib.util.spec_from_file_location("local_loss", root / "studies/local_loss.py")
    study = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(study)
    hidden, found = study.tried("bar", study.FIRST_SEED, level_db=0.0)
    assert found.detected
    assert found.loss.centre == pytest.approx(hidden.centre, abs=study.WITHIN)
    low, high = found.interval().T
    truth = [hidden.share, hidden.centre, study.WIDTH]
    assert (low < truth).all() and (truth < high).all()


def test_a_number_of_terms_must_be_given():
    with pytest.raises(ValueError, match="no number of terms was given"):
        locate_damage(measured("beam", lost=0.0, centre=0.5), NOMINAL["beam"], known_mass=[(0.5, 1.0)], mass_terms=[])
