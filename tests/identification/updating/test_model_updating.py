"""Parameters of finite-element models from measured modes: the truth, its standard errors, and what is refused."""

import numpy as np
import pytest

from workbench.identification.updating.model_updating import update_model
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.supports import PointSpring

NAMES = tuple(f"m{i}" for i in range(6))
TRUTH = np.array([90.0, 25.0])  # of the ground spring and of the joint, N/m


def row_of_masses(parameters):
    """Six masses in a row on springs; unknown are the spring to ground at one end and the joint in the middle."""
    stiffness = np.zeros((6, 6))
    for i in (0, 1, 3, 4):
        stiffness[i : i + 2, i : i + 2] += 100.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    model = FiniteElements(np.diag([1.0, 1.2, 0.8, 1.0, 1.5, 0.7]), stiffness, nodes=NamedPoints(NAMES))
    ground, joint = parameters
    return model.attached([PointSpring("m0", ground), PointSpring(Between("m2", "m3"), joint)]).modes(5)


def measured(seed, noise):
    modes, rng = row_of_masses(TRUTH), np.random.default_rng(seed)
    std = noise * modes.omega[:4]
    omega = modes.omega[:4] + std * rng.standard_normal(4)
    return {"omega": omega, "omega_std": std, "shapes": -3.0 * modes.phi(NAMES)[:, :4], "places": NAMES}


def test_without_noise_the_parameters_are_found():
    found = update_model(row_of_masses, [80.0, 30.0], **(measured(0, 0.0) | {"omega_std": 1e-3}))
    np.testing.assert_allclose(found.parameters, TRUTH, rtol=1e-6)
    assert found.converged and list(found.paired) == [0, 1, 2, 3] and found.mac.min() > 0.999999
    assert str(found).startswith("2 parameters updated") and "1 is 1 (1.000), 2 is 2 (1.000)" in str(found)


@pytest.mark.slow
def test_standard_errors_are_those_of_repeated_measurements():
    runs = [update_model(row_of_masses, [80.0, 30.0], **measured(seed, 2e-3)) for seed in range(30)]
    spread = np.std([run.parameters for run in runs], axis=0)
    np.testing.assert_allclose(runs[0].std, spread, rtol=0.35)
    score = np.array([(run.parameters - TRUTH) / run.std for run in runs])
    assert 0.85 < (np.abs(score) < 1.96).mean() <= 1.0


CHAIN = 100.0 * (2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)) - np.diag([0.0, 0.0, 100.0])
CORNERS = NamedPoints(tuple(f"{i}{d}" for d in "xy" for i in range(3)))


def tower(p):
    """Three masses that move in x and in y, on springs p times as stiff."""
    return FiniteElements(np.eye(6), np.kron(np.diag(p), CHAIN), nodes=CORNERS).modes(6)


def turned(truth, angle, noise=0.0, seed=0):
    """Its modes, each pair turned by an angle."""
    modes = tower(truth)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    std, shapes = 1e-3 * modes.omega, modes.phi(CORNERS.names) @ np.kron(np.eye(3), turn)
    omega = modes.omega * (1.0 + noise * np.random.default_rng(seed).standard_normal(6))
    return {"omega": omega, "omega_std": std, "shapes": shapes, "places": CORNERS.names}


def test_a_step_to_where_there_is_no_model_is_taken_back():
    """ω ∝ √p, so that steps of Gauss and Newton in ln p go too far."""
    refused = []

    def build(p):
        if p[0] > 0.90001:
            refused.append(p[0])
            raise ValueError("indefinite")
        return tower([p[0], p[0]])

    modes = turned([0.9, 0.9], 0.0)
    found = update_model(build, [0.2], **modes)
    assert refused and found.converged and not found.remarks
    np.testing.assert_allclose(found.parameters, 0.9, rtol=1e-6)
    with pytest.raises(ValueError, match="indefinite"):
        update_model(build, [1.0], **modes)


def row_of_floors(p, ground=0.0, floors=8):
    """Floors of 1 kg, the top p[1] kg, on springs of 100 p[0], the lowest less by `ground`."""
    stiffness = 100.0 * p[0] * (2.0 * np.eye(floors) - np.eye(floors, k=1) - np.eye(floors, k=-1))
    stiffness[-1, -1] = 100.0 * p[0]
    stiffness[0, 0] -= ground
    mass = np.diag([1.0] * (floors - 1) + [p[1]])
    return FiniteElements(mass, stiffness, nodes=NamedPoints(FLOORS)).modes(5)


