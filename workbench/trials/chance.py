"""Hidden effects at random: a kind, a place, and a strength at which the gap can be seen."""

from typing import Any

import numpy as np

from workbench.trials.draws import DRAWS
from workbench.trials.hidden import hide
from workbench.trials.scene import Scene, Unsuitable

SMALLEST, LARGEST = 0.02, 1.5
TRIES = 9


def draw_effect(kind: str, scene: Scene, rng: np.random.Generator) -> dict[str, Any]:
    """An effect of a kind, in the words of the case format, at a strength that gives a gap drawn at random.

    Raises:
        Unsuitable: the bench cannot show the kind, or no strength gave a gap between 2 and 150 %.
    """
    drawn = DRAWS[kind](scene, rng)
    if isinstance(drawn, dict):
        effect = {"kind": kind, **drawn}
        if kind != "sensor_quantisation" and not SMALLEST < _gap(effect, scene, rng) < LARGEST:
            raise Unsuitable(f"{kind}: the draw shows no gap")
        return effect
    target = float(np.exp(rng.uniform(np.log(0.04), np.log(0.5))))
    strength, last = 1.0, None
    for _ in range(TRIES):
        effect = {"kind": kind, **drawn(strength)}
        gap = _gap(effect, scene, rng)
        if 0.6 < gap / target < 1.7:
            return effect
        power = 1.0
        if last is not None and strength != last[0] and gap > 0 and last[1] > 0:
            power = float(np.clip(np.log(gap / last[1]) / np.log(strength / last[0]), 0.3, 3.0))
        last = (strength, gap)
        strength *= float(np.clip((target / max(gap, 1e-12)) ** (1.0 / power), 0.02, 50.0))
    if SMALLEST < gap < LARGEST:
        return effect
    raise Unsuitable(f"{kind}: no strength gives a gap that can be seen; the last was {gap:.2g}")


def _gap(effect: dict[str, Any], scene: Scene, rng: np.random.Generator) -> float:
    try:
        return scene.gap(hide(scene.bench.plant(), [effect]), rng)
    except Unsuitable:
        return 1e3
    except ValueError as error:
        if "buckles" in str(error):
            return 1e3
        raise
