"""How a fault of the test set-up is said, with its correction."""

from collections.abc import Sequence

import numpy as np

from workbench.arrays import Floats
from workbench.rig.sensors import Sensor

G, TURN = 9.80665, 2.0 * np.pi

# measured / predicted: what an output does that reads so, and what an input does that is logged so as to give it
FACTORS = {
    -1.0: ("have the wrong sign", "have the wrong sign"),
    1.0 / G: ("are 9.81 times too small", "are 9.81 times too large"),
    G: ("are 9.81 times too large", "are 9.81 times too small, such as kgf for N"),
    1e3: ("are 1000 times too large, such as mm for m", "are 1000 times too small, such as kN for N"),
    1e-3: ("are 1000 times too small, such as km for m", "are 1000 times too large, such as mN for N"),
    1e6: ("are a million times too large, such as μm for m", "are a million times too small"),
    1e2: ("are 100 times too large, such as cm for m", "are 100 times too small"),
    1e-2: ("are 100 times too small", "are 100 times too large, such as per cent"),
    TURN: ("are 2π times too large", "are 2π times too small"),
    1.0 / TURN: ("are 2π times too small, such as Hz for rad/s", "are 2π times too large"),
}
IN_G = "look like g where m/s² is meant"
RATES = {2.0: "twice", 0.5: "half", 1e3: "1000 times", 1e-3: "a thousandth of"}


def named(what: str, names: Sequence[str]) -> str:
    """Such as: The outputs y1, y2 and y3."""
    if len(names) == 1:
        return f"The {what} {names[0]}"
    return f"The {what}s {', '.join(names[:-1])} and {names[-1]}"


def one(sentence: str, names: Sequence[str]) -> str:
    """The sentence with its first verb in the singular where one thing is spoken of."""
    if len(names) > 1:
        return sentence
    for many, single in ((" are ", " is "), (" have ", " has "), (" look ", " looks ")):
        if many in sentence:
            return sentence.replace(many, single, 1)
    return sentence


def perhaps(what: str) -> str:
    """The same, with "may" before its first verb."""
    for sure, may in ((" look ", " may look "), (" looks ", " may look "), (" are ", " may be "), (" is ", " may be ")):
        if sure in what:
            return what.replace(sure, may, 1)
    return what


def doubtful(what: str, off: Floats) -> str:
    """What may be a fault of units, and by how much it is none; off: relative differences of the gains."""
    far = ", ".join(dict.fromkeys(f"{100 * share:+.2g} %" for share in off))
    return (
        f"{perhaps(what)}; but the gain differs from that by {far}, more than its error: taken for an error of"
        " calibration."
    )


def sentence_of_outputs(sensors: Sequence[Sensor], at: Sequence[int], factor: float, off: Floats | None) -> str:
    """What outputs read, and what to multiply them by; of all outputs, what the inputs may be instead.

    Args:
        off: where the factor is in doubt, relative differences of the gains from it.
    """
    names = [sensors[j].name for j in at]
    every = len(at) == len(sensors)
    what, of_inputs = FACTORS[factor]
    if factor == 1.0 / G and {sensors[j].quantity for j in at} == {"acceleration"}:
        what = IN_G
    who = "All outputs" if every and len(names) > 1 else named("output", names)
    rest = f", or all inputs {of_inputs}" if every else ""
    if off is not None:
        return doubtful(f"{who} {what}{rest}", off)
    cure = "multiply by -1" if factor == -1.0 else f"multiply by {1.0 / factor:.6g}"
    return f"{one(f'{who} {what}', names)}{rest}: {cure}{' (the outputs)' if rest else ''}."


def sentence_of_inputs(names: Sequence[str], factor: float, off: Floats | None = None) -> str:
    """What inputs are logged as, and what to multiply them by; off: as for outputs."""
    what = f"{named('input', names)} {FACTORS[factor][1]}"
    return f"{one(what, names)}: multiply by {factor:.6g}." if off is None else doubtful(what, off)
