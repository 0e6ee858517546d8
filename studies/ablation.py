"""Which constants of the diagnosis search change a verdict? Each at half and at twice its value, on labelled cases."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path

from workbench.cases.case import read_case
from workbench.gap.search import settings
from workbench.trials.hold import verdict_on
from workbench.trials.scoring import score

NEEDS_DATA = "a folder of case folders, its labels beside it as FOLDER-labels.json"
FACTORS = {"half": 0.5, "twice": 2.0}
AS_IT_IS = {"group": "", "name": "", "factor": 1.0}


def settings_of_search() -> list[tuple[str, str]]:
    """(group, name) of every constant of the search."""
    groups = {name: held for name, held in vars(settings).items() if is_dataclass(held) and not isinstance(held, type)}
    return [(group, field.name) for group, held in groups.items() for field in fields(held)]


def scaled(value, factor):
    """A constant times a factor: a count stays one, of one at least; a table is scaled whole."""
    if isinstance(value, tuple):
        return tuple(item if isinstance(item, str) else scaled(item, factor) for item in value)
    return max(1, round(factor * value)) if isinstance(value, int) else factor * value


@contextmanager
def altered(group: str, name: str, factor: float) -> Iterator[None]:
    """One constant times a factor, in this process, for as long as a case takes; none where no group is named.

    Every step of the search holds the same settings, so that a change of them reaches all of it: frozen to all else.
    """
    if not group:
        yield
        return
    held = getattr(settings, group)
    before = getattr(held, name)
    object.__setattr__(held, name, scaled(before, factor))
    try:
        yield
    finally:
        object.__setattr__(held, name, before)


def trial(case: Path, label: dict, group: str, name: str, factor: float) -> dict:
    """What the diagnosis says of a case with one constant altered, and whether that is wrong."""
    with altered(group, name, factor):
        verdict = verdict_on(case)
    rig = read_case(case).rig
    parts = {"inputs": [part.name for part in rig.actuators], "outputs": [part.name for part in rig.sensors]}
    found = score(verdict, label, domain=rig.modes.domain, **parts)
    right = found["kinds"] and found["channels"] is not False and found["positions"] is not False
    named = [" of ".join([e["kind"], *(e[key] for key in ("input", "output") if key in e)]) for e in verdict["effects"]]
    said = f"{verdict['outcome']}: {' + '.join(sorted(named)) or 'no effect'}"
    return {"verdict": said if right else f"{said} (wrong)"}


def study(outcome, data: Path) -> None:
    labels = json.loads((data.parent / f"{data.name}-labels.json").read_text(encoding="utf-8"))
    folders = sorted(path.parent for path in data.glob("*/case.toml"))
    values = {(group, name): getattr(getattr(settings, group), name) for group, name in settings_of_search()}
    altered_ones = [
        {"group": group, "name": name, "factor": factor}
        for (group, name), value in values.items()
        for factor in FACTORS.values()
        if scaled(value, factor) != value  # half of a count of one is one
    ]
    cases = [
        {"case": folder, "label": {"effects": labels[folder.name]["effects"]}, **how}
        for how in (AS_IT_IS, *altered_ones)
        for folder in folders
    ]
    found = outcome.run(cases, trial)
    told = {(r["group"], r["name"], r["factor"], r["case"].name): r["verdict"] for r in found if r.error is None}
    as_it_is = {f.name: told[key] for f in folders if (key := (*AS_IT_IS.values(), f.name)) in told}

    rows = {}
    for (group, name), value in values.items():
        row = rows[f"{group}.{name}"] = {"value": value}
        for word, factor in FACTORS.items():
            after = {folder: told.get((group, name, factor, folder)) for folder in as_it_is}
            changed = {folder: verdict for folder, verdict in after.items() if verdict not in (None, as_it_is[folder])}
            row.update({word: changed} if changed else {})
            for folder, verdict in changed.items():
                outcome.say(f"{group}.{name} {word}, {folder}: {as_it_is[folder]} → {verdict}")
    idle = [setting for setting, row in rows.items() if not row.keys() & FACTORS.keys()]
    outcome.table("verdicts", as_it_is)
    outcome.table("settings", rows)
    outcome.table("change no verdict", idle)
    outcome.say(
        f"{len(rows) - len(idle)} of {len(rows)} constants change a verdict at half or at twice their value, on"
        f" {', '.join(as_it_is)}"
    )
    outcome.check("diagnoses that ended in an error", sum(r.error is not None for r in found), 0)
