"""What is left of records at several levels: of shakers that nobody logs, and of a wrong gain."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.cases.case import Case
from workbench.gap.diagnose import diagnose
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.report.budget import measure
from workbench.gap.report.notes import steady_remainder
from workbench.rig.actuators import Actuator
from workbench.study.pages.verdict_page import verdict_page

LOGGED, HIDDEN = Actuator("F", 0.45), (Actuator("H1", 0.4), Actuator("H2", 0.9), Actuator("H3", 1.3))


@pytest.fixture(scope="module")
def rig(hinged_rig):
    plain = hinged_rig(3, (LOGGED,))
    return replace(plain, sensors=tuple(replace(sensor, quantity="acceleration") for sensor in plain.sensors))


@pytest.fixture(scope="module")
def shaken(rig, record_of):
    """Records of 40 s, with white forces held over ten samples: the logged one at these levels, others at one."""

    def make(levels, hidden=0.0, gain=1.0):
        rng, records = np.random.default_rng(5), []
        for level in levels:
            inputs = np.array([[level], *3 * [[hidden]]]) * np.repeat(rng.normal(size=(4, 400)), 10, axis=1)
            real = replace(rig, actuators=(replace(LOGGED, gain=gain), *HIDDEN))
            record = record_of(real, inputs, rng, name=f"{level:g}")
            records.append(replace(record, inputs=inputs[:1], input_channels=record.input_channels[:1]))
        return records

    return make


@pytest.mark.parametrize(
    ("levels", "hidden", "gain", "is_steady"),
    [
        ((1.0, 4.0), 1.0, 1.0, True),
        ((1.0, 2.0, 4.0), 1.0, 1.0, True),
        ((1.0, 1.5), 1.0, 1.0, False),  # levels that are too near to tell
        ((1.0, 4.0), 0.0, 1.2, False),
        ((1.0, 4.0), 0.0, 1.0, False),  # noise alone
    ],
)
def test_what_no_input_drives_is_as_large_at_every_level(rig, shaken, levels, hidden, gain, is_steady):
    remark = steady_remainder(rig, shaken(levels, hidden, gain))
    assert (remark is not None) == is_steady
    if remark:
        assert "does not grow with the inputs" in remark and "record '1'" in remark and "times as large" in remark


def test_blocks_are_of_what_is_compared_once_settled(rig, shaken):
    """The last tenth of each record has as many blocks as a whole one, so that its remark has a standard error."""
    assert "does not grow" in steady_remainder(rig, shaken((1.0, 4.0), hidden=1.0), transient=36.0)
    late = replace(rig, actuators=(replace(LOGGED, gain=1.2),))
    low, high = measure(rig, late, shaken((1.0,), hidden=1.0, gain=1.2), transient=36.0).ci95
    assert low < high


def test_an_unexplained_gap_that_does_not_grow_is_remarked_and_what_is_closed_has_its_measure(rig, shaken, tmp_path):
    *fit, check = shaken((1.0, 4.0, 2.0), hidden=1.0, gain=1.1)
    gain = (kind_named("actuator_gain"),)
    verdict = diagnose(rig, fit, validation=[check], catalogue=gain, workers=1, seconds=0.3)
    assert verdict.outcome in ("part", "unknown")
    assert any("does not grow with the inputs" in note for note in verdict.notes)
    nearest = Effect(gain[0], "F", {"gain": 1.1}, {"gain": 0.01})
    near = replace(verdict, effects=(nearest,), shrinkage=replace(verdict.shrinkage, overall=0.29))
    assert near.sentence.endswith("would close 29 % of its rms.")
    assert verdict.where.place.is_single_force is False  # three forces have no place that one could be drawn at
    assert verdict.location_in_words.startswith("no single point force explains all of the gap; with the best, at x = ")
    case = Case("three", rig, tuple(fit), (check,))
    page = verdict_page(near, case, tmp_path / "three.html", folder=None, made_by="workbench diagnose three")
    assert "single unknown force" in page.read_text() and "reconstructed" not in page.read_text()
