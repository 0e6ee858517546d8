"""The page of a diagnosis."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from workbench.cases.case import Case, files_of
from workbench.draw.gap import plot_budget, plot_responses, plot_single_effects, plot_unmodelled_force, plot_where
from workbench.draw.motion import ALONG, mode_motion
from workbench.draw.signals import plot_distortion
from workbench.gap.effects.catalogue import in_words
from workbench.gap.effects.effect import label_in_words
from workbench.gap.effects.nonlinear import BEYOND
from workbench.gap.report.verdict import Verdict, rest_in_words
from workbench.identification.signal.distortion import Distortion, distortion_of
from workbench.records.record import Record
from workbench.records.units import SI, Units
from workbench.rig.rig import Rig
from workbench.structure.domain import NamedPoints
from workbench.structure.modes import Modes
from workbench.structure.printed import counted
from workbench.study.pages.page import PageContent, Table, block, short, to_its_error, write_page

MOVING = "Modes of the nominal model, and of the corrected one where it differs; circles are sensors, triangles inputs."
GAPS = {"before": "before [%]", "after": "after [%]", "floor": "noise floor [%]"}
STANDING_OF = {"none": "good", "explained": "good", "part": "part", "unknown": "bad"}  # by outcome


def verdict_page(verdict: Verdict, case: Case, path: Path, *, folder: Path | None, made_by: str) -> Path:
    """Write the page; the files of a case folder are listed on it, those of a case from records alone are not."""
    nominal, corrected = verdict.nominal.modes, verdict.corrected.modes
    changed = nominal.n_modes != corrected.n_modes or not np.allclose(nominal.omega, corrected.omega, rtol=1e-6)
    records = (*case.fit, *case.validation)
    better = verdict.shrinkage is None or verdict.shrinkage.overall > 0
    rigs, fitted = {"nominal": verdict.nominal}, "corrected" if verdict.outcome == "explained" else "best fit"
    if verdict.outcome != "none" and better:  # a model that makes the gap larger is not a correction
        rigs[fitted] = verdict.corrected
    split = "What causes the gap: the power of the nominal residual, split by cause, on the"
    split += " validation records." if case.validation else " records that were fitted."
    beside = f"Measured and simulated response ({', '.join(rigs)}) where they differ most. Nothing was fitted to the"
    responses = plot_responses(rigs, records, time_unit=verdict.units.time)
    blocks = [block(plot_budget(verdict.budget), split), block(responses, f"{beside} validation records.")]
    if verdict.shows_gap:  # without a gap the residual is noise, and has no place
        where = (
            "Where the gap is: its power above the noise, by sensor, mode and record; and the likelihood of a single"
            " unknown force at each place, without an assumed law."
        )
        blocks.append(block(plot_where(verdict), where))
        acting = any(effect.at is not None and effect.kind.path == "structure" for effect in verdict.effects)
        if acting or verdict.where.place.is_single_force is not False:  # else a single force explains nothing
            made = "The unmodelled force reconstructed from the records, over the motion at its place."
            blocks.append(block(plot_unmodelled_force(verdict), made))
        if verdict.attribution.singles:  # single effects are not fitted if model errors were fitted from the start
            each = f"Residual of the best fit of each effect {verdict.attribution.fitted_with}, without model errors;"
            blocks.append(block(plot_single_effects(verdict), f"{each} an effect at the noise floor explains all."))
    distortions = _of_lowest_and_highest(records)
    if distortions:
        seen = "Spectra of the records: excited lines, odd and even lines that are not excited, and noise."
        if all(d.parity_resolved for d in distortions):
            seen += " Only odd lines are excited, so even ones reveal an even nonlinearity."
        blocks.append(block(plot_distortion(distortions, verdict.units), seen))
    if verdict.shows_gap:
        modes = {"nominal": nominal, **({fitted: corrected} if changed and fitted in rigs else {})}
        blocks += moving_modes(verdict.nominal, modes, units=verdict.units)
    page_content = PageContent(
        title=f"Diagnosis of {verdict.case}",
        lead=verdict.sentence,
        standing=STANDING_OF[verdict.outcome],
        lines=[*verdict.notes, *([verdict.experiment.sentence] if verdict.experiment else []), _could_show(verdict)],
        blocks=blocks,
        tables=verdict_tables(verdict.to_json()),
        inputs={} if folder is None else case_inputs(folder),
        made_by=made_by,
    )
    return write_page(path, page_content)


def verdict_tables(content: Mapping[str, Any]) -> list[Table]:
    """The tables of effects, gaps and alternatives of a verdict as JSON; tables without rows are omitted."""
    best_fit = content.get("best_fit", content.get("nearest", []))  # the name in files of earlier versions
    beyond = {kind.name for kind in BEYOND}.issuperset(effect["kind"] for effect in best_fit)
    title = "Effects" if beyond else "Best-fitting effects: they do not explain the gap"
    effects = []
    for effect in [*content["effects"], *best_fit]:
        words, channel = label_in_words(effect["kind"]), effect.get("input", effect.get("output", ""))
        for name in effect["parameters"]:
            effects.append([words, name.replace("_", " "), *_in_its_unit(effect, name), _place(effect), channel])
    gap, closed = content["gap"], content.get("shrinkage", {})
    length = content.get("units", {}).get("length", "m")
    gaps = [
        [record, *(_in_percent(gap[name].get(record)) for name in GAPS), _in_percent(closed.get(record))]
        for record in gap["before"]
    ]
    heads = ["record", *GAPS.values(), "reduction of the rms [%]"]
    rests = [rest_in_words(gap, record) for record in gap["before"]]
    if any(rests):
        heads.append("cause of the residual")
        gaps = [[*row, rest] for row, rest in zip(gaps, rests, strict=True)]
    alternatives = [[one.get("words") or in_words(one["kind"]), one["probability"]] for one in content["alternatives"]]
    if alternatives and content.get("probability") is not None:
        alternatives.insert(0, ["selected set", content["probability"]])
    of_effects = ("effect", "parameter", "value", "standard deviation", f"position [{length}]", "input or output")
    tables = [
        (title, of_effects, effects),
        ("Gap: rms error / rms signal", heads, gaps),
        ("Alternatives that the records do not exclude", ("set of effects", "probability"), alternatives),
    ]
    return [table for table in tables if table[2]]


def _in_its_unit(effect: Mapping[str, Any], name: str) -> list[str]:
    """The value and the standard deviation of a parameter with their unit, to the digits of the deviation."""
    value, deviation = _to_its_error(effect["parameters"][name], effect.get("parameters_std", {}).get(name))
    unit = effect.get("parameters_unit", {}).get(name, "")
    return [f"{number} {unit}".strip() if number else "" for number in (value, deviation)]


def _place(effect: Mapping[str, Any]) -> str:
    """The place of an effect with its standard deviation: 6.40 ± 0.01; (0.63 ± 0.01, 0.72 ± 0.01); a name or two."""
    if "between" in effect:
        return " to ".join(effect["between"])
    at, error = effect.get("at", ""), effect.get("at_std")
    is_pair = isinstance(at, list)
    pairs = zip(at, error if isinstance(error, list) else [error] * len(at), strict=True) if is_pair else [(at, error)]
    texts = [" ± ".join(filter(None, _to_its_error(value, std))) for value, std in pairs]
    return f"({', '.join(texts)})" if is_pair else texts[0]


def _to_its_error(value: object, error: object) -> tuple[str, str]:
    """As `to_its_error`; to four digits, without an error, where that is not known or zero."""
    if isinstance(error, int | float) and error > 0:
        value, error = to_its_error(value, error)
        return str(value), str(error)
    return (f"{value:.4g}" if isinstance(value, float) else str(value)), ""


def _in_percent(share: float | None) -> float | str:
    return short(None if share is None else 100.0 * share)


def _of_lowest_and_highest(records: Sequence[Record]) -> list[Distortion]:
    """Distortion of the records with the least and the largest periodic excitation; empty if none is periodic."""
    found = []
    for record in records:
        with suppress(ValueError):  # not periodic
            found.append(distortion_of(record))
    found.sort(key=lambda each: each.input_rms)
    return found if len(found) < 2 else [found[0], found[-1]]


def moving_modes(rig: Rig, modes: Mapping[str, Modes], *, units: Units = SI) -> list[dict[str, Any]]:
    """A block of animated modes; none if their shapes are known only at points without positions."""
    domain = rig.modes.domain
    placed = isinstance(domain, NamedPoints) and domain.positions is not None and len(set(domain.nodes)) > 2
    if not placed and (rig.structure is None or isinstance(domain, NamedPoints)):
        return []
    frequency = units.named("Hz")
    motion = mode_motion(modes, actuators=rig.actuators, sensors=rig.sensors, frequency=frequency)
    if motion.get("label") == ALONG:
        motion["label"] = units.named(ALONG)
    return [block(motion, MOVING)]


def case_inputs(folder: Path) -> dict[str, str]:
    """The text of case.toml and checksums of the other files that the case reads, by title."""
    digests = [f"{hashlib.sha256(f.read_bytes()).hexdigest()}  {f.relative_to(folder)}" for f in files_of(folder)]
    text = (folder / "case.toml").read_text(encoding="utf-8")
    return {f"{folder.resolve().name}/case.toml": text, "files (SHA-256)": "\n".join(digests)}


def _could_show(verdict: Verdict) -> str:
    """A sentence on the effects that the records can and cannot show."""
    found = verdict.detectability
    hidden, alike, count = found.undetectable, found.indistinguishable, len(found.strengths)
    some = f"all but {len(hidden)} of" if hidden else "all"
    text = f"Detectability, before any fit: these records can show {some} {count} effects"
    if hidden:
        named = ", ".join(map(label_in_words, hidden[:6]))
        text += f" (not {named}{', …' if len(hidden) > 6 else ''})"
    if alike:
        one, other = map(label_in_words, alike[0][:2])
        text += f"; at small strength they cannot distinguish {one} from {other}"
        text += f", nor {counted(len(alike) - 1, 'more pair')}" if len(alike) > 1 else ""
    return text + "."
