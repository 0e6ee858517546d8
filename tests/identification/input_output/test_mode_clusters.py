import numpy as np

from workbench.identification.input_output.peak_shape import overlap_remarks, parts_of


def poles(hz, zeta):
    omega = 2.0 * np.pi * np.array(hz)
    return omega * (-np.array(zeta) + 1j)


def test_a_crowd_out_of_phase_is_one_mode():
    """The third reaches the first only by way of the second."""
    told = parts_of(poles([100.0, 101.5, 103.0, 200.0], [0.01] * 4), np.array([1.0, 0.6, 0.9, 0.5]), np.arange(4.0) + 1)
    assert told == {2: [1, 0]}


def test_two_beside_each_other_or_three_in_phase_stand_for_themselves():
    assert parts_of(poles([100.0, 101.0], [0.01, 0.01]), np.array([0.3, 0.4]), np.ones(2)) == {}
    assert parts_of(poles([100.0, 101.0, 102.0], [0.01] * 3), np.array([0.99, 0.98, 1.0]), np.ones(3)) == {}


def test_a_broad_part_leads_no_other_peak_into_the_crowd():
    near = poles([100.0, 100.5, 110.0, 125.0], [0.005, 0.005, 0.2, 0.005])
    assert parts_of(near, np.array([0.99, 0.5, 0.3, 1.0]), np.array([9.0, 3.0, 2.0, 8.0])) == {0: [1, 2]}


def test_one_input_and_output_cannot_tell_a_drift_from_two_modes():
    poles = np.array([-1.0 + 100.0j, -1.0 + 101.9j, -1.0 + 104.0j])
    assert overlap_remarks(poles, 1)[0].startswith("modes 1 and 2 overlap: ")
    assert overlap_remarks(poles, 2) == () and overlap_remarks(poles[[0, 2]], 1) == ()
