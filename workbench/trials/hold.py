"""Holding blind trials: draw what is hidden, write the cases with sealed labels, diagnose them, score them."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from workbench.cases.case import Case, read_case
from workbench.cases.writing import write_case
from workbench.gap.diagnose_case import diagnose_case
from workbench.renamed import former_fields
from workbench.trials.imperfections import CLEAN, IMPERFECTIONS, INDISTINGUISHABLE, SIZES, TRIPLE
from workbench.trials.make import KINDS, OUTSIDE_KINDS, check_kinds, find_trial_with_plant
from workbench.trials.rigs import FRAMES, MEMBERS, PLATES
from workbench.trials.scoring import Statistics, score, score_imperfect, statistics

MOST_SEEDS = 100

# Kinds that few trials hide, in turn with none and with pairs: those outside the vocabulary, and one that was. Their
# order and that of the common kinds decide what a seed draws, so that a kind which enters the vocabulary keeps its
# place here.
_BEFORE = OUTSIDE_KINDS.index("bent_command")
RARE_KINDS = (*OUTSIDE_KINDS[:_BEFORE], "actuator_crosstalk", *OUTSIDE_KINDS[_BEFORE:])
COMMON_KINDS = tuple(kind for kind in KINDS if kind not in RARE_KINDS)

# Kinds that are impossible on a structure.
OF_MEMBERS = frozenset({"local_stiffness_loss", "support_rotation", "axial_load", "air_drag", "midplane_stretching"})
NOT_ON = {MEMBERS: frozenset(), PLATES: OF_MEMBERS, FRAMES: OF_MEMBERS | {"truncated_modes"}}

# Kinds that the records of a case cannot distinguish.
ALIKE = ({"actuator_lag", "actuator_delay", "sensor_lag", "sensor_delay"}, {"modulus_error", "stiffness_drift"})


class ImperfectDraw(NamedTuple):
    """The draw of a trial with imperfections: their class and size, and the kinds of the hidden effects."""

    imperfections: str
    size: float
    kinds: tuple[str, ...]


def draw_kinds(n: int, seed: int, *, like: Case | None = None, structure: str = MEMBERS) -> list[tuple[str, ...]]:
    """Random kinds for n trials: of every 60, 40 of one common kind, 10 pairs, 5 without and 5 of a rare kind."""
    rng = np.random.default_rng(seed)
    missing = NOT_ON[structure] if like is None else {"truncated_modes"}
    pool = [kind for kind in COMMON_KINDS if kind not in missing]
    singles = [(str(kind),) for _ in range(n // len(pool) + 1) for kind in rng.permutation(pool)]
    drawn: list[tuple[str, ...]] = []
    for i in range(n):
        turn = (i * 7 + 3) % 60  # spreads the families over the list for any n
        if turn < 5:
            drawn.append(())
        elif turn < 10:
            drawn.append((str(rng.choice(RARE_KINDS)),))
        elif turn < 20:
            drawn.append(_draw_several(2, pool, rng))
        else:
            drawn.append(singles.pop(0))
    return drawn


def draw_imperfect_kinds(
    n: int, seed: int, *, imperfections: str = "all", size: float | None = None
) -> list[ImperfectDraw]:
    """Random imperfections and kinds for n trials; every third trial has no hidden effect.

    Args:
        imperfections: a class, or "all" for each in turn.
        size: of the imperfections; None for each of `SIZES` in turn.
    """
    rng = np.random.default_rng(seed)
    classes = IMPERFECTIONS if imperfections == "all" else (imperfections,)
    drawn: list[ImperfectDraw] = []
    for i in range(n):
        turn, name = i // len(classes), classes[i % len(classes)]
        pool = [k for k in COMMON_KINDS if k not in INDISTINGUISHABLE[name]]
        if name == TRIPLE:
            kinds = tuple(sorted(_draw_several(3, pool, rng)))
        else:
            kinds = () if (turn // len(SIZES) + turn) % 3 == 2 else (str(rng.choice(pool)),)
        drawn.append(ImperfectDraw(name, SIZES[turn % len(SIZES)] if size is None else size, kinds))
    return drawn


def _draw_several(n: int, pool: list[str], rng: np.random.Generator) -> tuple[str, ...]:
    """n random kinds that records can distinguish."""
    while True:
        kinds = tuple(str(kind) for kind in rng.choice(pool, n, replace=False))
        if "truncated_modes" not in kinds and not any(len(alike & set(kinds)) > 1 for alike in ALIKE):
            return kinds


def write_trials(
    folder: str | Path,
    labels: str | Path,
    n: int,
    seed: int,
    *,
    like: Case | None = None,
    structure: str = MEMBERS,
    kinds: Sequence[Sequence[str]] | None = None,
    imperfections: str | None = None,
    size: float | None = None,
    report: Callable[[str, float], None] = lambda text, share: None,
) -> None:
    """Write n cases as folders, and their labels as one JSON file elsewhere.

    Args:
        like: a case whose rig and kinds of record all cases have; None draws a bench for each case. Kinds that are
            impossible on a bench are replaced by others.
        structure: of drawn benches: "members" (beams and rods), "plates" or "frames".
        kinds: of the hidden effects of each case; None draws them, see `draw_kinds` and `draw_imperfect_kinds`.
        imperfections: class of small additional errors, of `IMPERFECTIONS`, or "all" in turn; None for none.
        size: of these errors; None for each of `SIZES` in turn.
        report: called with (name, share done).

    Raises:
        ValueError: an unknown kind, or labels that would be in the folder that the diagnosis reads.
    """
    folder, labels = Path(folder), Path(labels)
    if labels.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"labels {labels} would be in the folder of the cases, {folder}; give another folder")
    if imperfections is None:
        draws = [ImperfectDraw(CLEAN, 1.0, k) for k in draw_kinds(n, seed, like=like, structure=structure)]
    else:
        draws = draw_imperfect_kinds(n, seed, imperfections=imperfections, size=size)
    if kinds is not None:
        check_kinds(kind for hidden in kinds for kind in hidden)  # one that is impossible on a bench is replaced
        draws = [draw._replace(kinds=tuple(hidden)) for draw, hidden in zip(draws, kinds, strict=True)]
    labelled = {}
    for i, draw in enumerate(draws):
        name, rng = f"case-{i + 1:03d}", np.random.default_rng([seed, i])
        barred = INDISTINGUISHABLE[draw.imperfections] | NOT_ON[structure] | {"truncated_modes"}
        how = {"others": [k for k in COMMON_KINDS if k not in barred], "tries": MOST_SEEDS, **draw._asdict()}
        case, labelled[name], _ = find_trial_with_plant(rng, like=like, structure=structure, name=name, **how)
        write_case(case, folder / name)
        report(name, (i + 1) / n)
    labels.parent.mkdir(parents=True, exist_ok=True)
    labels.write_text(json.dumps(labelled, indent=1, allow_nan=False) + "\n", encoding="utf-8")


@former_fields(tally="statistics")
@dataclass(frozen=True, eq=False)
class Trials:
    """The results of blind trials.

    Attributes:
        verdicts, labels, scores: by case, as JSON.
        imperfect_scores: by case, see `score_imperfect`; empty without imperfections.
        statistics: of all scores.
    """

    verdicts: dict[str, dict[str, Any]]
    labels: dict[str, dict[str, Any]]
    scores: dict[str, dict[str, Any]]
    imperfect_scores: dict[str, dict[str, Any]]
    statistics: Statistics


def verdict_on(folder: Path) -> dict[str, Any]:
    """The verdict on a case folder, as JSON, by one process."""
    return diagnose_case(read_case(folder), workers=1).to_json()


def hold_trials(
    n: int,
    seed: int,
    *,
    diagnose_case: Callable[[Path], dict[str, Any]] | None = None,
    report: Callable[[str, float], None] = lambda text, share: None,
    **hidden: Any,
) -> Trials:
    """Make n blind cases, diagnose each, and then score the verdicts by the labels.

    The labels are read into memory and their file is deleted before the first diagnosis; the folder of a diagnosis
    contains no labels.

    Args:
        diagnose_case: folder -> verdict as JSON; None for the diagnosis of this package.
        report: called with (text, share done).
        hidden: `like`, `structure`, `kinds`, `imperfections` and `size` of `write_trials`.
    """
    with TemporaryDirectory() as cases, TemporaryDirectory() as vault:
        sealed = Path(vault) / "labels.json"
        write_trials(cases, sealed, n, seed, report=lambda text, share: report(f"making {text}", 0.1 * share), **hidden)
        labels = json.loads(sealed.read_text(encoding="utf-8"))
        sealed.unlink()
        verdicts, scores, imperfect = {}, {}, {}
        folders = sorted(Path(cases).iterdir())
        for i, folder in enumerate(folders):
            verdicts[folder.name] = (diagnose_case or verdict_on)(folder)
            report(f"diagnosed {folder.name}", 0.1 + 0.9 * (i + 1) / n)
        for folder in folders:
            pair, domain = (verdicts[folder.name], labels[folder.name]), read_case(folder).rig.modes.domain
            scores[folder.name] = score(*pair, domain=domain)
            if hidden.get("imperfections") is not None:
                imperfect[folder.name] = score_imperfect(*pair, domain=domain)
    return Trials(verdicts, labels, scores, imperfect, statistics(scores.values()))


def hold_one(seed: int, kinds: Sequence[str], **hidden: Any) -> dict[str, Any]:
    """The result of one blind trial: {"score", "sentence" of its verdict, "processor": processor time, s}."""
    begun = process_time()
    held = hold_trials(1, seed, kinds=[kinds], **hidden)
    (found,), (verdict,) = (held.imperfect_scores or held.scores).values(), held.verdicts.values()
    return {"score": found, "sentence": verdict["sentence"], "processor": process_time() - begun}


def processor_times(trials: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Median, ninth decile and maximum of the processor times of `hold_one`, s."""
    times = np.quantile([trial["processor"] for trial in trials], (0.5, 0.9, 1.0)).round(1).tolist()
    return dict(zip(("median", "nine of ten", "longest"), times, strict=True))
