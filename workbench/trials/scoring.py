"""Scores of verdicts by the labels of blind trials."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from workbench.structure.domain import Domain, NamedPoints, as_domain
from workbench.trials.hidden import NONE, UNKNOWN, place_of

NEAR = 0.02  # largest error of a place that counts as right, over the length
NEAR_IF_IMPERFECT = 0.03  # the same for trials with imperfections
HONEST = 0.05  # largest error of the unexplained share of a budget that counts as right
NORMAL_95 = 1.96  # standard deviations on each side of a 95 % interval
# kinds outside every catalogue when trials were sealed, and the effects that they have since become
NAMED_SINCE = {"cross_talk": "actuator_crosstalk"}
BINS = 5  # of a reliability diagram, of equal width
FAMILIES = ("single", "pair", NONE, UNKNOWN)


class Reliability(NamedTuple):
    """Claims in one range of probability: their mean probability, the share that is right, and their number."""

    probability: float
    right: float
    claims: int


@dataclass(frozen=True)
class Statistics:
    """Statistics of a set of verdicts.

    Attributes:
        counts: confusion matrix, (hidden, named) -> number of cases; each a set of kinds joined by " + ".
        shares: number of right verdicts by family, "single", "pair", "none", "unknown" -> (right, of).
        misplaced: number of places with an error above 2 % of the length.
        placed: number of effects with a place that were named.
    """

    counts: dict[tuple[str, str], int]
    shares: dict[str, tuple[int, int]]
    misplaced: int
    placed: int


def score(
    verdict: dict[str, Any],
    label: dict[str, Any],
    *,
    domain: Domain | float,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
) -> dict[str, Any]:
    """The agreement of a verdict (as JSON) with a label.

    Args:
        domain: of the structure, or its length; a place is right within 2 % of the length or diagonal, a named point
            only exactly.
        inputs, outputs: names in order, needed if a label has indices from zero.

    Returns:
        {"hidden", "diagnosed": sets of kinds as text; "family": single, pair, none or unknown; "kinds": whether right,
        of an effect outside the catalogue that has since entered it also by its name;
        "channels": whether inputs and outputs are right, None without any; "position_errors": over the length or
        diagonal, 1 for another named point; "positions": whether right, None without any; "shrinkage": by validation
        record}.
    """
    hidden = _hidden(label, inputs, outputs)
    named = verdict["effects"]
    since = [NAMED_SINCE.get(e.get("outside", ""), e["kind"]) for e in hidden]
    kinds = sorted(e["kind"] for e in named) in (sorted(e["kind"] for e in hidden), sorted(since))
    pairs = [(hidden[i], named[j]) for i, j in sorted(_pairs(hidden, named, domain))] if kinds else []
    channels = [_same_channel(h, t) for h, t in pairs if "input" in h or "output" in h]
    errors = _position_errors(pairs, domain)
    return {
        "hidden": _words(hidden),
        "diagnosed": _words(named),
        "family": _family(hidden),
        "kinds": kinds,
        "channels": all(channels) if channels else None,
        "position_errors": errors,
        "positions": max(errors) <= NEAR if errors else None,
        "shrinkage": {k: v for k, v in verdict.get("shrinkage", {}).items() if k != "ci95"},
    }


def score_imperfect(
    verdict: dict[str, Any],
    label: dict[str, Any],
    *,
    domain: Domain | float,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
) -> dict[str, Any]:
    """The agreement of a verdict (as JSON) with the label of a trial with imperfections.

    The arguments are those of `score`; a place is right within 3 % of the length or diagonal.

    Returns:
        {"class", "size": of the imperfections; "hidden", "diagnosed": sets of kinds as text;
        "named": whether exactly the hidden effects are named, with right channels and places; of three effects, two
        suffice if the budget states an unexplained share;
        "wrong": whether a kind or channel is named that is not hidden; "false_alarm": the same if nothing is hidden;
        "position_errors": of the effects named rightly, over the length;
        "covered": (inside their 95 % interval, of) of the parameters and places of those effects;
        "budget_error": of the unexplained share; None without a budget, or unless exactly the hidden effects are named;
        "claims": (probability, whether right) of the named set and of each alternative, if effects explain the gap; an
        alternative is right if it has the hidden kinds}.
    """
    hidden = [e for e in _hidden(label, inputs, outputs) if e["kind"] != UNKNOWN]
    named = [e for e in verdict["effects"] if e["kind"] != UNKNOWN]
    pairs = [(hidden[i], named[j]) for i, j in _pairs(hidden, named, domain) if _same_channel(hidden[i], named[j])]
    errors = _position_errors(pairs, domain)
    covered = [inside for h, t in pairs for inside in _inside(h, t)]
    budget = verdict.get("budget", {}).get("unexplained")
    complete = len(pairs) == len(hidden) == len(named)
    off = None if budget is None or not complete else abs(budget - label["budget"]["unexplained"])
    placed = all(error <= NEAR_IF_IMPERFECT for error in errors)
    in_part = len(hidden) == 3 and len(pairs) == len(named) == 2 and budget is not None and budget > HONEST
    return {
        "class": label.get("class", ""),
        "size": label.get("size", 1.0),
        "hidden": _words(hidden),
        "diagnosed": _words(verdict["effects"]),
        "named": (complete or in_part) and placed and len(named) == len(verdict["effects"]),
        "wrong": len(pairs) < len(named),
        "false_alarm": not hidden and bool(named),
        "position_errors": errors,
        "covered": (sum(covered), len(covered)),
        "budget_error": off,
        "claims": _claims(verdict, label, complete) if named and verdict.get("outcome") == "explained" else [],
    }


def _claims(verdict: dict[str, Any], label: dict[str, Any], complete: bool) -> list[tuple[float, bool]]:
    kinds = _words(label["effects"])
    others = [
        (o["probability"], " + ".join(sorted(one.split("[")[0] for one in o["kind"].split(" + "))) == kinds)
        for o in verdict.get("alternatives", [])
    ]
    return [(1.0 - sum(p for p, _ in others), complete), *others]


def reliability(scores: Iterable[dict[str, Any]]) -> list[Reliability]:
    """The points of a reliability diagram (Murphy & Winkler, Applied Statistics 26 (1977) 41).

    One for each of five equal ranges of probability that has any claims.
    """
    claims = np.array([claim for s in scores for claim in s["claims"]], float).reshape(-1, 2)
    ranges = np.minimum((claims[:, 0] * BINS).astype(int), BINS - 1)
    groups = (claims[ranges == k].T for k in range(BINS))
    return [Reliability(float(p.mean()), float(right.mean()), p.size) for p, right in groups if p.size]


def imperfect_statistics(scores: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Shares over many scores of `score_imperfect`.

    Returns:
        {"cases", "named", "wrong", "false_alarms" (a count), "placed" within 3 %, "covered" by 95 % intervals,
        "honest" budgets (within 0.05)}; NaN for shares of none.
    """
    scores = list(scores)
    hiding = [s for s in scores if s["hidden"] != NONE]
    errors = [e for s in hiding for e in s["position_errors"]]
    inside, of = np.sum([s["covered"] for s in hiding] or [(0, 0)], axis=0)
    budgets = [s["budget_error"] for s in scores if s["budget_error"] is not None]
    return {
        "cases": float(len(scores)),
        "named": _share([s["named"] for s in hiding]),
        "wrong": _share([s["wrong"] for s in scores]),
        "false_alarms": float(sum(s["false_alarm"] for s in scores)),
        "placed": _share([e <= NEAR_IF_IMPERFECT for e in errors]),
        "covered": float(inside / of) if of else float("nan"),
        "honest": _share([b <= HONEST for b in budgets]),
    }