FLOORS = tuple(f"floor {i}" for i in range(8))


@pytest.mark.parametrize(("top", "ground"), [(1.0, 60.0), (0.75, 67.0)])
def test_parameters_that_cannot_make_the_truth_are_not_taken_for_it(top, ground):
    """On a first storey as soft as 0.4 of the others: by the duality of a row of springs and masses, with all masses
    alike, it has the frequencies of one whose top floor is 1 / 0.4 as heavy, but not the shapes."""
    truth = row_of_floors([1.0, top], ground=ground)
    omega, shapes = truth.omega[:4], truth.phi(FLOORS)[:, :4]
    with pytest.warns(UserWarning) as warned:
        found = update_model(
            row_of_floors, [1.0, top], omega=omega, omega_std=1e-3 * omega, shapes=shapes, places=FLOORS
        )
    assert tuple(str(one.message) for one in warned) == found.remarks
    assert "does not look like the model's (MAC 0." in str(found)
    if top == 1.0:
        np.testing.assert_allclose(found.parameters, [1.0, 2.5], rtol=1e-6)
    else:  # the shapes are lost on the way
        assert not found.converged and "not converged: beyond these parameters the model has no such modes" in str(
            found
        )


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_modes_that_the_start_has_twice_are_told_apart_by_their_shapes(angle):
    """A tower as stiff in x as in y at the start. As ω ∝ √k, three modes each way give std(k) / k = 2 σ / √3."""
    truth = np.array([0.9, 0.97 if angle == 0.0 else 0.9])
    found = update_model(tower, [1.0, 1.0], **turned(truth, angle))
    np.testing.assert_allclose(found.parameters, truth, rtol=1e-6)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    wider = np.sqrt(np.diag(np.linalg.inv((turn**2).T @ turn**2)))  # each ω² is then a mean of both stiffnesses
    np.testing.assert_allclose(found.std / truth, 2e-3 / np.sqrt(3.0) * wider, rtol=1e-3)


@pytest.mark.slow
def test_intervals_hold_where_repeated_modes_are_turned_by_almost_half_a_right_angle():
    """Both frequencies of a pair then give the mean stiffness, and next to nothing the difference."""
    truth = np.array([0.9, 0.9])
    runs = [update_model(tower, [1.0, 1.0], **turned(truth, 0.735, 1e-3, seed)) for seed in range(30)]
    score = np.abs([(run.parameters - truth) / run.std for run in runs])
    assert (score < 1.96).mean() >= 0.9 and np.median([run.std for run in runs]) > 5e-3
    with pytest.raises(ValueError, match=r"cannot distinguish the parameters: .* turned half-way between"):
        update_model(tower, [1.0, 1.0], **turned(truth, np.pi / 4, 1e-3))


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"omega": [3.0, np.nan, 8.0, 9.0]}, "omega must be positive and finite; got .*nan"),
        ({"omega_std": np.ones(3)}, r"omega_std is one number, or one per mode, \(4,\); got \(3,\)"),
        ({"shapes": np.ones(6)}, r"shapes must be finite, .* with 4 measured frequencies; got \(6,\)"),
        ({"build": lambda p: None}, "build must return modes, .* got NoneType"),
    ],
)
def test_what_does_not_fit_is_named(changed, message):
    with pytest.raises(ValueError, match=message):
        update_model(**{"build": row_of_masses, "start": [80.0, 30.0], **measured(0, 1e-3), **changed})


def test_what_cannot_be_told_is_refused():
    with pytest.raises(ValueError, match="cannot determine 5 parameters"):
        update_model(row_of_masses, np.ones(5), **measured(0, 1e-3))
    with pytest.raises(ValueError, match="cannot distinguish the parameters"):
        update_model(lambda p: row_of_masses([p[0] * p[1], 25.0]), [9.0, 10.0], **measured(0, 1e-3))
    strange = measured(0, 1e-3)
    strange["shapes"][:, 3] = np.linalg.svd(row_of_masses(TRUTH).phi(NAMES))[0][:, 5]  # unlike any of five modes
    with pytest.raises(ValueError, match=r"measured mode 4, .* resembles no mode of the model"):
        update_model(row_of_masses, [80.0, 30.0], **strange)
