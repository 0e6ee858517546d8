"""Figures of identification, by what they say: values of a MAC matrix, and which poles are stable."""

import numpy as np
import pytest

from workbench.draw.identification import plot_mac, stabilisation_diagram
from workbench.draw.interactive import described
from workbench.identification.free_decay.ibrahim import Stabilisation
from workbench.structure.modes import SampledModes


@pytest.mark.parametrize(("n_modes", "written"), [(1, 1), (3, 9), (12, 144), (13, 0)])
def test_a_mac_matrix_is_square_and_has_its_values_in_its_cells(n_modes, written):
    values = np.full((n_modes, n_modes), 0.126)
    values[0, 0] = 1.0
    [panel] = described(plot_mac(values))["panels"]
    texts = [mark for mark in panel["marks"] if mark["kind"] == "text"]
    assert panel["square"] and len(texts) == written
    if written:
        assert [(t["x"], t["y"]) for t in texts if t["text"] == "1.00"] == [(0.0, 0.0)]
        assert sum(t["text"] == "0.13" for t in texts) == written - 1
        assert {t["colour"] for t in texts if t["text"] == "1.00"} == {"#ffffff"}  # on dark blue


def test_a_stabilisation_diagram_tells_stable_poles_from_others_by_symbol_and_legend():
    """Beside the mode at 10 rad/s: one of another shape, one elsewhere, one that grows."""
    mode = SampledModes([10.0], [0.01], np.array([[1.0], [0.5]]), [0.0, 1.0])
    other = SampledModes([10.1], [0.01], np.array([[1.0], [-2.0]]), [0.0, 1.0])
    poles = SampledModes([10.1, 12.0], [0.01, 0.01], np.array([[1.0, 1.0], [0.5, 0.5]]), [0.0, 1.0])
    growing = SampledModes([10.0], [-0.01], np.array([[1.0], [0.5]]), [0.0, 1.0])
    figure = stabilisation_diagram(Stabilisation((1, 2, 3, 4), (mode, poles, other, growing)), mode, 10.0)
    shown = described(figure)
    marks = {mark["label"]: mark for mark in shown["panels"][0]["marks"]}
    stable, not_stable = marks["stable pole"], marks["pole that is not stable"]
    assert shown["legend"] and marks["stable mode"]["kind"] == "rule"
    assert stable["marker"] == "o" and stable["y"] == [1.0, 2.0]
    assert not_stable["marker"] == "x" and not_stable["y"] == [2.0, 3.0, 4.0]
    nothing = stabilisation_diagram(Stabilisation((1,), (other,)), mode.select([]), 10.0)
    assert [mark["label"] for mark in described(nothing)["panels"][0]["marks"]] == ["pole that is not stable"]
