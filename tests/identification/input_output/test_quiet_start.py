"""Records that begin before their first force: at rest unless they are louder there than later."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.identification.driven import identify_driven
from workbench.identification.input_output.excitation import begin_at_rest
from workbench.records.record import Channel, Record


def struck(at, initial=0.0, n=8000, dt=1e-3):
    """A mode of 40 Hz, struck at a sample, that begins with a motion of this size over that by the blow."""
    rng, pole, u = np.random.default_rng(3), -4.0 + 250.0j, np.zeros(n)
    u[at : at + 4] = [0.4, 1.0, 1.0, 0.4]
    z, step = np.zeros(n, complex), np.exp(pole * dt)
    z[0] = 2.0 * initial
    for k in range(n - 1):
        z[k + 1] = step * z[k] + u[k]
    y = z.imag + 0.01 * rng.standard_normal(n)
    return Record(dt, y[None], (Channel("y", "displacement"),), u[None], (Channel("F", "force"),))


@pytest.mark.parametrize(
    ("at", "initial", "is_quiet"), [(1500, 0.0, True), (1500, 0.02, False), (100, 0.0, False), (5000, 0.0, False)]
)
def test_a_record_as_quiet_before_the_first_force_as_later_begins_at_rest(at, initial, is_quiet):
    """Too short before the force, or too short after it, nothing is known."""
    assert begin_at_rest([struck(at, initial)]) == is_quiet


def test_one_record_that_moves_is_enough():
    assert not begin_at_rest([struck(1500), struck(1500, 0.1)])


def test_the_mode_of_a_long_record_from_rest_has_no_initial_state():
    quiet, moving = (identify_driven(struck(1500, initial)) for initial in (0.0, 1.0))
    assert not quiet.initial[0].any() and moving.initial[0].any()
    for found in (quiet, moving):
        assert found.modes.poles == pytest.approx([-4.0 + 250.0j], rel=1e-3)
    given = identify_driven(struck(1500), at_rest=True)
    np.testing.assert_array_equal(quiet.modes.poles, given.modes.poles)


def test_the_initial_state_of_a_short_record_is_estimated():
    record = struck(1500)
    short = replace(record, outputs=record.outputs[:, :4500], inputs=record.inputs[:, :4500])
    assert identify_driven(short).initial[0].any()
