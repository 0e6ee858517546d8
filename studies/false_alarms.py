"""How often does the diagnosis name an effect where none is hidden? A hundred cases with nothing but sensor noise."""

from pathlib import Path

from workbench.gap.diagnose import diagnose
from workbench.trials.make import make_trial

CASES, SEED = 100, 40000


def diagnosed(seed: int) -> list[str]:
    """Kinds of the effects that the diagnosis names on a case that hides none."""
    case, _ = make_trial(seed)
    verdict = diagnose(case.rig, case.fit, validation=case.validation, workers=1, seconds=None).to_json()
    return [effect["kind"] for effect in verdict["effects"]]


def study(outcome, data: Path | None = None) -> None:
    found = outcome.run([{"seed": SEED + i} for i in range(CASES)], diagnosed)
    alarms = {result["seed"]: result["result"] for result in found if result["result"]}
    outcome.table("cases", CASES)
    outcome.table("alarms", alarms)
    outcome.check(f"false alarms in {CASES} cases", len(alarms), CASES // 100)
    outcome.say(f"{len(alarms)} false alarms in {CASES} cases that hide nothing")
