"""Scoring: verdicts against the labels of blind trials."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations

NONE, UNKNOWN = "none", "unknown"
NEAR = 0.02  # of the length: how far off a place may be


@dataclass(frozen=True)
class Tally:
    """How a set of verdicts fared.

    Attributes:
        counts: (hidden, told) -> how many cases, each a set of kinds joined by " + ".
        shares: of the cases that were named rightly: "single", "pair", "none", "unknown" -> (right, of).
        misplaced: places told more than 2 % of the length off, of `placed` places.
        placed: how many effects at a point were named.
    """

    counts: dict[tuple[str, str], int]
    shares: dict[str, tuple[int, int]]
    misplaced: int
    placed: int


def score(
    verdict: dict, label: dict, *, length: float, inputs: Sequence[str] = (), outputs: Sequence[str] = ()
) -> dict:
    """How a verdict (as JSON) agrees with a label.

    Args:
        length: of the structure; places count as right within 2 % of it.
        inputs, outputs: names in order, needed where a label counts them from zero.

    Returns:
        {"hidden", "told": sets of kinds in words; "family": single, pair, none or unknown; "kinds": right;
        "channels": inputs and outputs right, None without any; "position_errors": shares of the length;
        "positions": right, None without any; "shrinkage": by validation record}.
    """
    hidden = [e for e in label["effects"] if e["kind"] != NONE]
    told = verdict["effects"]
    kinds = sorted(e["kind"] for e in hidden) == sorted(e["kind"] for e in told)
    pairs = _matched(hidden, told, length) if kinds else []
    channels = [_same_channel(h, t, inputs, outputs) for h, t in pairs if "input" in h or "output" in h]
    errors = [abs(h["at"] - t["at"]) / length for h, t in pairs if "at" in h and t.get("at") is not None]
    return {
        "hidden": _words(hidden),
        "told": _words(told),
        "family": _family(hidden),
        "kinds": kinds,
        "channels": all(channels) if channels else None,
        "position_errors": errors,
        "positions": max(errors) <= NEAR if errors else None,
        "shrinkage": {k: v for k, v in verdict.get("shrinkage", {}).items() if k != "ci95"},
    }


def tally(scores: Iterable[dict]) -> Tally:
    """Count scores into a confusion matrix and shares."""
    counts: Counter[tuple[str, str]] = Counter()
    right: Counter[str] = Counter()
    total: Counter[str] = Counter()
    misplaced = placed = 0
    for one in scores:
        counts[one["hidden"], one["told"]] += 1
        total[one["family"]] += 1
        right[one["family"]] += one["kinds"]
        misplaced += sum(error > NEAR for error in one["position_errors"])
        placed += len(one["position_errors"])
    shares = {family: (right[family], total[family]) for family in ("single", "pair", NONE, UNKNOWN) if total[family]}
    return Tally(dict(counts), shares, misplaced, placed)


def _family(hidden: list[dict]) -> str:
    if not hidden:
        return NONE
    if any(e["kind"] == UNKNOWN for e in hidden):
        return UNKNOWN
    return "single" if len(hidden) == 1 else "pair"


def _words(effects: list[dict]) -> str:
    return " + ".join(sorted(e["kind"] for e in effects)) or NONE


def _matched(hidden: list[dict], told: list[dict], length: float) -> list[tuple[dict, dict]]:
    """Hidden and told effects of one kind side by side, two of a kind by their places."""

    def cost(order: Iterable[dict]) -> float:
        pairs = list(zip(hidden, order, strict=True))
        if any(h["kind"] != t["kind"] for h, t in pairs):
            return float("inf")
        return sum(abs(h["at"] - t["at"]) / length for h, t in pairs if "at" in h and t.get("at") is not None)

    return list(zip(hidden, min(permutations(told), key=cost), strict=True)) if hidden else []


def _same_channel(hidden: dict, told: dict, inputs: Sequence[str], outputs: Sequence[str]) -> bool:
    for side, names in (("input", inputs), ("output", outputs)):
        if side in hidden:
            name = hidden[side]
            return (names[name] if isinstance(name, int) else name) == told.get(side)
    return True
