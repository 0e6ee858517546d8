"""Records whose triggers are late or early, and delays that are of no trigger."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import sqrtm
from scipy.signal import butter, cont2discrete, dlsim, lfilter

from workbench.gap.setup.corrections import without_faults
from workbench.gap.setup.faults import setup_faults
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ModalDamping
from workbench.structure.domain import NamedPoints
from workbench.structure.finite_elements import FiniteElements

DT, N, FINER = 5e-3, 2000, 4
STIFFNESS = 2e3 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
DAMPING = 0.02 * sqrtm(STIFFNESS)  # a hundredth of critical in every mode, as in the model


@pytest.fixture(scope="module")
def rig():
    model = FiniteElements(np.eye(3), STIFFNESS, nodes=NamedPoints(("m1", "m2", "m3")), damping=ModalDamping(0.01))
    rig = Rig(model.modes(3), (Actuator("F1", "m1"), Actuator("F2", "m2")), ())
    kinds = ("displacement", "velocity", "acceleration")
    sensors = tuple(Sensor(f"y{i + 1}", f"m{i + 1}", kind, noise_std=1e-6) for i, kind in enumerate(kinds))
    return replace(rig, sensors=sensors)


def measured(rig, name, seed, forces=(1.0, 1.0), late=0.0, drive_late=(0.0, 0.0)):
    """A chain of three masses by the matrix exponential, at a quarter of the sample time.

    Args:
        forces: rms of both forces.
        late, drive_late: samples, in quarters, by which all outputs, and each force on its way to the chain, are late.
    """
    zero, eye = np.zeros((3, 3)), np.eye(3)
    a = np.block([[zero, eye], [-STIFFNESS, -DAMPING]])
    b = np.vstack([zero, eye])[:, :2]
    c = np.vstack([np.eye(6)[0], np.eye(6)[4], a[5]])
    plant = cont2discrete((a, b, c, np.zeros((3, 2))), DT / FINER)
    drawn = np.random.default_rng(seed).standard_normal((2, N + 30))
    asked = np.array(forces)[:, None] * lfilter(*butter(4, 0.4), drawn)
    asked[:, :30] = 0.0
    acting = np.repeat(asked, FINER, axis=1)
    for row, delay in zip(acting, drive_late, strict=True):
        row[:] = np.roll(row, round(FINER * delay))
    read = dlsim(plant, acting.T)[1].T
    kept = FINER * np.arange(15, N + 15)
    return rig.record(asked[:, 15 : N + 15], read[:, kept - round(FINER * late)], sample_time=DT, name=name)


def delayed(rig, *delays):
    names = ("low", "high", "check", "other")
    return [measured(rig, name, i, late=d) for i, (name, d) in enumerate(zip(names, delays, strict=False))]


def test_records_of_late_and_early_triggers_are_named_and_brought_to_the_others_to_the_last_bit(rig):
    records = delayed(rig, 0.0, 3.0, 1.0, -2.0)
    faults = setup_faults(rig, records[:2], records[2:])
    assert [fault.sentence for fault in faults] == [
        "The outputs of record high are 3 samples late relative to those of record low (trigger offset):"
        " shift them all 3 samples earlier.",
        "The outputs of record check are 1 sample late relative to those of record low (trigger offset):"
        " shift them all 1 sample earlier.",
        "The outputs of record other are 2 samples early relative to those of record low (trigger offset):"
        " shift them all 2 samples later.",
    ]
    assert all(fault.kind == "late record" and fault.closes > 0.99 for fault in faults)
    kept_rig, fit = without_faults(faults, rig, records[:2])
    _, held = without_faults(faults, rig, records[2:])
    assert kept_rig is rig and fit[0] is records[0] and setup_faults(rig, fit, held) == ()
    right = delayed(rig, 0.0, 0.0, 0.0, 0.0)
    for again, true, cut in ((fit[1], right[1], slice(None, -3)), (held[1], right[3], slice(2, None))):
        assert np.array_equal(again.outputs, true.outputs[:, cut])
        assert np.array_equal(again.inputs, true.inputs[:, cut])


def test_a_delay_of_a_fraction_of_a_sample_is_one_too(rig):
    records = delayed(rig, 0.0, 2.5)
    (fault,) = setup_faults(rig, records)
    assert fault.sentence.startswith("The outputs of record high are 2.5 samples late relative to those of record low")
    _, (_, again) = without_faults([fault], rig, records)
    true = measured(rig, "high", 1).outputs[:, : again.n_samples]
    error = (again.outputs - true)[:, 50:-50].std(axis=1) / true.std(axis=1)
    assert (error < 0.05).all()


def test_what_all_records_have_in_common_stays_for_the_effects(rig):
    assert setup_faults(rig, delayed(rig, 3.0, 3.0, 2.5)) == ()
    assert setup_faults(rig, delayed(rig, 3.0)) == ()
    faults = setup_faults(rig, delayed(rig, 2.0, 6.0, 2.0))
    assert [fault.sentence.split(" (")[0] for fault in faults] == [
        "The outputs of record high are 4 samples late relative to those of record low"
    ]


def test_a_drive_that_is_late_delays_the_records_that_it_drives_and_is_no_trigger(rig):
    shares = ((1.0, 0.2), (0.2, 1.0), (1.0, 0.0), (0.0, 1.0))
    records = [measured(rig, str(i), i, forces=pair, drive_late=(4.0, 0.0)) for i, pair in enumerate(shares)]
    assert setup_faults(rig, records) == ()


def test_a_late_trigger_is_found_beside_a_turned_sign(rig):
    low, high = delayed(rig, 0.0, 3.0)
    turned = [replace(r, outputs=np.array([[1.0], [-1.0], [1.0]]) * r.outputs) for r in (low, high)]
    faults = setup_faults(rig, turned)
    assert {fault.kind for fault in faults} == {"late record", "sign"}
    assert setup_faults(*without_faults(faults, rig, turned)) == ()
