"""Laws that hold for every kind of the catalogue, and what single kinds promise of themselves."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import CATALOGUE, in_words, kind_named
from workbench.gap.effects.effect import (
    COORDINATES,
    Effect,
    Kind,
    Parameter,
    apply_all,
    contained,
    label_in_words,
    simpler_forms,
)
from workbench.gap.effects.environment import _is_distortion
from workbench.gap.effects.nonlinear import POWER_DAMPER, POWER_SPRING, in_catalogue
from workbench.gap.effects.transducers import clipped_level, exchanged_last
from workbench.gap.report.verdict import _described, effect_json
from workbench.records.record import Channel, Record
from workbench.rig.actuators import Actuator
from workbench.rig.force_laws import LAWS, USER, element_force
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import Between, NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.structure.member import Beam

DT = 0.05
NEW_UNITS = {"m": 1e3, "kg": 1e-3, "N": 1.0, "s": 1.0, "rad": 1.0, "Hz": 1.0, "": 1.0}  # mm, t, s: N stays N


def rig(length: float = 1.0, mass: float = 1.0) -> Rig:
    """A beam of 2 m and 6 kg, in units of which a metre and a kilogram are so many."""
    beam = Beam(
        length=2.0 * length,
        mass_per_length=3.0 * mass / length,
        bending_stiffness=5.0 * mass * length**3,
        left="hinged",
        right="clamped",
        damping=ModalDamping(0.02),
    )
    actuators = (Actuator("F1", 0.5 * length), Actuator("F2", 1.4 * length), Actuator("tap", 1.1 * length, direct=True))
    sensors = (
        Sensor("d", 0.3 * length, noise_std=1e-4 * length),
        Sensor("v", 0.9 * length, "velocity", noise_std=1e-4 * length),
        Sensor("d2", 1.5 * length, noise_std=1e-4 * length),
    )
    return Rig(beam.modes(4), actuators, sensors, structure=beam)


def drive(n: int = 200) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((3, n))


def values_of(parameters: tuple[Parameter, ...], changed: float | None) -> dict[str, float]:
    """Numbers at which the effect changes nothing, or somewhat, at the middle of the structure."""
    values = {}
    for p in parameters:
        if p.name == "at":
            values[p.name] = 0.45 * p.high
        elif p.neutral is not None and changed is None:
            values[p.name] = p.neutral
        else:
            values[p.name] = float(np.sqrt(p.low * p.high)) if p.logarithmic and p.low > 0 else 0.5 * p.high
    return values


def has_neutral(kind: Kind) -> bool:
    return any(p.neutral is not None for target in kind.targets(rig()) for p in kind.parameters(rig(), target))


NEUTRAL = [kind for kind in CATALOGUE if has_neutral(kind)]


@pytest.mark.parametrize("kind", NEUTRAL, ids=lambda kind: kind.name)
def test_a_kind_of_no_strength_changes_nothing(kind):
    nominal = rig()
    target = kind.targets(nominal)[0]
    changed = kind.apply(nominal, target, values_of(kind.parameters(nominal, target), None))
    expected = simulate(nominal, drive(), sample_time=DT, substeps=32).outputs
    found = simulate(changed, drive(), sample_time=DT, substeps=32).outputs
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


OF_THE_STRUCTURE = [kind for kind in CATALOGUE if kind.path == "structure"]


@pytest.mark.parametrize("kind", OF_THE_STRUCTURE, ids=lambda kind: kind.name)
def test_bounds_are_those_of_the_rig_in_any_units(kind):
    """The same beam in millimetres and tonnes has the same bounds, converted."""
    one, other = rig(), rig(length=1e3, mass=1e-3)
    for target in kind.targets(one):
        for p, q in zip(kind.parameters(one, target), kind.parameters(other, target), strict=True):
            factor = _factor(p.unit)
            assert (q.low, q.high) == (pytest.approx(p.low * factor), pytest.approx(p.high * factor)), p.name
            if not p.logarithmic or p.low < 0:
                assert q.scale == pytest.approx(p.scale * factor), p.name


def _factor(unit: str) -> float:
    """From metres and kilograms to millimetres and tonnes: N s^2/m^3 is 1e-9."""
    over, _, under = unit.partition("/")
    factor = 1.0
    for part, sign in [*((p, 1) for p in over.split()), *((p, -1) for p in under.split())]:
        name, _, power = part.partition("^")
        factor *= NEW_UNITS.get(name, 1.0) ** (sign * int(power or 1))
    return factor


@pytest.mark.parametrize("low", [1e-9, -10.0])
def test_a_parameter_goes_to_its_free_coordinate_and_back(low):
    parameter = Parameter("stiffness", "N/m", low, 10.0, logarithmic=True, scale=1e-9)
    for value in (3e-7, 0.02, 9.0, *((-0.02, -9.0) if low < 0 else ())):
        free = parameter.to_free(value)
        assert parameter.from_free(free) == pytest.approx(value, rel=1e-12)
        step = 1e-6
        slope = (parameter.from_free(free + step) - parameter.from_free(free - step)) / (2.0 * step)
        assert parameter.slope(value) == pytest.approx(slope, rel=1e-6)


def test_a_strength_of_nothing_starts_a_fit_at_the_least_that_there_may_be():
    strength = Parameter("mass", "kg", 1e-9, 1e3, logarithmic=True, neutral=0.0)
    assert strength.from_free(strength.to_free(0.0)) == pytest.approx(1e-9)


def test_a_spring_to_ground_may_be_negative():
    nominal, spring = rig(), kind_named("ground_spring")
    softer = spring.apply(nominal, None, {"at": 0.8, "stiffness": -1.0})
    stiffer = spring.apply(nominal, None, {"at": 0.8, "stiffness": 1.0})
    assert (softer.modes.omega < nominal.modes.omega).all() and (stiffer.modes.omega > nominal.modes.omega).all()
    first_order = (stiffer.modes.omega**2 - softer.modes.omega**2) / 2.0
    np.testing.assert_allclose(first_order, nominal.modes.phi(0.8)[0] ** 2, rtol=0.05)
    with pytest.raises(ValueError, match="unstable"):
        spring.apply(nominal, None, {"at": 0.8, "stiffness": -1e6})


def test_a_hysteretic_spring_that_always_slides_is_friction():
    effect = Effect(kind_named("bouc_wen"), None, {"at": 0.8, "stiffness": 500.0, "yield_displacement": 1e-3})
    spring, friction = simpler_forms(effect, rig())
    assert spring.kind is kind_named("ground_spring") and friction.kind is kind_named("coulomb_friction")
    assert friction.values["force"] == pytest.approx(0.5)
    assert ("point_damper",) in contained((effect,), rig()), "which far below its smoothing speed is a damper"


def test_friction_alike_both_ways_is_friction():
    numbers = {"force_forward": 0.3, "force_backward": 0.1, "smoothing_speed": 0.02}
    (friction,) = simpler_forms(Effect(kind_named("two_way_friction"), None, {"at": 0.8, **numbers}), rig())
    assert friction.values == {"at": 0.8, "force": pytest.approx(0.2), "smoothing_speed": 0.02}


def frame() -> Rig:
    """Three masses of 2 kg on springs of 800 N/m, all modes kept."""
    stiffness = 800.0 * (2.0 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1))
    points = NamedPoints(("S1", "S2", "S3"), positions=np.eye(3), directions=("x",) * 3)
    modes = FiniteElements(2.0 * np.eye(3), stiffness, nodes=points, damping=ModalDamping(0.02)).modes(3)
    sensors = tuple(Sensor(name, name, noise_std=1e-6) for name in points.names)
    return Rig(modes, (Actuator("F", "S3"),), sensors)


BETWEEN = {"at": Between("S2", "S1")}
LIMITS = [
    ("joint_slip", {**BETWEEN, "stiffness": 90.0, "yield_displacement": 1e-9}, "ground_spring"),
    ("clearance", {**BETWEEN, "stiffness": 90.0, "gap": 1e-9}, "ground_spring"),
    ("bouc_wen", {**BETWEEN, "stiffness": 90.0, "yield_displacement": 1e4}, "ground_spring"),
    ("bouc_wen", {"at": "S2", "stiffness": 9e4, "yield_displacement": 1e-6}, "coulomb_friction"),
    ("coulomb_friction", {"at": "S2", "force": 5e4, "smoothing_speed": 1e4}, "point_damper"),
    (
        "two_way_friction",
        {"at": "S2", "force_forward": 0.1, "force_backward": 0.1, "smoothing_speed": 0.05},
        "coulomb_friction",
    ),
    ("actuator_hysteresis", {"share": 0.2, "width": 1e-9}, "actuator_gain"),
]


@pytest.mark.parametrize(("name", "values", "limit"), LIMITS)
def test_a_law_at_a_bound_of_its_numbers_is_its_limiting_case(name, values, limit):
    nominal = frame()
    target = "F" if name.startswith("actuator") else None
    law = Effect(kind_named(name), target, values)
    (simpler,) = (form for form in simpler_forms(law, nominal) if form.kind.name == limit)
    command = np.repeat(np.random.default_rng(3).standard_normal((1, 60)), 4, axis=1)
    plain, there, same = (
        simulate(each, command, sample_time=0.02, substeps=64).outputs
        for each in (nominal, law.apply(nominal), simpler.apply(nominal))
    )
    assert np.abs(there - plain).max() > 0.01 * np.abs(plain).max()
    np.testing.assert_allclose(same, there, atol=0.03 * np.abs(there - plain).max())


def test_a_joint_that_never_slips_changes_nothing():
    nominal = frame()
    joint = Effect(kind_named("joint_slip"), None, {**BETWEEN, "stiffness": 90.0, "yield_displacement": 1e4})
    command = np.random.default_rng(3).standard_normal((1, 100))
    plain, there = (simulate(r, command, sample_time=0.02).outputs for r in (nominal, joint.apply(nominal)))
    np.testing.assert_allclose(there, plain, atol=1e-4 * np.abs(plain).max())


def test_what_acts_between_two_points_is_not_called_one_to_ground():
    nominal = frame()
    for stiffness, words in ((90.0, "a spring (stiffness 90 N/m)"), (-90.0, "a loss of stiffness (stiffness -90 N/m)")):
        between = Effect(kind_named("ground_spring"), None, {**BETWEEN, "stiffness": stiffness})
        assert _described(between, nominal) == f"{words} between S2 and S1"
        assert effect_json(between, nominal)["kind"] == "ground_spring"
    damper = Effect(kind_named("point_damper"), None, {**BETWEEN, "coefficient": 2.0})
    assert _described(damper, nominal) == "a viscous damper (coefficient 2 N s/m) between S2 and S1"
    assert _described(damper.moved_to("S2"), nominal).startswith("a viscous damper to ground")


def test_an_effect_is_unsure_where_a_number_that_is_stated_may_be_nothing():
    joint = Effect(
        kind_named("joint_slip"),
        None,
        {**BETWEEN, "stiffness": 90.0, "yield_displacement": 1e-8},
        {"stiffness": 1.0, "yield_displacement": 1e-7},
    )
    assert joint.stands_out(frame()) and not joint.is_sure(frame())
    assert replace(joint, std={"stiffness": 1.0, "yield_displacement": 1e-9}).is_sure(frame())


def test_rounding_of_all_sensors_is_described_with_their_unit():
    nominal = rig()
    of_one = replace(nominal, sensors=tuple(s for s in nominal.sensors if s.quantity == "displacement"))
    effect = Effect(kind_named("sensor_quantisation"), "all", {"step": 2e-3})
    assert _described(effect, of_one) == "quantisation of a sensor (all: step 0.002 m)"
    other = replace(of_one.sensors[0], name="v", quantity="velocity")
    assert "0.002)" in _described(effect, replace(of_one, sensors=(*of_one.sensors, other)))


def test_exchanged_channels_are_named_by_both():
    nominal = rig()
    effect = Effect(kind_named("swapped_outputs"), ("d", "d2"), {})
    plain, exchanged = (simulate(r, drive(), sample_time=DT).outputs for r in (nominal, effect.apply(nominal)))
    np.testing.assert_array_equal(exchanged, plain[[2, 1, 0]])
    assert effect.label == "swapped_outputs[d, d2]"
    assert effect_json(effect, nominal) == {"kind": "swapped_outputs", "parameters": {}, "output": "d", "with": "d2"}
    assert _described(effect, nominal) == "an exchange of two outputs (d and d2)"
    inputs = Effect(kind_named("swapped_inputs"), ("F1", "F2"), {})
    swapped = simulate(inputs.apply(nominal), drive(), sample_time=DT).outputs
    np.testing.assert_allclose(swapped, simulate(nominal, drive()[[1, 0, 2]], sample_time=DT).outputs, atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "channel", "values"),
    [
        ("actuator_gain", "F2", {"gain": 0.4}),
        ("actuator_delay", "F1", {"delay": 0.03}),
        ("actuator_saturation", "all", {"limit": 0.3}),
        ("actuator_misplacement", "F1", {"at": 0.9}),
        ("sensor_gain", "d2", {"gain": 0.4}),
        ("sensor_lag", "d", {"time_constant": 0.1}),
        ("sensor_bias", "v", {"bias": 0.1}),
        ("sensor_misplacement", "d", {"at": 0.7}),
        ("sensor_quantisation", "d", {"step": 0.05}),
    ],
)
def test_effects_are_told_of_the_transducer_itself_where_wires_are_exchanged(kind, channel, values):
    """The same model either way: a gain of the channel after the exchange is one of the actuator before it."""
    nominal, side = rig(), "inputs" if kind.startswith("actuator") else "outputs"
    pair = ("F1", "F2") if side == "inputs" else ("d", "d2")
    exchange = Effect(kind_named(f"swapped_{side}"), pair, {})
    effects = (exchange, Effect(kind_named(kind), channel, values))
    last = exchanged_last(effects)
    assert [e.kind.name for e in last] == [kind, f"swapped_{side}"]
    other = dict(zip(pair, pair[::-1], strict=True)).get(channel, channel)
    assert last[0].target == (channel if kind == "sensor_quantisation" else other)
    one, same = (simulate(apply_all(nominal, each), drive(), sample_time=DT).outputs for each in (effects, last))
    np.testing.assert_allclose(same, one, atol=1e-12)


def test_cross_talk_adds_a_share_of_another_reading():
    nominal = rig()
    effect = Effect(kind_named("sensor_crosstalk"), ("d", "v"), {"share": 0.2})
    plain, leaking = (simulate(r, drive(), sample_time=DT).outputs for r in (nominal, effect.apply(nominal)))
    np.testing.assert_allclose(leaking, plain + np.array([[0.2], [0.0], [0.0]]) * plain[1], atol=1e-12)
    assert effect_json(effect, nominal)["from"] == "v"
    assert _described(effect, nominal) == "cross-talk between sensors (d from v: share 0.2)"


def test_cross_talk_adds_a_share_of_another_command():
    nominal, kind = rig(), kind_named("actuator_crosstalk")
    effect = Effect(kind, ("F1", "F2"), {"share": 0.2})
    assert kind.targets(nominal) == (("F1", "F2"), ("F2", "F1")), "a hammer has no command"
    assert kind.targets(replace(nominal, actuators=nominal.actuators[1:])) == ()
    mixed = drive() + np.array([[0.2], [0.0], [0.0]]) * drive()[1]
    leaking = simulate(effect.apply(nominal), drive(), sample_time=DT).outputs
    np.testing.assert_allclose(leaking, simulate(nominal, mixed, sample_time=DT).outputs, atol=1e-12)
    told = effect_json(effect, nominal)
    assert (told["input"], told["from"]) == ("F1", "F2")
    assert _described(effect, nominal) == "cross-talk between actuators (F1 from F2: share 0.2)"
    twice = apply_all(nominal, [effect, Effect(kind, ("F1", "F2"), {"share": 0.1})])
    assert dict(twice.actuators[0].crosstalk) and sum(share for _, share in twice.actuators[0].crosstalk) == 0.2 + 0.1


@pytest.mark.parametrize("swapped_first", [True, False])
def test_cross_talk_stays_with_the_channel_where_inputs_are_exchanged(swapped_first):
    nominal = rig()
    effects = [
        Effect(kind_named("swapped_inputs"), ("F1", "F2"), {}),
        Effect(kind_named("actuator_crosstalk"), ("F1", "F2"), {"share": 0.2}),
    ]
    changed = apply_all(nominal, effects if swapped_first else effects[::-1])
    mixed = (drive() + np.array([[0.2], [0.0], [0.0]]) * drive()[1])[[1, 0, 2]]
    found, expected = simulate(changed, drive(), sample_time=DT), simulate(nominal, mixed, sample_time=DT)
    np.testing.assert_allclose(found.outputs, expected.outputs, atol=1e-12)


def _reconstruction(real: Rig, inputs: np.ndarray) -> SimpleNamespace:
    """What is left of a record of a real rig by the nominal one."""
    nominal = rig()
    seen, expected = (simulate(r, inputs, sample_time=DT) for r in (real, nominal))
    left = seen.outputs - expected.outputs
    return SimpleNamespace(rig=nominal, data=SimpleNamespace(records=(seen,)), residuals=(left,))


def test_cross_talk_of_actuators_starts_where_the_residual_shows_it():
    kind, gain = kind_named("actuator_crosstalk"), kind_named("actuator_gain")
    leaking = kind.apply(rig(), ("F1", "F2"), {"share": -0.3})
    (start,) = kind.starts(_reconstruction(leaking, drive()), ("F1", "F2"))
    assert start["share"] == pytest.approx(-0.3)
    wrong = gain.apply(rig(), "F1", {"gain": 1.2})
    assert list(kind.starts(_reconstruction(wrong, drive(6000)), ("F1", "F2"))) == []
    alike = drive()
    alike[1] = -0.7 * alike[0]  # the share is then a gain
    assert list(kind.starts(_reconstruction(leaking, alike), ("F1", "F2"))) == []


def test_a_number_whose_deviation_exceeds_it_does_not_stand_out():
    damper, nominal = kind_named("point_damper"), rig()
    sure = Effect(damper, None, {"at": 0.8, "coefficient": 1.0}, {"at": 0.01, "coefficient": 0.1})
    unsure = Effect(damper, None, {"at": 0.8, "coefficient": 1.1e6}, {"at": 0.01, "coefficient": 7e7})
    gain = Effect(kind_named("sensor_gain"), "d", {"gain": 1.0}, {"gain": 0.01})
    assert sure.stands_out(nominal) and not unsure.stands_out(nominal) and not gain.stands_out(nominal)


def test_a_harmonic_of_excitation_at_one_level_is_no_disturbance():
    one = np.random.default_rng(1).standard_normal(100)
    u = np.tile(one, 5)[None]
    low, high = (Record(0.01, u, (Channel("d"),), size * u, (Channel("F"),)) for size in (1.0, 3.0))
    assert _is_distortion(7.0, [low]) and _is_distortion(7.02, [low, low])
    assert not _is_distortion(7.3, [low])
    assert not _is_distortion(7.0, [low, high]), "a disturbance does not grow with the level: the records decide"
    rng = np.random.default_rng(2)
    assert not _is_distortion(7.0, [replace(low, inputs=rng.standard_normal(u.shape))])


def test_a_speed_too_small_to_tell_is_not_stated():
    sudden = {"at": 0.8, "force": 1.0, "smoothing_speed": 1e-9}
    told = Effect(kind_named("coulomb_friction"), None, sudden, {"force": 0.1, "smoothing_speed": 1e-4})
    assert effect_json(told, rig())["parameters"] == {"force": 1.0}
    assert "smoothing" not in _described(told, rig())
    at_once = told.kind.without_negligible(told).values
    assert at_once == {**sudden, "smoothing_speed": at_once["smoothing_speed"]} and at_once["smoothing_speed"] < 2e-10
    sure = Effect(kind_named("coulomb_friction"), None, sudden, {"force": 0.1, "smoothing_speed": 1e-10})
    assert effect_json(sure, rig())["parameters"] == {"force": 1.0, "smoothing_speed": 1e-9}
    assert effect_json(sure.kind.without_negligible(sure), rig())["parameters"] == {"force": 1.0}
    viscous = Effect(kind_named("coulomb_friction"), None, sudden, {"force": 2.0, "smoothing_speed": 2e-9})
    assert "smoothing_speed" in effect_json(viscous, rig())["parameters"], "of a damper only the ratio is known"


def test_what_comes_to_rest_at_a_level_is_not_clipped_there():
    t = 0.01 * np.arange(1200)
    assert clipped_level([np.clip(np.sin(2.0 * t), -0.8, 0.8)]) == 0.8
    assert clipped_level([np.clip(np.sin(2.0 * t), -0.99, 0.99)]) == 0.99
    moving = np.clip(np.mod(t, 4.0) - 0.5, 0.0, 1.0)
    rest = np.where(np.mod(t, 8.0) < 4.0, 1.0, -1.0) * (0.5 - 0.5 * np.cos(np.pi * moving))
    there_and_back = np.where(np.mod(t, 8.0) < 4.0, rest, rest + 1.0)
    assert clipped_level([there_and_back]) is None
    strokes = 0.25 * np.sin(np.pi * np.arange(3000) / 400) ** 3
    assert clipped_level([strokes]) is None, "it turns round at one place every time"
    noisy = there_and_back + 0.01 * np.random.default_rng(0).standard_normal(t.size)
    assert clipped_level([np.clip(noisy, -1.0, 1.0)]) == 1.0, "noise is cut off where the mass rests"


@pytest.mark.parametrize("kind", [kind for kind in CATALOGUE if kind.force_laws], ids=lambda kind: kind.name)
def test_the_law_that_is_drawn_is_the_law_that_acts(kind):
    nominal = rig()
    values = {p.name: 1.0 for p in kind.parameters(nominal, None) if p.name not in COORDINATES}
    values |= {"at": 0.8, "gap": 0.01, "smoothing_speed": 0.05, "yield_displacement": 0.02}
    changed = kind.apply(nominal, None, {p.name: values[p.name] for p in kind.parameters(nominal, None)})
    if not changed.elements:
        pytest.skip("a change of the structure, not an element of the rig")
    (one,) = changed.elements
    code, row = LAWS[type(one)], np.zeros((1, 3))
    row[0, : len(one.parameters)] = one.parameters

    def acting(w, v):
        return one.law(w, v, one.parameters) if code == USER else element_force(code, row, 0, w, v, 0.0, 0.0)[0]

    grid = np.linspace(-0.1, 0.1, 41)
    for motion, law in kind.force_laws.items():
        paths = [(x, 0.0) if motion == "displacement" else (0.0, x) for x in grid]
        np.testing.assert_allclose(law(values, grid), [acting(*path) for path in paths], atol=1e-12)


@pytest.mark.parametrize(
    ("law", "exponent", "name"),
    [
        (POWER_SPRING, 3.02, "cubic_spring"),
        (POWER_SPRING, 1.0, "ground_spring"),
        (POWER_DAMPER, 1.98, "quadratic_damper"),
    ],
)
def test_a_law_of_a_power_of_the_catalogue_is_that_kind(law, exponent, name):
    values = {"x": 0.3, "y": 0.4, "force_at_rms": 2.0, "exponent": exponent, "rms": 0.1}
    known = in_catalogue(Effect(law, None, values))
    assert known.kind.name == name and known.at == (0.3, 0.4)
    grid = np.linspace(-0.2, 0.2, 9)
    for motion, force in law.force_laws.items():
        same = force({**values, "exponent": round(exponent)}, grid)
        np.testing.assert_allclose(known.kind.force_laws[motion](known.values, grid), same, atol=1e-12)
    assert in_catalogue(Effect(law, None, {**values, "exponent": 2.5})) is None


@pytest.mark.parametrize("stiffness", [5.0, -5.0])
def test_a_spring_beside_a_hinge_resists_turning_if_it_resists_at_all(stiffness):
    spring = Effect(kind_named("ground_spring"), None, {"at": 1e-3, "stiffness": stiffness})
    turning = simpler_forms(spring, rig())
    assert [e.values["rotational_stiffness"] for e in turning] == ([pytest.approx(5e-6)] if stiffness > 0 else [])


def test_sets_are_named_in_words():
    assert (
        in_words("coulomb_friction + actuator_bias[F2]") == "Coulomb friction and a constant force of an actuator (F2)"
    )
    assert in_words("swapped_outputs[d1, d2]").endswith(" (d1, d2)") and in_words("own_law") == "own law"
    mine = replace(kind_named("cubic_spring"), name="own_law", phrase="a quadratic spring")
    assert in_words("own_law", [mine]) == "a quadratic spring"


def test_channels_keep_their_names_in_words():
    """As a file heads its columns."""
    assert in_words("actuator_gain[drive_1 [N]]") == "an actuator gain error (drive_1 [N])"
    assert label_in_words("actuator_gain[drive_1 [N]]") == "actuator gain (drive_1 [N])"
    assert (
        label_in_words("bouc_wen") == "hysteretic spring (Bouc-Wen)"
        and label_in_words("point_mass[x = 1]") == "point mass (x = 1)"
    )
    assert label_in_words("modulus_error") == "overall stiffness error"
    assert label_in_words("two_way_friction") == "asymmetric Coulomb friction"
    assert label_in_words("swapped_inputs[F1, F2]") == "exchange of inputs (F1, F2)"


@pytest.mark.parametrize("offset", [-2.0, 0.0])
def test_a_stop_on_a_side_that_a_place_never_comes_to_has_no_start(offset):
    """As under a constant force: the quantiles of no displacement ended a diagnosis."""
    moved = offset + (np.sin(np.linspace(0.0, 20.0, 400)) if offset else np.zeros(400))
    place = SimpleNamespace(displacement=moved, strength_along=lambda over: 1.0, at=0.3)
    assert not list(kind_named("one_sided_stop").starts(SimpleNamespace(at_peaks=(place,)), None))
    assert bool(list(kind_named("clearance").starts(SimpleNamespace(at_peaks=(place,)), None))) == bool(offset)
