"""Which constants of the diagnosis search could go? Each is made nothing and boundless in turn, on labelled cases."""

import json
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from types import FrameType

from workbench.cases.case import read_case
from workbench.gap.search import settings
from workbench.trials.hold import draw_imperfect_kinds, draw_kinds, verdict_on, write_trials
from workbench.trials.scoring import score

NEEDS_DATA = "a folder of folders of cases, each FOLDER with its labels beside it as FOLDER-labels.json"

# Factors on a number. A count has none, or ten times as many: its work grows with it, and a search has no more to try.
NONE, BOUNDLESS = 1e-6, 1e6
MANY = 10
EXTREMES = ("none", "boundless")

OWN, SEED = 16, 20300909  # trials of this study's own: half with effects alone, half beside errors of a test
LONGEST = 30.0  # s of processor time: a case that takes longer is left out
PATIENCE = 3.0  # times the time of the case with all constants as they are, and 10 s: beyond, a constant has an effect
# Cases that are tried one after another, the quickest first, and constants that are altered together on each: the first
# case shows the most. Where the verdict changes, halves of them are altered, down to a single one.
BATCHES = ((1, 1), (2, 12), (4, 12), (8, 12), (16, 48))


def settings_of_search() -> list[tuple[str, str]]:
    """(group, name) of every constant of the search."""
    groups = {name: held for name, held in vars(settings).items() if is_dataclass(held) and not isinstance(held, type)}
    return [(group, field.name) for group, held in groups.items() for field in fields(held)]


def at_extreme(value, extreme: str):
    """A constant at one extreme; a table is altered whole."""
    if isinstance(value, tuple):
        return tuple(item if isinstance(item, str) else at_extreme(item, extreme) for item in value)
    if isinstance(value, int):
        return 0 if extreme == "none" else MANY * value
    return value * (NONE if extreme == "none" else BOUNDLESS)


@contextmanager
def altered(constants: Sequence[Sequence[str]]) -> Iterator[None]:
    """These constants, as (group, name, extreme), at their extremes, in this process, for as long as a case takes.

    Every step of the search holds the same settings, so that a change of them reaches all of it: frozen to all else.
    """
    before = [(getattr(settings, group), name) for group, name, _ in constants]
    values = [getattr(held, name) for held, name in before]
    for (held, name), value, (*_, extreme) in zip(before, values, constants, strict=True):
        object.__setattr__(held, name, at_extreme(value, extreme))
    try:
        yield
    finally:
        for (held, name), value in zip(before, values, strict=True):
            object.__setattr__(held, name, value)


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """End what takes more processor time, by a `TimeoutError`: with a boundless constant a search may have no end."""

    def end(_: int, __: FrameType | None) -> None:
        raise TimeoutError(f"more than {seconds:.0f} s")

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def diagnosed(folder: Path, label: dict) -> str:
    """What the diagnosis says of a case, and whether that is wrong."""
    verdict = verdict_on(folder)
    rig = read_case(folder).rig
    parts = {"inputs": [part.name for part in rig.actuators], "outputs": [part.name for part in rig.sensors]}
    found = score(verdict, label, domain=rig.modes.domain, **parts)
    right = found["kinds"] and found["channels"] is not False and found["positions"] is not False
    named = [" of ".join([e["kind"], *(e[key] for key in ("input", "output") if key in e)]) for e in verdict["effects"]]
    said = f"{verdict['outcome']}: {' + '.join(sorted(named)) or 'no effect'}"
    return said if right else f"{said} (wrong)"


def trial(case: dict, constants: list, limit: float) -> dict:
    """What the diagnosis says of a case, in a folder or drawn, with these constants altered; its processor time, s."""
    begun = process_time()
    with TemporaryDirectory() as drawn, within(limit):
        folder = Path(case["folder"]) if "folder" in case else Path(drawn) / "cases"
        label = case.get("label")
        if label is None:
            labels = Path(drawn) / "labels.json"
            write_trials(folder, labels, 1, case["seed"], **case["hidden"])
            ((name, label),) = json.loads(labels.read_text(encoding="utf-8")).items()
            folder = folder / name
        with altered(constants):
            verdict = diagnosed(folder, {"effects": label["effects"]})
    return {"verdict": verdict, "processor": process_time() - begun}


