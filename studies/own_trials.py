"""How often does the diagnosis name what hides, on cases made by finite elements with sealed labels?"""

from pathlib import Path

from workbench.draw.trials import plot_confusion
from workbench.gap.holding import hold_trials

CASES, SEED = 240, 1981


def study(outcome, data: Path | None = None) -> None:
    shown = iter(outcome.track(range(CASES), "cases"))
    held = hold_trials(
        CASES, SEED, jobs=2, report=lambda text, share: next(shown, None) if "diagnosed" in text else None
    )

    closed = []
    for name, one in held.scores.items():
        share = one["shrinkage"].get("validate")
        if one["kinds"] and one["family"] in ("single", "pair") and share is not None:
            closed.append(share)
        if not one["kinds"]:
            outcome.say(f"{name}  hidden {one['hidden']}, told {one['told']}")
    shares = held.tally.shares
    outcome.table("scores", held.scores)
    outcome.table("shares", shares)

    for family, limit in (("single", 0.95), ("pair", 0.85), ("unknown", 1.0)):
        right, of = shares[family]
        outcome.check(f"{family}: share named rightly of {of}", right / of, limit, at_least=True)
    quiet, of = shares["none"]
    outcome.check(f"false alarms in {of} cases that hide nothing", of - quiet, 0)
    outcome.check(f"places more than 2 % of the length off, of {held.tally.placed}", held.tally.misplaced, 0)
    outcome.check("median share of the closable gap closed", sorted(closed)[len(closed) // 2], 0.95, at_least=True)
    outcome.figure("confusion", plot_confusion(held.tally), "What hid against what was told, in blind cases.")