def _share(flags: Sequence[bool]) -> float:
    return float(np.mean(flags)) if flags else float("nan")


def _hidden(label: dict[str, Any], inputs: Sequence[str], outputs: Sequence[str]) -> list[dict[str, Any]]:
    """The hidden effects of a label, with the names of their channels for indices."""
    names = {"input": inputs, "output": outputs}
    return [
        {key: names[key][item] if key in names and isinstance(item, int) else item for key, item in effect.items()}
        for effect in label["effects"]
        if effect["kind"] != NONE
    ]


def _pairs(hidden: list[dict[str, Any]], named: list[dict[str, Any]], domain: Domain | float) -> list[tuple[int, int]]:
    """Indices of a hidden and a named effect of the same kind, each used once: same channels first, then nearest."""
    alike = [
        (not _same_channel(h, t), sum(_position_errors([(h, t)], domain)), i, j)
        for i, h in enumerate(hidden)
        for j, t in enumerate(named)
        if h["kind"] == t["kind"]
    ]
    pairs: list[tuple[int, int]] = []
    for _, _, i, j in sorted(alike):
        if all(i != k and j != m for k, m in pairs):
            pairs.append((i, j))
    return pairs


def _position_errors(pairs: Iterable[tuple[dict[str, Any], dict[str, Any]]], domain: Domain | float) -> list[float]:
    """The errors of the named places, over the length or diagonal; 1 for another named point.

    A mass acts in all directions of its node, so that any point of the node is right.
    """
    points, errors = as_domain(domain), []
    for hidden, named in pairs:
        one, other = place_of(hidden), place_of(named)
        if one is None or other is None:
            continue
        if isinstance(points, NamedPoints) and hidden["kind"] == "point_mass":
            errors.append(float(not set(points.translations(one)) & set(points.translations(other))))
        else:
            errors.append(points.separation(one, other))
    return errors


