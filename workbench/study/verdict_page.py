"""The page of a diagnosis."""

from io import BytesIO
from pathlib import Path

from workbench.draw.gap import plot_missing_force, plot_responses, plot_rivals, plot_where
from workbench.gap.case import Case
from workbench.gap.verdict import Verdict
from workbench.study.page import write_page


def verdict_page(verdict: Verdict, case: Case, path: Path) -> Path:
    """Write the page: the verdict, measured beside nominal and corrected, where, the missing force, the rivals."""
    shown = verdict.to_json()
    figures = [
        (
            plot_responses(verdict, (*case.fit, *case.validation)),
            "Measured, nominal and corrected response where they"
            " differ most. Validation records were not seen by any fit.",
        ),
        (
            plot_where(verdict),
            "Where the gap is. Its squared size above the noise, shared out; and how likely a single"
            " unknown force at each place would explain it, before any effect is guessed.",
        ),
        (plot_missing_force(verdict), "The missing force as the records tell it, against the motion at its place."),
        (plot_rivals(verdict), "What each effect alone leaves of the gap: at the noise floor, it explains all of it."),
    ]
    gaps = [
        (name, before, shown["gap"]["after"][name], shown["gap"]["floor"][name], shown["shrinkage"].get(name))
        for name, before in shown["gap"]["before"].items()
    ]
    effects = [
        (
            effect["kind"],
            name,
            value,
            effect.get("parameters_std", {}).get(name, ""),
            effect.get("at", ""),
            effect.get("input", effect.get("output", "")),
        )
        for effect in (
            shown["effects"] if shown["effects"] and shown["effects"][0]["kind"] != "unknown" else shown["nearest"]
        )
        for name, value in effect["parameters"].items()
    ]
    rivals = [(r["kind"], r["probability"]) for r in shown["alternatives"]]
    tables = [
        ("Gap on records kept out of the fit", ("record", "before", "after", "floor", "share closed"), gaps),
        ("Effects", ("effect", "parameter", "value", "standard deviation", "x", "input or output"), effects),
        ("Rivals", ("set of effects", "probability"), rivals),
    ]
    return write_page(
        path,
        title=f"Diagnosis of {verdict.case}",
        lead=verdict.sentence,
        lines=[*verdict.notes, *([verdict.experiment.sentence] if verdict.experiment else []), _could_show(verdict)],
        figures=[(_png(figure), caption) for figure, caption in figures],
        tables=[table for table in tables if table[2]],
        made_by=f"workbench diagnose {verdict.case}",
    )


def _png(figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _could_show(verdict: Verdict) -> str:
    """What the records could and could not tell, in a line."""
    hidden, alike = verdict.readiness.invisible, verdict.readiness.alike
    text = (
        f"Before any fit: these records could show all but {len(hidden)} of {len(verdict.readiness.strengths)} effects"
    )
    if hidden:
        text += f" (not {', '.join(hidden[:6])}{', …' if len(hidden) > 6 else ''})"
    if alike:
        text += f"; at small strength they could not tell {alike[0][0]} from {alike[0][1]}"
        text += f", nor {len(alike) - 1} pairs more" if len(alike) > 1 else ""
    return text + "."
