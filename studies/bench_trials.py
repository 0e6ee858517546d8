"""How often does the diagnosis name the hidden effect on a plate or a frame, in blind trials by finite elements?

Plates have any of five sets of edges; frames have two or three storeys and are known at every other node alone. Half of
the effects at a point of a frame act between two points.
"""

from pathlib import Path

from workbench.draw.trials import plot_confusion
from workbench.trials.hold import RARE_KINDS, draw_kinds, hold_one, processor_times
from workbench.trials.scoring import statistics

SINGLES, PAIRS, QUIET, SEED = 13, 4, 4, 985311  # of each structure


def cases_on(structure, seed):
    """The trials on plates, or on frames: what hides in each, and its seed."""
    drawn = [kinds for kinds in draw_kinds(60, seed, structure=structure) if not set(kinds) & set(RARE_KINDS)]
    singles, pairs = ([kinds for kinds in drawn if len(kinds) == n] for n in (1, 2))
    each = [*singles[:SINGLES], *pairs[:PAIRS], *[()] * QUIET]
    seeds = [*range(SINGLES), *range(13, 13 + PAIRS), *range(17, 17 + QUIET)]
    return [{"structure": structure, "kinds": list(k), "seed": seed + i} for k, i in zip(each, seeds, strict=True)]


def study(outcome, data: Path | None = None) -> None:
    cases = [*cases_on("plates", SEED), *cases_on("frames", SEED + 1000)]
    found = outcome.run(cases, hold_one)
    held = [result for result in found if result.error is None]
    for result in found:
        where = f"{result['structure']}, seed {result['seed']}"
        if result.error is not None:
            outcome.say(f"{where}: {result.error}")
        elif not result["score"]["kinds"]:
            outcome.say(f"{where}: true {result['score']['hidden']}, diagnosed {result['score']['diagnosed']}")
    outcome.table("scores", {f"{r['structure']} {r['seed']}": r["score"] for r in held})
    for structure in ("plates", "frames"):
        outcome.table(
            f"shares on {structure}", statistics(r["score"] for r in held if r["structure"] == structure).shares
        )
    whole = statistics(r["score"] for r in held)
    outcome.table("shares", whole.shares)
    for family in whole.shares:
        times = processor_times(r for r in held if r["score"]["family"] == family)
        outcome.table(f"processor time of {family} cases, s", times)

    outcome.check(f"trials of {len(cases)} that ended in an error", len(found) - len(held), 0)
    for family, limit in (("single", 0.95), ("pair", 0.85)):
        right, of = whole.shares[family]
        outcome.check(f"{family}: share identified correctly, of {of}", right / of, limit, at_least=True)
    quiet, of = whole.shares["none"]
    outcome.check(f"false alarms in {of} cases without an effect", of - quiet, 0)
    outcome.check(f"places wrong, or more than 2 % of the diagonal off, of {whole.placed}", whole.misplaced, 0)
    outcome.figure(
        "confusion", plot_confusion(whole), "True against identified effects, in blind trials on plates and frames."
    )
