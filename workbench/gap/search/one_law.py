"""Whether one force at a point, of a law that the catalogue does not hold, explains the records as effects do."""

from dataclasses import replace

from workbench.gap.effects.beyond import BEYOND, any_beyond, in_catalogue
from workbench.gap.localisation.evidence import Evidence
from workbench.gap.search.finish import finished, ranked
from workbench.gap.search.fit import Fit, cost_of, fit
from workbench.gap.search.search import Decision, Search
from workbench.gap.search.selection import on_whole_records, one_more
from workbench.gap.search.settings import LAW, SEARCH, SELECTION


def one_law(search: Search, evidence: Evidence) -> Fit | None:
    """The force that explains the records alone, of another law or by its power of the catalogue, or None.

    Two effects side by side bend to many a law between them, so it is sought before any two are believed.
    """
    search.report("one force of another law", 0.35)
    beyond = replace(search, catalogue=BEYOND)
    promising = [f for f in one_more(beyond, (), evidence) if f.cost < SELECTION.promising]
    fits = on_whole_records(beyond, promising, LAW.tried, to_cost=search.enough)
    return next((f for f in (_named(search, f) for f in fits) if search.explains(f)), None)


def _named(search: Search, law: Fit) -> Fit:
    """A force of another law; where its power is that of a kind of the catalogue, that kind fitted from there."""
    known = in_catalogue(law.effects[0])
    return law if known is None else finished(search, fit(search.rig, (known,), search.data))


def unless_another(search: Search, decision: Decision, evidence: Evidence) -> Decision:
    """The decision for one law of the catalogue at a point, or for another law where the records are sure of that one.

    Args:
        evidence: of the nominal rig.
    """
    best = decision.best
    if decision.outcome != "explained" or len(best.effects) != 1:
        return decision
    (effect,) = best.effects
    if not effect.kind.nonlinear or effect.at is None:
        return decision
    search.report("one force of another law", 0.9)
    beyond, there = replace(search, catalogue=BEYOND), evidence.of_force_at(effect.at)
    as_near = cost_of(search.rig, best.effects, search.ahead) + SEARCH.rival
    promising = [f for f in one_more(beyond, (), there) if f.cost < as_near]
    fits = on_whole_records(beyond, promising, LAW.tried, to_cost=search.enough)
    other = [f for f in fits if in_catalogue(f.effects[0]) is None]
    sure = (f for f in other if search.explains(f) and search.surely_better(f, best.cost, best.n_parameters))
    law = next(sure, None)
    return decision if law is None else compared_with(law, search, decision)


def compared_with(law: Fit, search: Search, decision: Decision) -> Decision:
    """What is claimed where one force of another law explains the records: the likelier of it and of the decision's."""
    named = [decision.best, *(f for f, _ in decision.rivals)] if decision.outcome == "explained" else []
    best, rivals = ranked(search, [law, *named])
    return Decision("unknown" if any_beyond(best.effects) else "explained", best, rivals=rivals)