def trial_at_extremes(case: dict, constants: list, limit: float) -> dict:
    """`trial` with constants that may keep the search from ending at all."""
    try:
        return trial(case, constants, limit)
    except Exception as error:
        return {"verdict": f"no verdict ({type(error).__name__})"}


def in_groups(constants: Sequence, size: int) -> list[list]:
    return [list(constants[i : i + size]) for i in range(0, len(constants), size)]


def cases_of(data: Path) -> dict[str, dict]:
    """The labelled cases of a folder of folders by name, and trials drawn here."""
    found = {}
    for labels in sorted(data.glob("*-labels.json")):
        folder = data / labels.name.removesuffix("-labels.json")
        for name, label in json.loads(labels.read_text(encoding="utf-8")).items():
            found[f"{folder.name}/{name}"] = {"folder": folder / name, "label": {"effects": label["effects"]}}
    for i, kinds in enumerate(draw_kinds(OWN // 2, SEED)):
        found[f"drawn {SEED + i}"] = {"seed": SEED + i, "hidden": {"kinds": [list(kinds)]}}
    for i, draw in enumerate(draw_imperfect_kinds(OWN // 2, SEED), OWN // 2):
        hidden = {"imperfections": draw.imperfections, "size": draw.size, "kinds": [list(draw.kinds)]}
        found[f"drawn {SEED + i}"] = {"seed": SEED + i, "hidden": hidden}
    return found


def study(outcome, data: Path) -> None:
    cases = cases_of(data)
    runs = [{"case": case, "constants": [], "limit": LONGEST} for case in cases.values()]
    found = dict(zip(cases, outcome.run(runs, trial, name="as they are"), strict=True))
    failed = [r.error for r in found.values() if r.error is not None and "TimeoutError" not in r.error]
    as_it_is = {name: r["verdict"] for name, r in found.items() if r.error is None}
    shortest = sorted(as_it_is, key=lambda name: found[name]["processor"])
    values = {(group, name): getattr(getattr(settings, group), name) for group, name in settings_of_search()}

    effects: dict[tuple[str, str], dict] = {}  # of a constant: what it changed, and on which case
    ahead = iter(shortest)
    for n_cases, size in BATCHES:
        left = [(*each, extreme) for each in values if each not in effects for extreme in EXTREMES]
        groups = [(name, group) for name in islice(ahead, n_cases) for group in in_groups(left, size)]
        while groups:
            runs = [
                {
                    "case": cases[name],
                    "constants": [list(each) for each in group],
                    "limit": PATIENCE * found[name]["processor"] + 10.0,
                }
                for name, group in groups
            ]
            split = []
            for (name, group), result in zip(groups, outcome.run(runs, trial_at_extremes, name="altered"), strict=True):
                after = result["verdict"]
                if after == as_it_is[name]:
                    continue
                if len(group) > 1:
                    split += [(name, half) for half in in_groups(group, (len(group) + 1) // 2)]
                else:
                    ((of, constant, extreme),) = group
                    effects.setdefault((of, constant), {"at": extreme, "case": name, "verdict": after})
            groups = [(name, rest) for name, group in split if (rest := [c for c in group if c[:2] not in effects])]

    idle = [".".join(each) for each in values if each not in effects]
    tried = shortest[: sum(n_cases for n_cases, _ in BATCHES)]
    outcome.table("verdicts", {name: as_it_is[name] for name in tried})
    outcome.table("settings", {".".join(each): {"value": values[each], **effects.get(each, {})} for each in values})
    outcome.table("change no verdict", idle)
    outcome.say(
        f"{len(effects)} of {len(values)} constants change a verdict where they are none or boundless, on"
        f" {len(tried)} cases"
    )
    outcome.check("diagnoses that ended in an error", len(failed), 0)
