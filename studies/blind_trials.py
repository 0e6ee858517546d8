"""Which effect is hidden in each case of a folder whose labels are withheld?"""

from collections.abc import Iterator
from pathlib import Path

from joblib import Parallel, delayed

from workbench.cases.case import read_case
from workbench.gap.diagnose import diagnose

NEEDS_DATA = "a folder of case folders"


def verdict_on(folder: Path) -> dict:
    """The verdict on one case, as JSON."""
    case = read_case(folder)
    return diagnose(case.rig, case.fit, validation=case.validation, name=case.name, workers=1, seconds=None).to_json()


def verdicts(folders: list[Path]) -> Iterator[dict]:
    """Verdicts in the order of the folders, two cases at a time."""
    yield from Parallel(n_jobs=2, return_as="generator")(delayed(verdict_on)(folder) for folder in folders)


def study(outcome, data: Path) -> None:
    folders = sorted(path.parent for path in data.glob("*/case.toml"))
    found = dict(
        zip([f.name for f in folders], outcome.track(_Sized(verdicts(folders), len(folders)), "cases"), strict=True)
    )

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


class _Sized:
    """A generator with a length, so that progress can be shown while it runs."""

    def __init__(self, items: Iterator, length: int):
        self.items, self.length = items, length

    def __iter__(self) -> Iterator:
        return iter(self.items)

    def __len__(self) -> int:
        return self.length
