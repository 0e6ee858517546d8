"""How often does the diagnosis name the hidden effect where the model is exact but for it, in blind trials?"""

from pathlib import Path

from workbench.draw.trials import plot_confusion
from workbench.trials.hold import draw_kinds, hold_one, processor_times
from workbench.trials.scoring import statistics

CASES, SEED = 200, 845211


def study(outcome, data: Path | None = None) -> None:
    hidden = draw_kinds(CASES, SEED)
    found = outcome.run([{"kinds": list(kinds), "seed": SEED + i} for i, kinds in enumerate(hidden)], hold_one)
    scores = [result["score"] for result in found if result.error is None]
    held = statistics(scores)
    for result in found:
        if result.error is not None:
            outcome.say(f"seed {result['seed']}: {result.error}")
        elif not result["score"]["kinds"]:
            score = result["score"]
            outcome.say(f"seed {result['seed']}: true {score['hidden']}, diagnosed {score['diagnosed']}")
    outcome.table("scores", {result["seed"]: result["score"] for result in found if result.error is None})
    outcome.table("shares", held.shares)
    for family in held.shares:
        of_family = [result for result in found if not result.error and result["score"]["family"] == family]
        outcome.table(f"processor time of {family} cases, s", processor_times(of_family))

    outcome.check(f"trials of {CASES} that ended in an error", CASES - len(scores), 0)
    for family, limit in (("single", 0.95), ("pair", 0.85), ("unknown", 1.0)):
        right, of = held.shares[family]
        outcome.check(f"{family}: share identified correctly, of {of}", right / of, limit, at_least=True)
    quiet, of = held.shares["none"]
    outcome.check(f"false alarms in {of} cases without an effect", of - quiet, 0)
    outcome.check(f"places more than 2 % of the length off, of {held.placed}", held.misplaced, 0)
    closed = sorted(
        one["shrinkage"]["validate"]
        for one in scores
        if one["kinds"] and one["family"] in ("single", "pair") and one["shrinkage"].get("validate") is not None
    )
    outcome.check("median share of the closable gap closed", closed[len(closed) // 2], 0.95, at_least=True)
    outcome.figure(
        "confusion",
        plot_confusion(held),
        "True against identified effects, in blind trials with an otherwise exact model.",
    )
