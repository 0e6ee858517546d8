"""The catalogue: every kind of effect that a diagnosis tries.

A kind of your own is another `Kind`, as in docs/how-to/own-effect.md: pass `(*CATALOGUE, mine)` to the diagnosis.
"""

from collections.abc import Iterable

from workbench.gap.effects.effect import Kind
from workbench.gap.effects.environment import KINDS as OF_THE_ENVIRONMENT
from workbench.gap.effects.nonlinear import KINDS as NONLINEAR
from workbench.gap.effects.structural import KINDS as STRUCTURAL
from workbench.gap.effects.transducers import KINDS as OF_TRANSDUCERS
from workbench.structure.printed import joined_in_words

CATALOGUE: tuple[Kind, ...] = (*STRUCTURAL, *NONLINEAR, *OF_TRANSDUCERS, *OF_THE_ENVIRONMENT)
"""Every kind of effect that a diagnosis tries, unless it is given others."""


def kind_named(name: str, catalogue: tuple[Kind, ...] = CATALOGUE) -> Kind:
    """The kind of that name.

    Raises:
        KeyError: a name that is not in the catalogue.
    """
    for kind in catalogue:
        if kind.name == name:
            return kind
    raise KeyError(f"no effect is called {name!r}; the catalogue has {', '.join(k.name for k in catalogue)}")


def in_words(labels: str, catalogue: Iterable[Kind] = CATALOGUE) -> str:
    """A set of labels in words, such as "Coulomb friction and a constant force of an actuator (F2)".

    Kinds beyond the catalogue have their own names.
    """
    phrases = {kind.name: kind.words for kind in catalogue}
    words = []
    for label in labels.split(" + "):
        name, _, target = label.removesuffix("]").partition("[")
        words.append(phrases.get(name, name.replace("_", " ")) + (f" ({target})" if target else ""))
    return joined_in_words(words)
