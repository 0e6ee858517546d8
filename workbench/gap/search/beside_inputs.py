"""What holds beside noise of the logged inputs, which is loud at resonances and alike in all sensors."""

import numpy as np

from workbench.gap.effects.effect import apply_all
from workbench.gap.prediction.logged_inputs import LEAST_LOGGED, likeliest_share
from workbench.gap.search.fit import Fit
from workbench.gap.search.jointly import fit_jointly, measured
from workbench.gap.search.search import Search
from workbench.gap.search.settings import INPUTS
from workbench.rig.rig import Rig


def beside_inputs(search: Search, fitted: Fit, sensor_noise: np.ndarray) -> Search | None:
    """The search beside noise of the logged inputs as a set shows it; None where that is not what the set leaves.

    What most records would have louder than any logger's noise is none: a law that is missing grows with the level too.

    Args:
        search: without that noise.
        fitted: the set, errors of the nominal model among it.
        sensor_noise: (n_outputs,) mean square of each sensor's noise as found without it, over that of the stated one.
    """
    rig = apply_all(search.rig, fitted.effects)
    left, found = search.data.differences(rig), search.with_noise(np.sqrt(sensor_noise) * search.data.noise)
    # what is left is loud with noise of the inputs, so the stated noise of the sensors may be the better
    shares = [likeliest_share(rig, s.data, left) for s in (search, found)]
    (share, _, is_beyond), louder = min(zip(shares, (search, found), strict=True), key=lambda each: each[0].loss)
    if share < LEAST_LOGGED or is_beyond:
        return None
    beside = louder.beside_inputs(rig, share)
    white = measured(beside, fitted).fit
    if INPUTS.white < white.cost < INPUTS.bent * fitted.cost:
        fitted = white = fit_jointly(beside, fitted.effects[:-1], fitted.effects[-1]).fit
        rig = apply_all(search.rig, fitted.effects)
        left = search.data.differences(rig)
    if white.cost > INPUTS.white:
        return None
    for _ in range(INPUTS.rounds):  # each sensor's noise by the power of its innovations
        louder = louder.with_noise(louder.data.noise * np.sqrt(white.cost_by_channel.mean(axis=0)))
        beside = louder.beside_inputs(rig, likeliest_share(rig, louder.data, left).share)
        white = measured(beside, fitted).fit
    return beside


def likeliest_loss(search: Search, rig: Rig) -> float:
    """Minus the log-likelihood of what a rig leaves, beside as much noise of the logged inputs as is likeliest."""
    return likeliest_share(rig, search.data, search.data.differences(rig)).loss
