"""Figures of blind trials: all cases are in the confusion matrix, those always named in one row."""

from workbench.draw.trials import plot_confusion
from workbench.trials.scoring import Tally


def drawn(n_kinds):
    right = {(f"kind_{i}", f"kind_{i}"): 2 for i in range(n_kinds)}
    wrong = {("bouc_wen", "kind_0"): 1, ("kind_1 + kind_2", "kind_1"): 3, ("none", "none"): 4}
    counts = right | wrong
    of = sum(counts.values())
    ax = plot_confusion(Tally(counts, {"single": (2 * n_kinds, of)}, 0, 0)).axes[0]
    return [label.get_text() for label in ax.get_yticklabels()], sum(int(text.get_text()) for text in ax.texts), of


def test_of_many_kinds_those_always_named_have_one_row():
    rows, shown, of = drawn(20)
    assert rows == ["Bouc-Wen", "kind 0", "kind 1", "one effect, always named", "nothing", "two effects"]
    assert shown == of


def test_few_kinds_have_a_row_each():
    rows, shown, of = drawn(4)
    assert rows == ["Bouc-Wen", "kind 0", "kind 1", "kind 2", "kind 3", "nothing", "two effects"]
    assert shown == of
