"""What explains records: beside a rig that was itself identified, and of numbers that do not stand out alone."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect, apply_all
from workbench.gap.effects.nominal import IdentifiedPrior
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search.attribute import _significant, _without_negligible_parameters, with_identified_errors
from workbench.gap.search.fit import fit
from workbench.gap.search.intervals import with_intervals
from workbench.gap.search.search import Decision, Search, nearest
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.modes import Modes, PointShapes

OMEGA, MASS, NOISE, DOUBT = 10.0, 2.0, 1e-4, 3e-3
GAIN = Effect(kind_named("sensor_gain"), "y", {"gain": 1.2})


def identified(omega):
    """A mass on a spring, its frequency known to 0.3 %."""
    modes = Modes(
        omega=[omega],
        damping=[0.02],
        shapes=PointShapes(np.full((2, 1), MASS**-0.5)),
        domain=NamedPoints(("F", "y")),
        covariance=np.diag([(DOUBT * OMEGA) ** 2, 1e-8]),
        shape_covariance=np.full((1, 2, 2), 1e-6 / MASS),
    )
    return Rig(modes, (Actuator("F", "F"),), (Sensor("y", "y", noise_std=NOISE),))


def searched(nominal, real, seed, *, n_samples, sample_time, rms=1.0):
    """A search for what the record of a real rig shows under a random force."""
    rng = np.random.default_rng(seed)
    clean = simulate(real, rms * rng.normal(size=(1, n_samples)), sample_time=sample_time, name="test")
    record = replace(clean, outputs=clean.outputs + NOISE * rng.normal(size=clean.outputs.shape))
    data = FitData((record,), np.full(len(nominal.sensors), NOISE))
    before = data.by_channel(data.residual(nominal))
    return Search(nominal, data, data, data, CATALOGUE, lambda text, share: None, ALONE, before)


@pytest.mark.parametrize(("added", "kinds"), [(0.0, ["sensor_gain"]), (0.2, ["point_mass", "sensor_gain"])])
def test_a_mass_that_stood_for_an_error_of_the_identified_frequency_is_left_out(added, kinds):
    """ω² = k / (M + m): 0.3 % of the frequency is 0.6 % of the mass, and 0.2 kg is 10 %."""
    nominal = identified(OMEGA * (1.0 + DOUBT))
    mass = Effect(kind_named("point_mass"), None, {"at": "y", "mass": added})
    real = apply_all(identified(OMEGA), [GAIN, *([mass] if added else [])])
    search = searched(nominal, real, 2, n_samples=600, sample_time=0.05)
    alone = fit(nominal, (GAIN, replace(mass, values={"at": "y", "mass": added + 0.01})), search.data)
    assert alone.effects[1].values["mass"] > 0.008, "without the doubt it stands for the error"
    found = with_identified_errors(search, alone, IdentifiedPrior.of_modes(nominal), ())
    assert sorted(e.kind.name for e in found.effects if not e.kind.applied_first) == kinds


def test_friction_far_below_its_smoothing_speed_is_a_damper():
    """Of a damper of 0.3 N s/m the records tell the ratio of force and speed alone, and neither stands out."""
    nominal = identified(OMEGA)
    damper = Effect(kind_named("point_damper"), None, {"at": "y", "coefficient": 0.3})
    search = searched(nominal, damper.apply(nominal), 4, n_samples=600, sample_time=0.05)
    friction = Effect(kind_named("coulomb_friction"), None, {"at": "y", "force": 30.0, "smoothing_speed": 100.0})
    found = with_intervals(nominal, fit(nominal, (friction,), search.data), search.data)
    assert found.effects[0].kind is friction.kind and not found.effects[0].stands_out(nominal)
    (told,) = _significant(search, found, (), 0.0).effects
    assert told.kind is damper.kind
    assert told.values["coefficient"] == pytest.approx(0.3, abs=4.0 * told.std["coefficient"])


def test_friction_as_strong_in_both_directions_is_of_one_force():
    """Both forces are sure, so no standard error shows that one is enough."""
    nominal = identified(OMEGA)
    friction = Effect(kind_named("coulomb_friction"), None, {"at": "y", "force": 1.0, "smoothing_speed": 0.05})
    search = searched(nominal, friction.apply(nominal), 6, n_samples=600, sample_time=0.02, rms=5.0)
    values = {"at": "y", "force_forward": 1.01, "force_backward": 0.99, "smoothing_speed": 0.05}
    two_way = Effect(kind_named("two_way_friction"), None, values)
    found = with_intervals(nominal, fit(nominal, (two_way,), search.data.stepped(8)), search.data.stepped(8))
    assert found.effects[0].stands_out(nominal) and found.effects[0].is_sure(nominal)
    (told,) = _significant(search, found, (), 0.0).effects
    assert told.kind is friction.kind
    assert told.values["force"] == pytest.approx(1.0, abs=4.0 * told.std["force"])


def test_a_joint_of_hardly_any_yield_displacement_is_a_loss_of_stiffness():
    """Its stiffness stands out and its yield displacement does not: the records do not need the latter."""
    points = NamedPoints(("S1", "S2"), positions=np.eye(2, 3), directions=("x", "x"))
    elements = FiniteElements(2.0 * np.eye(2), 100.0 * np.array([[2.0, -1.0], [-1.0, 1.0]]), nodes=points)
    modes = replace(elements, damping=ModalDamping(0.02)).modes(2)
    sensors = tuple(Sensor(name, name, noise_std=NOISE) for name in points.names)
    nominal, where = Rig(modes, (Actuator("F", "S2"),), sensors), Between("S2", "S1")
    loss = Effect(kind_named("ground_spring"), None, {"at": where, "stiffness": -15.0})
    search = searched(nominal, loss.apply(nominal), 7, n_samples=400, sample_time=0.05)
    joint = Effect(kind_named("joint_slip"), None, {"at": where, "stiffness": 15.0, "yield_displacement": 1e-7})
    found = with_intervals(nominal, fit(nominal, (joint,), search.data.stepped(8)), search.data.stepped(8))
    assert found.effects[0].stands_out(nominal) and not found.effects[0].is_sure(nominal)
    (told,) = _significant(search, found, (), 0.0).effects
    assert told.kind is loss.kind
    assert told.values["stiffness"] == pytest.approx(-15.0, abs=4.0 * told.std["stiffness"])


@pytest.mark.parametrize(("speed", "stated"), [(1e-5, False), (0.05, True)])
def test_a_speed_that_the_records_do_not_tell_from_none_is_not_stated(speed, stated):
    """However sure the slope at one point of so stiff a law makes it."""
    nominal = identified(OMEGA)
    friction = Effect(
        kind_named("coulomb_friction"),
        None,
        {"at": "y", "force": 1.0, "smoothing_speed": speed},
        {"force": 0.1, "smoothing_speed": 0.04 * speed},
    )
    search = searched(nominal, friction.apply(nominal), 5, n_samples=600, sample_time=0.02, rms=5.0)
    (told,) = _without_negligible_parameters(search, fit(nominal, (friction,), search.data)).effects
    assert ("smoothing_speed" in told.stated(nominal)) == stated


def test_the_nearest_set_of_a_search_cut_short_is_the_one_that_leaves_least():
    """A search that ends beside errors of the model has fitted a mass alone, which leaves next to nothing."""
    nominal = identified(OMEGA)
    real = apply_all(nominal, [Effect(kind_named("point_mass"), None, {"at": "y", "mass": 0.2}), GAIN])
    record = simulate(real, np.random.default_rng(3).normal(size=(1, 600)), sample_time=0.05, name="test")
    data = FitData((record,), np.array([NOISE]))
    before = data.by_channel(data.residual(nominal))
    search = Search(nominal, data, data, data, CATALOGUE, lambda text, share: None, ALONE, before)
    start, gain, mass = (
        fit(nominal, effects, data)
        for effects in ((), (GAIN,), (Effect(kind_named("point_mass"), None, {"at": "y", "mass": 0.1}),))
    )
    assert mass.cost < 0.2 * gain.cost
    said = nearest(search, start, Decision("unknown", gain), [mass])
    assert said.outcome == "part" and said.best is mass
    kept = Decision("part", mass)
    assert nearest(search, start, kept, [gain]) is kept and nearest(search, start, kept, []) is kept
    explained = Decision("explained", gain)
    assert nearest(search, start, explained, [mass]) is explained
