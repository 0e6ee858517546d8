"""Holding blind trials: make cases with sealed labels, diagnose them, score them."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from workbench.cases.case import read_case
from workbench.gap.diagnose import diagnose_case
from workbench.trials.make import write_trials
from workbench.trials.scoring import Tally, score, score_imperfect, tally


@dataclass(frozen=True, eq=False)
class Trials:
    """The results of blind trials.

    Attributes:
        verdicts: by case, as JSON.
        labels: by case.
        scores: by case.
        imperfect_scores: by case, see `score_imperfect`; empty without imperfections.
        tally: of all scores.
    """

    verdicts: dict[str, dict[str, Any]]
    labels: dict[str, dict[str, Any]]
    scores: dict[str, dict[str, Any]]
    imperfect_scores: dict[str, dict[str, Any]]
    tally: Tally


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
            domain = read_case(folder).rig.modes.domain
            verdict, label = verdicts[folder.name], labels[folder.name]
            scores[folder.name] = score(verdict, label, domain=domain)
            if hidden.get("imperfections") is not None:
                imperfect[folder.name] = score_imperfect(verdict, label, domain=domain)
    return Trials(verdicts, labels, scores, imperfect, tally(scores.values()))


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


def verdict_on(folder: Path) -> dict[str, Any]:
    """The verdict on a case folder, as JSON, by one process."""
    case = read_case(folder)
    verdict = diagnose_case(case, workers=1)
    return verdict.to_json()
