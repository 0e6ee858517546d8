"""Truth: a chain of five masses, stepped exactly, under forces whose end is known; and a measured arm."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from workbench.identification.free_decay.order import identify
from workbench.identification.free_decay.preparation import decay_start
from workbench.identification.signal.synthesis import free_decay
from workbench.records.record import Channel, Record
from workbench.structure.modes import SampledModes

ROOT = Path(__file__).resolve().parents[3]
ARM = Path(os.environ.get("WORKBENCH_SHARED", ROOT.parent / "shared")) / "measured" / "arm-ringdown"
N, STIFFNESS = 5, 400.0 * (2.0 * np.eye(5) - np.eye(5, k=1) - np.eye(5, k=-1))
DAMPING = 0.2 * np.eye(N) + 4e-4 * STIFFNESS
DT, LENGTH = 0.005, 2400


def stepped(forces, state, stiffness=STIFFNESS, damping=DAMPING):
    """States (2 N, n_samples) under forces (N, n_samples) held over each step."""
    a = np.block([[np.zeros((N, N)), np.eye(N)], [-stiffness, -damping]])
    step = expm(a * DT)
    push = np.linalg.solve(a, (step - np.eye(2 * N))[:, N:])
    states = [state]
    for force in forces.T[:-1]:
        states.append(step @ states[-1] + push @ force)
    return np.array(states).T


def hammer(rng, k):
    forces = np.zeros((N, LENGTH))
    forces[2, k - 2 : k] = 1.0 / DT
    return stepped(forces, np.zeros(2 * N)), forces


def bouncing_hammer(rng, k):
    forces = np.zeros((N, LENGTH))
    forces[2, k - 32 : k - 30], forces[2, k - 2 : k] = 1.0 / DT, 0.4 / DT
    return stepped(forces, np.zeros(2 * N)), forces


def pulled_aside(rng, k):
    """Held out by a hand that trembles, then let go."""
    forces = np.zeros((N, LENGTH))
    forces[4, :k] = 50.0 * (1.0 + 0.01 * np.sqrt(DT) * np.cumsum(rng.standard_normal(k)))
    rest = np.linalg.solve(STIFFNESS, forces[:, 0])
    return stepped(forces, np.r_[rest, np.zeros(N)]), forces


def hand_laid_on(rng, k):
    """Ringing with a hand on it, a spring, a damper and a trembling force, then without."""
    forces = np.zeros((N, LENGTH))
    forces[2, 10], forces[4, :k] = 1.0 / DT, 20.0 * rng.standard_normal(k)
    hand = np.diag([0.0, 0.0, 0.0, 0.0, 1.0])
    before = stepped(forces[:, : k + 1], np.zeros(2 * N), STIFFNESS + 800.0 * hand, DAMPING + 10.0 * hand)
    after = stepped(forces[:, k:], before[:, -1])
    return np.hstack([before[:, :-1], after]), forces


def measured(states, forces, quantity, noise, k, rng):
    read = {
        "displacement": states[:N],
        "velocity": states[N:],
        "acceleration": forces - STIFFNESS @ states[:N] - DAMPING @ states[N:],
    }[quantity][[0, 3]]
    read = read + noise * read[:, k:].std() * rng.standard_normal(read.shape)
    return Record(DT, read, (Channel("a", quantity), Channel("b", quantity)))


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
@pytest.mark.parametrize("what", [hammer, bouncing_hammer, pulled_aside, hand_laid_on])
def test_decay_begins_where_the_force_ends(what, quantity):
    """Within a quarter of the shortest period, 0.16 s, at 80 dB, and within half of it at 40 dB."""
    rng = np.random.default_rng(7)
    k = int(rng.integers(500, 900))
    states, forces = what(rng, k)
    for noise, allowed in ((1e-4, 0.04), (0.01, 0.08)):
        record = measured(states, forces, quantity, noise, k, rng)
        assert decay_start(record) == pytest.approx(k * DT, abs=allowed)


def test_free_decay_from_the_first_sample_is_kept_whole():
    rng = np.random.default_rng(2)
    for draw in range(12):
        n, m = rng.integers(2, 9), rng.integers(1, 6)
        shapes = rng.standard_normal((m, n)) + 1j * rng.standard_normal((m, n))
        omega = 2 * np.pi * np.sort(rng.uniform(1, 45, n))
        modes = SampledModes(omega, rng.uniform(0.001, 0.03, n), shapes, np.full(m, np.nan))
        clean = free_decay(modes, sample_time=0.01, n_samples=int(rng.integers(300, 1500)), start_time=3.0)
        noise = clean.outputs.std() * 10 ** rng.uniform(-4, -1) * rng.standard_normal(clean.outputs.shape)
        record = Record(0.01, clean.outputs + 5.0 + noise, clean.output_channels, start_time=3.0)
        assert decay_start(record) == 3.0, draw


@pytest.mark.parametrize("n", [800, 801, 802, 803])
def test_a_sample_at_rest_before_the_blow_is_left_out(n):
    """As of a blow held over one sample: the motion is free from the next on, whatever the length of the record."""
    forces = np.zeros((N, LENGTH))
    forces[2, 0] = 1.0 / DT
    rng = np.random.default_rng(n)
    velocity = stepped(forces, np.zeros(2 * N))[[N + 2, N + 3], :n]
    read = velocity + 1e-3 * velocity.std() * rng.standard_normal(velocity.shape)
    record = Record(DT, read, (Channel("a", "velocity"), Channel("b", "velocity")))
    assert decay_start(record) == DT
    if n == 803:
        assert "free decay from 0.005 s on only" in identify(record).remarks[0]
        assert not identify(record.between(DT)).remarks


@pytest.mark.parametrize("kind", ["noise", "blow at the start", "constant", "noise of the hammer's channel"])
def test_a_driven_record_is_said_to_be_no_free_decay(kind):
    """A blow, a constant force and a channel that reads only noise leave the decay free."""
    rng, forces = np.random.default_rng(0), np.zeros((N, LENGTH))
    start = np.r_[np.zeros(2 * N)] if kind in ("noise", "blow at the start") else np.r_[np.ones(N), np.zeros(N)]
    if kind == "noise":
        forces[2] = rng.standard_normal(LENGTH)
    elif kind == "blow at the start":
        forces[2, :2] = 1.0 / DT
    elif kind == "constant":
        forces[2] = 3.0
    read = stepped(forces, start)[[N + 2, N + 3]]
    read += 1e-3 * read.std() * rng.standard_normal(read.shape)
    force = forces[2] + 1e-3 * rng.standard_normal(LENGTH)
    channels = (Channel("a", "velocity"), Channel("b", "velocity"))
    record = Record(DT, read, channels, force[None], (Channel("f", "force"),), name="one")
    said = [remark for remark in identify(record, max_modes=5).remarks if "is driven by input 'f'" in remark]
    assert bool(said) == (kind == "noise"), said
    if said:
        assert "(rms 1 N)" in said[0] and "use identify_driven, or cut the record" in said[0], said


def test_what_a_few_samples_or_silence_allow():
    channels = (Channel("a"),)
    assert decay_start(Record(0.01, np.exp(-np.arange(50.0))[None], channels, start_time=1.0)) == 1.0
    assert decay_start(Record(0.01, np.zeros((1, 500)), channels)) == 0.0


@pytest.mark.parametrize(
    ("name", "seen"),
    [
        ("hold_and_release_1", 0.64),
        ("hold_and_release_2", 0.44),
        ("ping_mid_beam_1", 2.01),
        ("ping_mid_beam_2", 0.51),
        ("ping_mid_beam_3", 1.32),
        ("ping_mid_beam_hard", 1.60),
    ],
)
def test_arm_let_go_or_struck(name, seen):
    """Where the eye sees the motion set in; a hand leaves, and a knuckle, over some hundredths of a second."""
    if not ARM.is_dir():
        pytest.skip(f"measured records are not at {ARM}")
    table = np.loadtxt(ARM / f"{name}.txt")
    record = Record(0.002, table[:, -1][None], (Channel("a", "acceleration"),))
    assert seen - 0.002 <= decay_start(record) <= seen + 0.05