def _inside(hidden: dict[str, Any], named: dict[str, Any]) -> Iterable[bool]:
    """Whether the truth is inside the 95 % interval, for each parameter with a standard deviation."""
    deviations = {**named.get("parameters_std", {}), "at": named.get("at_std")}
    values = {**named.get("parameters", {}), "at": named.get("at")}
    for name, deviation in deviations.items():
        if deviation and name in hidden and values.get(name) is not None:
            off = np.atleast_1d(values[name]) - np.atleast_1d(hidden[name])
            if name == "phase":
                off = (off + np.pi) % (2.0 * np.pi) - np.pi
            yield from map(bool, np.abs(off) <= NORMAL_95 * np.atleast_1d(deviation))


def statistics(scores: Iterable[dict[str, Any]]) -> Statistics:
    """The confusion matrix and shares of a set of scores."""
    scores = list(scores)
    counts = Counter((one["hidden"], one["diagnosed"]) for one in scores)
    right = {family: [s["kinds"] for s in scores if s["family"] == family] for family in FAMILIES}
    shares = {family: (sum(kinds), len(kinds)) for family, kinds in right.items() if kinds}
    errors = [error for one in scores for error in one["position_errors"]]
    return Statistics(dict(counts), shares, sum(error > NEAR for error in errors), len(errors))


def _family(hidden: list[dict[str, Any]]) -> str:
    if not hidden:
        return NONE
    if any(e["kind"] == UNKNOWN for e in hidden):
        return UNKNOWN
    return "single" if len(hidden) == 1 else "pair"


def _words(effects: list[dict[str, Any]]) -> str:
    return " + ".join(sorted(e["kind"] for e in effects)) or NONE


def _same_channel(hidden: dict[str, Any], named: dict[str, Any]) -> bool:
    for side in ("input", "output"):
        if side in hidden:
            channels = {named.get(side), named.get("with")} == {hidden[side], hidden.get("with")}
            return channels and hidden.get("from") == named.get("from")
    return True
