"""Figures of blind trials."""

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from workbench.draw.style import COLOURS, GREY, new_figure
from workbench.gap.effects.effect import label_in_words
from workbench.trials.scoring import Tally

FAMILY = {
    "single": "one effect:",
    "pair": "two effects:",
    "none": "nothing hidden:",
    "unknown": "outside the catalogue:",
}
BOTH, OTHER, ALWAYS_RIGHT = "both effects", "another two", "always right"
MANY = 12  # number of kinds above which those that were always named share one row


def plot_confusion(tally: Tally) -> Figure:
    """The confusion matrix of true and diagnosed effects, with the number of cases in each square."""
    counts = _gathered(tally)
    rows = sorted({hidden for hidden, _ in counts}, key=_order)
    columns = rows + sorted({named for _, named in counts} - set(rows), key=_order)
    figure, ax = new_figure(width=max(8.0, 3.6 + 0.27 * len(columns)), height=2.6 + 0.24 * len(rows))
    for (hidden, named), count in counts.items():
        x, y, right = columns.index(named), rows.index(hidden), hidden == named
        ax.add_patch(Rectangle((x - 0.46, y - 0.44), 0.92, 0.88, color=COLOURS[0 if right else 1], linewidth=0))
        ax.text(x, y, str(count), ha="center", va="center", color="white", fontsize=8)
    ax.plot([-0.5, len(rows) - 0.5], [-0.5, len(rows) - 0.5], color=GREY, linewidth=0.6, zorder=0)
    ax.set_xticks(range(len(columns)), [_plain(c) for c in columns], rotation=90, fontsize=8)
    ax.set_yticks(range(len(rows)), ["two effects" if r == BOTH else _plain(r) for r in rows], fontsize=8)
    ax.set(
        xlim=(-0.6, len(columns) - 0.4), ylim=(len(rows) - 0.4, -0.6), xlabel="diagnosed effect", ylabel="true effect"
    )
    total = sum(of for _, of in tally.shares.values())
    each = [f"{FAMILY[family]} {right} of {of}" for family, (right, of) in tally.shares.items()]
    words = "\n".join("; ".join(each[i : i + 2]) for i in range(0, len(each), 2))
    ax.set_title(f"{total} blind cases; number of each, blue correct, orange wrong\n{words}")
    return figure


def _gathered(tally: Tally) -> dict[tuple[str, str], int]:
    """Counts with all pairs in one row and two columns, and with many kinds those that are always right in one row."""
    gathered: dict[tuple[str, str], int] = {}

    def add(hidden: str, named: str, count: int) -> None:
        gathered[hidden, named] = gathered.get((hidden, named), 0) + count

    singles = {hidden for hidden, _ in tally.counts if " + " not in hidden} - {"none", "unknown"}
    mixed_up = {name for pair in tally.counts if pair[0] != pair[1] for name in pair}
    sure = singles - mixed_up if len(singles) > MANY else set()
    for (hidden, named), count in tally.counts.items():
        if " + " in hidden:
            add(BOTH, BOTH if named == hidden else OTHER if " + " in named else named, count)
        elif hidden in sure:
            add(ALWAYS_RIGHT, ALWAYS_RIGHT, count)
        else:
            add(hidden, OTHER if " + " in named else named, count)
    return gathered


def _order(name: str) -> tuple[int, str]:
    return ({ALWAYS_RIGHT: 1, "none": 2, BOTH: 3, OTHER: 4, "unknown": 5}.get(name, 0), name)


def _plain(name: str) -> str:
    plain = {"none": "nothing", "unknown": "outside the catalogue", ALWAYS_RIGHT: "one effect, always named"}
    return plain.get(name, label_in_words(name))
