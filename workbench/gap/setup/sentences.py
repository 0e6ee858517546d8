"""Sentences on faults of the test set-up, with their corrections."""

from collections.abc import Sequence

import numpy as np

from workbench.arrays import Floats
from workbench.rig.sensors import Sensor

G, TURN = 9.80665, 2.0 * np.pi

# measured over predicted amplitude: what is wrong with outputs that have this ratio, and with inputs that cause it
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


def subject(what: str, names: Sequence[str]) -> str:
    """The subject of a sentence, such as: The outputs y1, y2 and y3."""
    if len(names) == 1:
        return f"The {what} {names[0]}"
    return f"The {what}s {', '.join(names[:-1])} and {names[-1]}"


def agreeing(sentence: str, names: Sequence[str]) -> str:
    """The sentence with its first verb in the singular if there is one name."""
    if len(names) > 1:
        return sentence
    for many, single in ((" are ", " is "), (" have ", " has "), (" look ", " looks ")):
        if many in sentence:
            return sentence.replace(many, single, 1)
    return sentence


def with_may(what: str) -> str:
    """The clause with "may" before its first verb."""
    for sure, may in ((" look ", " may look "), (" looks ", " may look "), (" are ", " may be "), (" is ", " may be ")):
        if sure in what:
            return what.replace(sure, may, 1)
    return what


def doubtful(what: str, off: Floats) -> str:
    """A sentence on a fault of units that is in doubt; off: relative differences of the gains from the factor."""
    differences = ", ".join(dict.fromkeys(f"{100 * share:+.2g} %" for share in off))
    return (
        f"{with_may(what)}; but the gain differs from that by {differences}, more than its uncertainty: treated as an"
        " error of calibration."
    )


def sentence_of_outputs(sensors: Sequence[Sensor], at: Sequence[int], factor: float, off: Floats | None) -> str:
    """What is wrong with outputs, and the correction; if with all outputs, also what the inputs may be instead.

    Args:
        sensors: of the rig.
        at: indices of the outputs.
        factor: measured over predicted amplitude, one of `FACTORS`.
        off: relative differences of the gains from the factor, if it is in doubt.
    """
    names = [sensors[j].name for j in at]
    is_all = len(at) == len(sensors)
    what, of_inputs = FACTORS[factor]
    if factor == 1.0 / G and {sensors[j].quantity for j in at} == {"acceleration"}:
        what = IN_G
    outputs = "All outputs" if is_all and len(names) > 1 else subject("output", names)
    alternative = f", or all inputs {of_inputs}" if is_all else ""
    if off is not None:
        return doubtful(f"{outputs} {what}{alternative}", off)
    correction = "multiply by -1" if factor == -1.0 else f"multiply by {1.0 / factor:.6g}"
    clause = agreeing(f"{outputs} {what}", names)
    return f"{clause}{alternative}: {correction}{' (the outputs)' if alternative else ''}."


def sentence_of_inputs(names: Sequence[str], factor: float, off: Floats | None = None) -> str:
    """What is wrong with logged inputs, and the correction; factor, off: as of `sentence_of_outputs`."""
    what = f"{subject('input', names)} {FACTORS[factor][1]}"
    return f"{agreeing(what, names)}: multiply by {factor:.6g}." if off is None else doubtful(what, off)
