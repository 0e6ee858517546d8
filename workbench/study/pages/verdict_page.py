"""The page of a diagnosis."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.case import Case
from workbench.draw.gap import plot_budget, plot_responses, plot_single_effects, plot_unmodelled_force, plot_where
from workbench.draw.motion import ALONG, mode_motion
from workbench.draw.spectra import plot_distortion
from workbench.gap.effects.catalogue import in_words
from workbench.gap.effects.effect import label_in_words
from workbench.gap.effects.nonlinear import BEYOND
from workbench.gap.report.verdict import Verdict
from workbench.identification.signal.distortion import Distortion, distortion_of
from workbench.records.record import Record
from workbench.rig.rig import Rig
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes
from workbench.study.pages.page import PageContent, Table, block, to_its_error, write_page

MOVING = (
    "The modes of the nominal model, and of the corrected one where it differs; circles are sensors, triangles inputs."
)

STANDING_OF = {"none": "good", "explained": "good", "part": "part", "unknown": "bad"}  # by outcome


def verdict_page(verdict: Verdict, case: Case, path: Path, *, folder: Path | None = None, made_by: str = "") -> Path:
    """Write the page: the verdict, measured beside nominal and corrected, where, the unmodelled force, the rivals.

    Args:
        verdict: of the diagnosis.
        case: that was diagnosed.
        path: of the HTML file.
        folder: that the case was read from, so that the page can say what it was.
        made_by: the command that makes the page again; of the case alone unless given.
    """
    nominal, corrected = verdict.nominal.modes, verdict.corrected.modes
    changed = nominal.n_modes != corrected.n_modes or not np.allclose(nominal.omega, corrected.omega, rtol=1e-6)
    records = (*case.fit, *case.validation)
    better = verdict.shrinkage is None or verdict.shrinkage.overall > 0
    rigs, fitted = {"nominal": verdict.nominal}, "corrected" if verdict.outcome == "explained" else "nearest"
    if verdict.outcome != "none" and better:  # what makes the gap larger corrects nothing
        rigs[fitted] = verdict.corrected
    figures = [
        (
            plot_budget(verdict.budget),
            "What causes the gap: the power of the nominal residual, split by cause, on"
            + (" the validation records." if case.validation else " the records that were fitted."),
        ),
        (
            plot_responses(rigs, records, time_unit=verdict.units.time),
            f"Measured and simulated response ({', '.join(rigs)}) where they differ most. Nothing was fitted"
            " to the validation records.",
        ),
    ]
    if verdict.shows_gap:  # there is nothing to take apart in noise
        figures += [
            (
                plot_where(verdict),
                "Where the gap is: its power above the noise, by sensor, mode and record; and the likelihood of a"
                " single unknown force at each place, no law assumed.",
            ),
        ]
        acting = any(effect.at is not None and effect.kind.path == "structure" for effect in verdict.effects)
        if acting or verdict.where.place.is_single_force is not False:  # else a force there is what no force is
            made = "The unmodelled force reconstructed from the records, over the motion at its place."
            figures.append((plot_unmodelled_force(verdict), made))
        if verdict.attribution.singles:  # none were tried where errors of the model were fitted from the first
            each = "Residual with each effect alone, without errors of the model: at the noise floor, it explains all."
            figures.append((plot_single_effects(verdict), each))
    distortions = _of_lowest_and_highest(records)
    if distortions:
        seen = (
            "Spectra before any model: excited lines, odd and even ones that are not excited, and noise."
            + " Only odd lines are excited, so even ones reveal an even nonlinearity."
            * all(d.parity_resolved for d in distortions)
        )
        figures.append((plot_distortion(distortions), seen))
    moving = moving_modes(
        verdict.nominal,
        {"nominal": nominal, **({fitted: corrected} if changed and fitted in rigs else {})},
        length=verdict.units.length,
    )
    page_content = PageContent(
        title=f"Diagnosis of {verdict.case}",
        lead=verdict.sentence,
        standing=STANDING_OF[verdict.outcome],
        lines=[*verdict.notes, *([verdict.experiment.sentence] if verdict.experiment else []), _could_show(verdict)],
        blocks=[
            *(block(figure, caption) for figure, caption in figures),
            *(moving if verdict.shows_gap else []),
        ],
        tables=verdict_tables(verdict.to_json()),
        inputs={} if folder is None else case_inputs(folder),
        made_by=made_by or f"workbench diagnose {folder or verdict.case}",
    )
    return write_page(path, page_content)


def verdict_tables(content: Mapping[str, Any]) -> list[Table]:
    """Effects, gaps and rivals of a verdict as JSON: those of these tables that have a row."""
    nearest = content.get("nearest", [])
    beyond = {kind.name for kind in BEYOND}.issuperset(effect["kind"] for effect in nearest)
    title = "Effects" if beyond else "Nearest effects: they do not explain the gap"
    effects = [
        [
            label_in_words(effect["kind"]),
            name.replace("_", " "),
            *to_its_error(value, effect.get("parameters_std", {}).get(name)),
            effect.get("at", ""),
            effect.get("input", effect.get("output", "")),
        ]
        for effect in [*content["effects"], *nearest]
        for name, value in effect["parameters"].items()
    ]
    gap, closed = content["gap"], content.get("shrinkage", {})
    length = content.get("units", {}).get("length", "m")
    gaps = [
        [record, *(_short(gap[name].get(record)) for name in ("before", "after", "floor")), _short(closed.get(record))]
        for record in gap["before"]
    ]
    rivals = [
        [rival.get("words") or in_words(rival["kind"]), rival["probability"]] for rival in content["alternatives"]
    ]
    if rivals and content.get("probability") is not None:
        rivals.insert(0, ["the set named", content["probability"]])
    tables = [
        (title, ("effect", "parameter", "value", "standard error", f"x [{length}]", "input or output"), effects),
        ("Gap (rms error / rms signal)", ("record", "before", "after", "floor", "share closed"), gaps),
        ("Alternatives that the records do not exclude", ("set of effects", "probability"), rivals),
    ]
    return [table for table in tables if table[2]]


def _short(number: float | None) -> float | str:
    """To four digits; "" where there is none."""
    return "" if number is None else float(f"{number:.4g}")


def _of_lowest_and_highest(records: Sequence[Record]) -> list[Distortion]:
    """Distortion of the records of least and of largest excitation, where it repeats."""
    found = []
    for record in records:
        with suppress(ValueError):  # excitation that does not repeat shows none
            found.append(distortion_of(record))
    found.sort(key=lambda each: each.input_rms)
    return found if len(found) < 2 else [found[0], found[-1]]


def moving_modes(rig: Rig, modes: Mapping[str, Modes], *, length: str = "m") -> list[dict[str, Any]]:
    """A block of modes that move, where they are known all over a structure or at points with positions."""
    domain = rig.modes.domain
    placed = isinstance(domain, NamedPoints) and domain.positions is not None and len(set(domain.nodes)) > 2
    if not placed and (rig.structure is None or isinstance(domain, NamedPoints)):
        return []
    motion = mode_motion(modes, actuators=rig.actuators, sensors=rig.sensors)
    if motion.get("label") == ALONG:
        motion["label"] = f"x [{length}]"
    return [block(motion, MOVING)]


def case_inputs(folder: Path) -> dict[str, str]:
    """What a case was read from: its description, and checksums of its records."""
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.name != "case.toml")
    digests = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.relative_to(folder)}" for file in files]
    text = (folder / "case.toml").read_text(encoding="utf-8")
    return {f"{folder.name}/case.toml": text, "records (SHA-256)": "\n".join(digests)}


def _could_show(verdict: Verdict) -> str:
    """What the records can and cannot show, in a line."""
    hidden, alike = verdict.detectability.undetectable, verdict.detectability.indistinguishable
    count = len(verdict.detectability.strengths)
    text = f"Before any fit: these records can show {f'all but {len(hidden)} of' if hidden else 'all'} {count} effects"
    if hidden:
        named = ", ".join(map(label_in_words, hidden[:6]))
        text += f" (not {named}{', …' if len(hidden) > 6 else ''})"
    if alike:
        one, other = map(label_in_words, alike[0][:2])
        text += f"; at small strength they cannot distinguish {one} from {other}"
        more = len(alike) - 1
        text += f", nor {more} more {'pair' if more == 1 else 'pairs'}" if more else ""
    return text + "."
