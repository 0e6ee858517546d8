"""Figures that one study alone shows, drawn without running it."""

from pathlib import Path
from runpy import run_path
from types import SimpleNamespace

import numpy as np

STUDIES = Path(__file__).parents[2] / "studies"


def test_costs_of_both_controllers_are_counted_by_how_far_they_are_above_the_best():
    def told(cost):
        return {"stable": bool(np.isfinite(cost)), "cost": cost}

    nominal = [2.0, 2.01, 2.1, 3.0, 5.0, 29.0, np.inf]  # over 2: 0, 0.5, 5, 50, 150 and 1350 %
    rows = [{"true": told(2.0), "nominal": told(cost), "redesigned": told(1.9)} for cost in nominal]
    (ax,) = run_path(str(STUDIES / "closing_the_loop.py"))["_figure"](rows).axes
    assert [bar.get_height() for bar in ax.patches] == [2, 1, 1, 2, 1, 7, 0, 0, 0, 0]
    names = [label.get_text() for label in ax.get_xticklabels()]
    assert names == ["at most 1 %", "1 to 10 %", "10 to 100 %", "over 100 %", "unstable"]
    assert "≤ 14.5 times" in [text.get_text() for text in ax.texts]


def test_the_law_of_a_joint_is_drawn_over_the_loop_about_its_largest_stretch():
    study = run_path(str(STUDIES / "frame_gap.py"))
    _, lines, at = study["frame"]()
    x = 5e-4 * np.sin(np.linspace(0.0, 40.0, 1000)) * np.linspace(0.2, 1.0, 1000)
    effect = SimpleNamespace(
        kind=SimpleNamespace(words="a hysteretic spring"),
        at=("R1.x", "C2.x"),
        values={"stiffness": 900.0, "yield_displacement": 1.2e-4},
    )
    left, right = study["plot_joint"](at, lines, effect, np.column_stack([x, 100.0 * x])).axes
    real, law = right.lines[:2]
    n = 2 * study["SHOWN"]
    assert real.get_xdata().size == law.get_xdata().size == n
    assert np.abs(real.get_xdata()).max() == 1e3 * np.abs(x).max()
    assert np.abs(law.get_ydata()).max() <= 900.0 * 1.2e-4
    assert {"floor 1", "floor 3", "0.4 m"} <= {text.get_text() for text in left.texts}
