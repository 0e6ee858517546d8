"""Faults of wiring and units, put into cases that another numerical route simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import sqrtm
from scipy.signal import butter, cont2discrete, dlsim, lfilter

from workbench.gap.diagnose import diagnose
from workbench.gap.setup import comparison
from workbench.gap.setup.corrections import SetupFault, without_faults
from workbench.gap.setup.faults import setup_faults
from workbench.gap.setup.records import check_disjoint
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import simulate_record
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.finite_elements import FiniteElements
from workbench.trials.make import make_trial

SEED = 899  # three actuators and a hammer, accelerometers and a velocity sensor, on a beam of slow modes


@pytest.fixture(scope="module")
def case():
    """Nothing is hidden in it."""
    return make_trial(SEED)[0]


def change(records, *, outputs=None, inputs=None, sample_time=1.0):
    """The records with their signals multiplied by matrices, and their sample time by a number."""
    return [
        replace(
            r,
            outputs=r.outputs if outputs is None else outputs @ r.outputs,
            inputs=r.inputs if inputs is None else inputs @ r.inputs,
            sample_time=sample_time * r.sample_time,
        )
        for r in records
    ]


def diagonal(n, at, value):
    matrix = np.eye(n)
    matrix[at, at] = value
    return matrix


def exchanged(n, i, j):
    matrix = np.eye(n)
    matrix[[i, j]] = matrix[[j, i]]
    return matrix


def expect(case, records, sentence, rig=None):
    """One fault, with that sentence, whose correction leaves none."""
    rig = case.rig if rig is None else rig
    faults = setup_faults(rig, records)
    assert [fault.sentence for fault in faults] == [sentence]
    assert setup_faults(*without_faults(faults, rig, records)) == ()
    return faults[0]


def test_nothing_is_wrong_with_a_case_wired_rightly(case):
    assert setup_faults(case.rig, case.fit) == ()


def test_a_case_wired_rightly_is_simulated_once_a_record(case, monkeypatch):
    simulated = []
    monkeypatch.setattr(
        comparison, "simulate_record", lambda rig, record: simulated.append(record.name) or simulate_record(rig, record)
    )
    assert setup_faults(case.rig, case.fit, case.validation) == ()
    assert simulated == [record.name for record in (*case.fit, *case.validation)]


def test_exchanged_inputs_are_named_and_corrected_to_the_last_bit(case):
    records = change(case.fit, inputs=exchanged(4, 0, 2))
    fault = expect(case, records, "The inputs F1 and F3 are exchanged: swap them.")
    _, again = fault.correction(case.rig, records)
    assert all(np.array_equal(a.inputs, b.inputs) for a, b in zip(again, case.fit, strict=True))


def test_exchanged_outputs_are_named(case):
    expect(
        case,
        change(case.fit, outputs=exchanged(7, 1, 4)),
        "The outputs a2 and a5 are exchanged: swap them.",
    )


@pytest.mark.parametrize(
    ("factor", "sentence"),
    [
        (-1.0, "The output a3 has the wrong sign: multiply by -1."),
        (1 / 9.80665, "The output a3 looks like g where m/s² is meant: multiply by 9.80665."),
        (1e3, "The output a3 is 1000 times too large, such as mm for m: multiply by 0.001."),
        (2 * np.pi, "The output a3 is 2π times too large: multiply by 0.159155."),
        (0.01, "The output a3 is 100 times too small: multiply by 100."),
    ],
)
def test_an_output_in_another_unit_is_named(case, factor, sentence):
    expect(case, change(case.fit, outputs=diagonal(7, 2, factor)), sentence)


def test_two_outputs_with_turned_signs_are_named_together(case):
    matrix = diagonal(7, 0, -1.0) @ diagonal(7, 3, -1.0)
    expect(case, change(case.fit, outputs=matrix), "The outputs a1 and a4 have the wrong sign: multiply by -1.")


def test_all_outputs_in_another_unit_may_as_well_be_the_inputs(case):
    words = "All outputs are 1000 times too small, such as km for m, or all inputs are 1000 times too large, such as mN"
    expect(case, change(case.fit, inputs=1e3 * np.eye(4)), f"{words} for N: multiply by 1000 (the outputs).")


def test_a_hammer_in_millinewton_and_an_input_with_its_sign_turned_are_named(case):
    hammer = "The input hammer is 1000 times too large, such as mN for N: multiply by 0.001."
    expect(case, change(case.fit, inputs=diagonal(4, 3, 1e3)), hammer)
    expect(case, change(case.fit, inputs=diagonal(4, 1, -1.0)), "The input F2 has the wrong sign: multiply by -1.")


def test_a_mislabelled_quantity_is_named(case):
    sensors = (replace(case.rig.sensors[0], quantity="velocity"), *case.rig.sensors[1:])
    sentence = 'The output a1 is acceleration, not velocity: state the quantity "acceleration".'
    expect(case, case.fit, sentence, rig=replace(case.rig, sensors=sensors))


def test_a_sampling_rate_off_by_two_is_named_of_all_records_or_of_one(case):
    dt = case.fit[0].sample_time
    told, names = f"state sample_time = {dt:.6g} s.", [r.name for r in case.fit]
    listed = f"{', '.join(names[:-1])} and {names[-1]}"
    expect(
        case, change(case.fit, sample_time=2.0), f"The records {listed} are sampled at twice the stated rate: {told}"
    )
    one = [*change(case.fit[:1], sample_time=0.5), *case.fit[1:]]
    expect(case, one, f"The record {case.fit[0].name} is sampled at half the stated rate: {told}")


def test_damping_in_per_cent_is_named(case):
    rig = case.rig
    zeta = float(rig.modes.zeta[0])
    structure = replace(rig.structure, damping=ModalDamping(100.0 * zeta))
    rig = replace(rig, structure=structure, modes=replace(rig.modes, damping=100.0 * rig.modes.damping))
    words = "The damping looks like per cent where a ratio is meant: divide it by 100"
    fault = expect(case, case.fit, f"{words} (the largest would be {zeta:.4g}, not {100 * zeta:.4g}).", rig=rig)
    assert fault.correction(rig, case.fit)[0].structure.damping.zeta == pytest.approx(zeta)


def test_the_same_data_under_two_names_are_named(case):
    copied = np.eye(7)
    copied[5] = copied[4]
    found = expect(
        case,
        change(case.fit, outputs=copied),
        "The outputs a5 and a6 hold the same samples, and the model agrees better with a5: measure a6 again, or leave"
        " it out.",
    )
    rig, records = found.correction(case.rig, case.fit)
    assert [s.name for s in rig.sensors] == list(records[0].output_names) == ["a1", "a2", "a3", "a4", "a5", "v1"]


def test_one_record_twice_is_named_and_a_validation_record_that_repeats_one_is_refused(case):
    twice = [*case.fit, replace(case.fit[1], name="again")]
    first = case.fit[1].name
    expect(case, twice, f"The records {first} and again hold the same samples: leave again out.")
    part = replace(case.fit[1], outputs=case.fit[1].outputs[:, :900], inputs=case.fit[1].inputs[:, :900], name="part")
    with pytest.raises(ValueError, match=f"validation record 'part' repeats the fit record '{first}'"):
        check_disjoint(case.fit, [part])
    with pytest.raises(ValueError, match="repeats the fit record"):
        diagnose(case.rig, case.fit, validation=[part], workers=1)


def test_faults_that_hide_one_another_are_found_one_after_the_other(case):
    records = change(case.fit, inputs=exchanged(4, 0, 1), outputs=diagonal(7, 0, -1.0))
    faults = setup_faults(case.rig, records)
    assert {fault.kind for fault in faults} == {"exchanged inputs", "sign"}
    assert setup_faults(*without_faults(faults, case.rig, records)) == ()


@pytest.mark.parametrize(
    "kinds",
    [
        ("sensor_misplacement",),
        ("sensor_gain",),
        *(pytest.param((k,), marks=pytest.mark.slow) for k in ("actuator_gain", "one_sided_stop", "modal_damping")),
    ],
)
def test_an_effect_is_not_taken_for_a_fault_of_wiring(kinds):
    case, _ = make_trial(3, kinds=kinds)
    assert setup_faults(case.rig, case.fit) == ()


def test_a_fault_says_how_much_it_closes(case):
    [fault] = setup_faults(case.rig, change(case.fit, inputs=exchanged(4, 0, 2)))
    assert isinstance(fault, SetupFault) and 0.99 < fault.closes <= 1.0


def test_a_gain_that_is_near_a_unit_and_differs_beyond_its_error_is_said_and_not_corrected(case):
    records = change(case.fit, outputs=diagonal(7, 2, 1.01 / 9.80665))
    [fault] = setup_faults(case.rig, records)
    assert not fault.certain
    assert fault.sentence == (
        "The output a3 may look like g where m/s² is meant; but the gain differs from that by +1 %, more than its"
        " uncertainty: treated as an error of calibration."
    )
    rig, kept = without_faults([fault], case.rig, records)
    assert rig is case.rig and all(np.array_equal(a.outputs, b.outputs) for a, b in zip(kept, records, strict=True))


def test_an_input_with_a_gain_near_a_unit_is_not_corrected_beside_a_turned_sign_that_is(case):
    matrix = diagonal(4, 0, 9.80665 * 1.02) @ diagonal(4, 1, -1.0)
    faults = setup_faults(case.rig, change(case.fit, inputs=np.linalg.inv(matrix)))
    assert [(fault.kind, fault.certain) for fault in faults] == [("sign", True), ("unit", False)]
    assert "the gain differs from that by +2 %" in faults[1].sentence


@pytest.mark.parametrize("factor", [1 / 9.81, 1.0005 / 9.80665])
def test_a_factor_rounded_or_within_calibration_is_a_fault_of_units(case, factor):
    [fault] = setup_faults(case.rig, change(case.fit, outputs=diagonal(7, 2, factor)))
    assert fault.certain


def test_a_validation_record_is_corrected_by_what_it_shows_itself(case):
    """The fit records state twice their sample time, or have two outputs exchanged; the validation record is right."""
    held = case.validation
    (kept,) = held
    slow = change(case.fit, sample_time=2.0)
    faults = setup_faults(case.rig, slow, held)
    assert all(a is b for a, b in zip(without_faults(faults, case.rig, held)[1], held, strict=True))
    corrected_fit = without_faults(faults, case.rig, slow)[1]
    assert [r.sample_time for r in corrected_fit] == pytest.approx([r.sample_time for r in case.fit])
    crossed = exchanged(7, 1, 4)
    fit = change(case.fit, outputs=crossed)
    (fault,) = setup_faults(case.rig, fit, held)
    assert fault.sentence == f"The outputs a2 and a5 are exchanged: swap them, except in {kept.name}."
    assert without_faults([fault], case.rig, held)[1] == held
    (fault,) = setup_faults(case.rig, fit, change(held, outputs=crossed))
    assert fault.sentence == "The outputs a2 and a5 are exchanged: swap them."
    (again,) = without_faults([fault], case.rig, change(held, outputs=crossed))[1]
    assert np.array_equal(again.outputs, kept.outputs)


def test_faults_that_a_validation_record_alone_has_are_named_with_it(case):
    (kept,) = case.validation
    for change_of, words in (
        (
            {"outputs": diagonal(7, 2, 1e3)},
            "the output a3 is 1000 times too large, such as mm for m: multiply by 0.001",
        ),
        ({"inputs": exchanged(4, 0, 2)}, "the inputs F1 and F3 are exchanged: swap them"),
    ):
        spoilt = change([kept], **change_of)
        (fault,) = setup_faults(case.rig, case.fit, spoilt)
        assert fault.sentence == f"In validation record {kept.name}, {words}."
        rig, (again,) = without_faults([fault], case.rig, spoilt)
        assert (
            rig is case.rig and np.allclose(again.outputs, kept.outputs) and np.array_equal(again.inputs, kept.inputs)
        )
        assert without_faults([fault], case.rig, case.fit)[1] == case.fit
    (fault,) = setup_faults(case.rig, case.fit, change([kept], sample_time=0.5))
    assert fault.sentence.startswith(f"The record {kept.name} is sampled at half the stated rate")


def test_the_set_up_is_compared_once_the_rig_has_settled(case):
    """Records that begin in motion look like no wiring at first."""
    crossed = change(case.fit, outputs=exchanged(7, 1, 4))
    begun = [r.between(0.2 * r.n_samples * r.sample_time) for r in crossed]
    transient = 0.5 * begun[0].n_samples * begun[0].sample_time
    assert [fault.sentence for fault in setup_faults(case.rig, begun, transient=transient)] == [
        "The outputs a2 and a5 are exchanged: swap them."
    ]


def test_a_dead_channel_is_no_other_quantity(case):
    dead = change(case.fit, outputs=diagonal(7, 2, 0.0))
    assert setup_faults(case.rig, dead) == ()


def test_records_of_one_name_are_refused(case):
    first, other = case.fit[0], replace(case.fit[1], name=case.fit[0].name)
    with pytest.raises(ValueError, match=f"2 records are called '{first.name}'"):
        setup_faults(case.rig, [first, other])
    with pytest.raises(ValueError, match=f"2 records are called '{first.name}'"):
        diagnose(case.rig, [first], validation=[other], workers=1)


@pytest.mark.parametrize("at", [0, -1])
def test_a_fault_of_one_fit_record_alone_is_named_with_it(case, at):
    (spoilt,) = change([case.fit[at]], outputs=diagonal(7, 2, -1.0))
    fit = [spoilt if r.name == spoilt.name else r for r in case.fit]
    (fault,) = setup_faults(case.rig, fit, case.validation)
    assert fault.sentence in (
        f"In record {spoilt.name}, the output a3 has the wrong sign: multiply by -1.",
        f"The output a3 has the wrong sign: multiply by -1; not in "
        f"{', '.join(r.name for r in (*case.fit, *case.validation) if r.name != spoilt.name)}.",
    )
    rig, again = without_faults([fault], case.rig, fit)
    assert rig is case.rig
    assert all(np.array_equal(a.outputs, b.outputs) for a, b in zip(again, case.fit, strict=True))


def servo_with_a_heavier_load(seed):
    """Two discs and a shaft by the matrix exponential; the load is 12 % heavier than its model, and its sign turned."""
    rng, dt = np.random.default_rng(seed), 2e-3
    motor, load, shaft = 2e-3, 5e-3, 40.0
    stiffness = shaft * np.array([[1.0, -1.0], [-1.0, 1.0]])
    rotor = FiniteElements(
        np.diag([motor, load]), stiffness, nodes=NamedPoints(("motor", "load")), damping=ModalDamping(0.01)
    )
    sensors = (
        Sensor("encoder", "motor", "displacement", noise_std=1e-3),
        Sensor("tacho", "load", "velocity", noise_std=1e-2),
    )
    rig = Rig(rotor.modes(2), (Actuator("torque", "motor"),), sensors)
    inverse = np.diag([1.0 / motor, 1.0 / (load + 6e-4)])
    zero, damping = np.zeros((2, 2)), 1e-4 * stiffness
    a = np.block([[zero, np.eye(2)], [-inverse @ stiffness, -inverse @ damping]])
    b = np.r_[0.0, 0.0, 1.0 / motor, 0.0][:, None]
    c = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0]])
    held, records = cont2discrete((a, b, c, np.zeros((2, 1))), dt), []
    for name in ("low", "high"):
        torque = lfilter(*butter(4, 0.16), rng.standard_normal(1500))
        y = dlsim(held, torque)[1].T + np.array([[1e-3], [1e-2]]) * rng.standard_normal((2, 1500))
        records.append(rig.record(torque[None], y, sample_time=dt, name=name))
    return rig, records


@pytest.mark.parametrize("seed", [1, 2])
def test_a_turned_sign_is_found_beside_a_missing_mass(seed):
    rig, records = servo_with_a_heavier_load(seed)
    (fault,) = setup_faults(rig, records)
    assert fault.sentence == "The output tacho has the wrong sign: multiply by -1." and fault.closes > 0.5
    assert setup_faults(*without_faults([fault], rig, records)) == ()


DT = 2e-3


def chain(springs):
    """Four masses and springs; the springs are so many times as stiff as the model says.

    Returns:
        The model's rig, and what a record of it reads by the matrix exponential: of noise, of the forces that are
        logged (2, n_samples), and of those that act.
    """
    k = 2e4

    def stiffness(times):
        springs = k * np.array(times)
        return np.diag(springs + np.r_[springs[1:], 0.0]) - np.diag(springs[1:], 1) - np.diag(springs[1:], -1)

    names = ("m1", "m2", "m3", "m4")
    model = FiniteElements(np.eye(4), stiffness([1.0] * 4), nodes=NamedPoints(names), damping=ModalDamping(0.01))
    sensors = (*(Sensor(f"a{i}", f"m{i}", "acceleration", noise_std=0.01) for i in (1, 2, 3)),)
    sensors += (Sensor("v4", "m4", "velocity", noise_std=1e-4),)
    rig = Rig(model.modes(4), (Actuator("F1", "m2"), Actuator("F2", "m4")), sensors)
    true, b = stiffness(springs), np.eye(4)[:, [1, 3]]
    damping = 0.02 * sqrtm(true)  # a hundredth of critical in every mode, as in the model
    a = np.block([[np.zeros((4, 4)), np.eye(4)], [-true, -damping]])
    c = np.vstack([np.hstack([-true, -damping])[:3], np.eye(8)[7]])
    plant = cont2discrete((a, np.vstack([np.zeros((4, 2)), b]), c, np.vstack([b[:3], np.zeros((1, 2))])), DT)

    def record(name, rng, logged, acting):
        noise = np.array([[0.01], [0.01], [0.01], [1e-4]]) * rng.standard_normal((4, logged.shape[1]))
        return rig.record(logged, dlsim(plant, acting.T)[1].T + noise, sample_time=DT, name=name)

    return rig, record


def chain_with_a_wrong_spring(times):
    """Driven by noise; the second spring is so many times as stiff as the model says."""
    return driven_chain([1.0, times, 1.0, 1.0])


def driven_chain(springs):
    rng = np.random.default_rng(6)
    rig, record = chain(springs)
    records = []
    for name, share in (("one", [1.0, 0.3]), ("other", [0.3, 1.0])):
        forces = np.array(share)[:, None] * rng.standard_normal((2, 3000))
        records.append(record(name, rng, forces, forces))
    return rig, records


@pytest.mark.parametrize(("most", "levels"), [(0.2, (1.0, 1.5)), (0.1, (1.0, 3.0)), (0.01, (1.0, 3.0))])
def test_an_amplifier_that_saturates_is_no_factor_of_units(most, levels):
    """It leaves about a 2π-th, a tenth or a hundredth of the lower level, and less of the other."""
    rng = np.random.default_rng(7)
    rig, record = chain([1.0] * 4)
    asked = [level * rng.standard_normal((2, 3000)) for level in levels]
    records = [record(f"at {u[0, 0]:g}", rng, u, np.clip(u, -most, most)) for u in asked]
    (fault,) = setup_faults(rig, records)
    assert not fault.certain and " may be " in fault.sentence
    assert fault.sentence.endswith(", as where an amplifier saturates.")


@pytest.mark.parametrize(
    ("springs", "hertz", "phase"),
    [
        ([9.5] * 4, 1.0, 1.5),  # quasi-static: all move a ninth as far
        ([9.0] * 4, 1.0, 1.5),
        ([1.3, 1.0, 1.0, 1.0], 8.0, 0.0),  # between the first resonance of the model and the true one
        ([1.2, 1.0, 1.0, 1.0], 8.0, 1.5),
        ([0.6] * 4, 7.0, 0.0),
    ],
)
def test_a_tone_in_one_mode_shows_no_sign_and_no_unit(springs, hertz, phase):
    rng = np.random.default_rng(8)
    rig, record = chain(springs)
    time = DT * np.arange(3000)
    tones = np.sin(2.0 * np.pi * hertz * time + [[0.0], [phase]]) * np.minimum(1.0, time)
    forces = [most * np.array([[1.0], [1.0 if phase else 0.5]]) * tones for most in (1e3, 2e3)]
    assert setup_faults(rig, [record(f"to {u.max():.0f} N", rng, u, u) for u in forces]) == ()


ALL_IN_G = "All outputs are 9.81 times too small, or all inputs are 9.81 times too large"


@pytest.mark.parametrize("times", [0.85, 1.3])
@pytest.mark.parametrize(
    ("spoilt", "sentence"),
    [
        ({"outputs": np.eye(4) / 9.80665}, f"{ALL_IN_G}: multiply by 9.80665 (the outputs)."),
        (
            {"outputs": -np.eye(4)},
            "All outputs have the wrong sign, or all inputs have the wrong sign: multiply by -1 (the outputs).",
        ),
        ({"outputs": diagonal(4, 1, -1.0)}, "The output a2 has the wrong sign: multiply by -1."),
        (
            {"outputs": diagonal(4, 3, 1e3)},
            "The output v4 is 1000 times too large, such as mm for m: multiply by 0.001.",
        ),
        ({"outputs": exchanged(4, 0, 2)}, "The outputs a1 and a3 are exchanged: swap them."),
        ({"inputs": exchanged(2, 0, 1)}, "The inputs F1 and F2 are exchanged: swap them."),
        ({"inputs": diagonal(2, 1, 1e3)}, "The input F2 is 1000 times too large, such as mN for N: multiply by 0.001."),
    ],
)
def test_a_fault_is_found_whole_beside_an_effect_that_bends_every_mode(times, spoilt, sentence):
    rig, records = chain_with_a_wrong_spring(times)
    assert setup_faults(rig, records) == ()
    wrong = change(records, **spoilt)
    (fault,) = setup_faults(rig, wrong)
    assert fault.sentence == sentence and fault.records == ("one", "other")
    again = without_faults([fault], rig, wrong)
    assert all(np.allclose(a.outputs, r.outputs) for a, r in zip(again[1], records, strict=True))
    assert all(np.allclose(a.inputs, r.inputs) for a, r in zip(again[1], records, strict=True))
    assert setup_faults(*again) == ()


def test_a_mislabelled_quantity_is_found_beside_an_effect_that_bends_every_mode():
    rig, records = chain_with_a_wrong_spring(1.3)
    sensors = (replace(rig.sensors[0], quantity="velocity"), *rig.sensors[1:])
    (fault,) = setup_faults(replace(rig, sensors=sensors), records)
    assert fault.sentence == 'The output a1 is acceleration, not velocity: state the quantity "acceleration".'


def test_a_sensor_that_reads_noise_alone_has_no_fault_of_units():
    rig, records = chain_with_a_wrong_spring(1.3)
    noise = np.random.default_rng(1).standard_normal(3000)
    dead = [replace(r, outputs=np.vstack([r.outputs[:2], 0.01 * noise, r.outputs[3:]])) for r in records]
    assert setup_faults(rig, dead) == ()


def test_all_outputs_ten_times_too_small_may_be_an_amplifier(case):
    (fault,) = setup_faults(case.rig, change(case.fit, outputs=np.eye(7) / 10.0))
    assert not fault.certain and "differs from that by -1.9 %" in fault.sentence


@pytest.mark.slow
def test_a_sensor_beyond_a_node_that_reads_some_modes_turned_has_no_wrong_sign():
    """It stands where the second and the third mode are as strong and turned, the first is not."""
    case, _ = make_trial(1016, kinds=("sensor_misplacement",))
    assert setup_faults(case.rig, case.fit) == ()


@pytest.mark.parametrize(("at", "name"), [(0, "a1"), (1, "a2")])
def test_one_output_in_g_is_found_where_every_resonance_is_shifted(at, name):
    """A softer structure leaves a residual of the size of the signal, so the factor closes little of it."""
    rig, records = driven_chain([0.94] * 4)
    assert setup_faults(rig, records) == ()
    (fault,) = setup_faults(rig, change(records, outputs=diagonal(4, at, 1.0 / 9.80665)))
    assert fault.sentence == f"The output {name} looks like g where m/s² is meant: multiply by 9.80665."
    # a gain of 0.1 differs from that by 2 %, and is an error of calibration
    assert not any(f.certain for f in setup_faults(rig, change(records, outputs=diagonal(4, at, 0.1))))
