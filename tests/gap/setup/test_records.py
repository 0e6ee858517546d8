"""Records that begin in motion, and a channel that is stuck for a while; and records that are sound."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.setup.records import data_faults
from workbench.rig.elements import CoulombFriction, OneSidedStop


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig(n_modes=4)


@pytest.fixture(scope="module")
def measured(record_of):
    def make(real):
        rng = np.random.default_rng(2)
        return record_of(real, np.repeat(rng.normal(size=200), 5)[None], rng, name="high", substeps=8)

    return make


def altered(record, change):
    outputs = record.outputs.copy()
    change(outputs)
    return replace(record, outputs=outputs)


def test_sound_records_have_none(rig, measured):
    for elements in ((), (CoulombFriction(0.6, 0.2, 0.01),), (OneSidedStop(0.9, 2e4, 1e-3),)):
        assert data_faults(rig, [measured(replace(rig, elements=elements))]) == ()


def test_a_record_that_begins_in_motion(rig, measured):
    record = measured(rig)
    (said,) = data_faults(rig, [record.between(2.3)])
    assert "'high' does not start from rest" in said and "transient" in said
    assert data_faults(rig, [record.between(2.3)], transient=5.0) == ()
    biased = altered(record, lambda y: np.add(y[1], 1.0, out=y[1]))
    assert data_faults(rig, [biased]) == (), "a constant offset is a bias"


def test_accelerometers_tell_motion_from_the_jump_with_the_first_force(rig, record_of):
    rig = replace(rig, sensors=tuple(replace(s, quantity="acceleration", noise_std=1e-3) for s in rig.sensors))
    rng = np.random.default_rng(2)
    command = np.repeat(rng.normal(size=200), 5)
    command[0] = 30.0
    record = record_of(rig, command[None], rng, name="high", substeps=8)
    assert (np.abs(record.outputs[:, 0]) > record.outputs.std(axis=1)).any(), "a jump, which the rig predicts"
    assert data_faults(rig, [record]) == ()
    assert data_faults(rig, [altered(record, lambda y: np.multiply(y, 1.6, out=y))]) == ()
    (said,) = data_faults(rig, [record.between(2.3)])
    assert "does not start from rest" in said and "where at rest it would read" in said


def test_a_channel_that_is_stuck(rig, measured):
    def hold(y):
        y[2, 300:700] = y[2, 300]

    said, *_ = data_faults(rig, [altered(measured(rig), hold)])
    assert "d3 reads" in said and "from 3 s to 7 s" in said


def test_clipped_channels_are_said_with_their_limits_and_rounded_ones_are_not(rig, measured):
    def clip(y):
        y[1], y[2] = np.clip(y[1], -np.inf, 2e-4), np.clip(y[2], -1e-4, 1e-4)

    record = measured(rig)
    clipped = altered(record, clip)
    n, m = np.count_nonzero(clipped.outputs[1] == 2e-4), np.count_nonzero(clipped.outputs[2] == 1e-4)
    assert data_faults(rig, [clipped]) == (
        f"Record 'high': output 'd2' is clipped above at 0.0002, {n} samples and output 'd3' is clipped above at"
        f" 0.0001, {m} samples; the motion beyond is lost: lower the level, or measure with a larger range.",
    )
    step = record.outputs.std() / 4
    assert data_faults(rig, [altered(record, lambda y: np.round(y / step, out=y))]) == ()
