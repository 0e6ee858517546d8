"""Figures of blind trials: every case is in the row of its true effect."""

import re

import pytest

from workbench.draw.trials import plot_confusion
from workbench.trials.scoring import Statistics


@pytest.mark.parametrize(("n_kinds", "columns"), [(4, 1), (40, 2)])
def test_each_effect_has_a_row_with_the_cases_that_are_named(n_kinds, columns):
    right = {(f"kind_{i}", f"kind_{i}"): 2 for i in range(n_kinds)}
    pairs = {("kind_1 + kind_2", "kind_1"): 3, ("kind_1 + kind_3", "kind_1 + kind_3"): 5}
    counts = right | pairs | {("bouc_wen", "kind_0"): 1, ("kind_0", "kind_1"): 1, ("none", "none"): 4}
    of = sum(counts.values())
    figure = plot_confusion(Statistics(counts, {"single": (2 * n_kinds, 2 * n_kinds + 2), "pair": (5, 8)}, 0, 0))
    assert len(figure.axes) == columns
    rows = [label.get_text() for ax in figure.axes for label in ax.get_yticklabels()]
    kinds = sorted(f"kind {i}" for i in range(n_kinds))
    assert rows == ["hysteretic spring (Bouc-Wen)", *kinds, "nothing", "two effects"]
    texts = [text.get_text() for ax in figure.axes for text in ax.texts]
    shares = [re.fullmatch(r"(\d+) / (\d+)", text) for text in texts]
    numbers = dict(zip(rows, ((int(s[1]), int(s[2])) for s in shares if s), strict=True))
    assert sum(cases for _, cases in numbers.values()) == of
    assert (numbers["hysteretic spring (Bouc-Wen)"], numbers["kind 0"], numbers["two effects"]) == (
        (0, 1),
        (2, 3),
        (5, 8),
    )
    instead = [text for text, share in zip(texts, shares) if not share]
    assert instead == [f"named instead: {name}" for name in ("kind 0 1", "kind 1 1", "kind 1 3")]
    assert figure.get_suptitle().endswith(f"one effect {2 * n_kinds} of {2 * n_kinds + 2}, two effects 5 of 8")
