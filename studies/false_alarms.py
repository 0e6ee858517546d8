"""How often does the diagnosis name an effect where none is hidden, beside noise alone and beside small errors?"""

from itertools import cycle
from pathlib import Path

from workbench.gap.diagnose_case import diagnose_case
from workbench.trials.imperfections import CLEAN, IMPERFECTIONS, SIZES, TRIPLE
from workbench.trials.make import make_trial

CASES, SEED = 100, 40000  # with nothing but sensor noise
IMPERFECT, IMPERFECT_SEED = 300, 20400115  # beside the small errors of a real test, each class and size in turn


def diagnosed(seed: int, imperfections: str = CLEAN, size: float = 1.0) -> list[str]:
    """Kinds of the effects that the diagnosis names on a case that hides none."""
    case, _ = make_trial(seed, imperfections=imperfections, size=size)
    verdict = diagnose_case(case, workers=1, seconds=None).to_json()
    return [effect["kind"] for effect in verdict["effects"]]


def study(outcome, data: Path | None = None) -> None:
    classes = [name for name in IMPERFECTIONS if name not in (CLEAN, TRIPLE)]
    each = cycle((imperfections, size) for size in SIZES for imperfections in classes)
    clean = [{"seed": SEED + i, "imperfections": CLEAN, "size": 1.0} for i in range(CASES)]
    seeds = range(IMPERFECT_SEED, IMPERFECT_SEED + IMPERFECT)
    imperfect = [
        {"seed": seed, "imperfections": imperfections, "size": size} for seed, (imperfections, size) in zip(seeds, each)
    ]
    found = outcome.run([*clean, *imperfect], diagnosed)
    failed = [result for result in found if result.error is not None]
    alarms = {result["seed"]: result["result"] for result in found if result.error is None and result["result"]}
    outcome.table("cases", {"sensor noise alone": CASES, "beside small errors": IMPERFECT})
    outcome.table("alarms", alarms)
    outcome.check(f"cases of {CASES + IMPERFECT} that ended in an error", len(failed), 0)
    for name, cases, allowed in (("sensor noise alone", clean, CASES // 100), ("small errors", imperfect, 0)):
        of_these = sum(case["seed"] in alarms for case in cases)
        outcome.check(f"false alarms in {len(cases)} cases, {name}", of_these, allowed)
        outcome.say(f"{name}: {of_these} false alarms in {len(cases)} cases that hide nothing")
