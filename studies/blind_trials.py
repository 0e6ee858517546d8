"""Which effect is hidden in each case of a folder whose labels are withheld?"""

from pathlib import Path

from workbench.cases.case import read_case
from workbench.gap.diagnose_case import diagnose_case

NEEDS_DATA = "a folder of case folders"


def verdict_on(folder: Path) -> dict:
    """The verdict on one case, as JSON."""
    case = read_case(folder)
    verdict = diagnose_case(case, workers=1, seconds=None)
    return {"verdict": verdict.to_json()}


def study(outcome, data: Path) -> None:
    folders = sorted(path.parent for path in data.glob("*/case.toml"))
    held = outcome.run([{"folder": folder} for folder in folders], verdict_on)
    found = {result["folder"].name: result["verdict"] for result in held}

    rows = []
    for name, verdict in found.items():
        kinds = " + ".join(effect["kind"] for effect in verdict["effects"]) or "none"
        closed = verdict["shrinkage"].get("validate")
        rows.append(
            {
                "case": name,
                "outcome": verdict["outcome"],
                "effects": kinds,
                "share_closed": closed,
                "residual": verdict["residual"]["corrected"],
            }
        )
        outcome.say(f"{name}  {verdict['sentence']}")
    outcome.table("verdicts", found)
    outcome.table("table", rows)
    closed = sorted(r["share_closed"] for r in rows if r["outcome"] == "explained" and r["share_closed"] is not None)
    if closed:
        outcome.check(
            "median share of the closable gap closed where explained", closed[len(closed) // 2], 0.95, at_least=True
        )
