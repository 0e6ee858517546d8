"""How a set of effects is brought from predictions one sample ahead to whole records."""

from dataclasses import replace

import numpy as np
import pytest

from workbench.gap.effects.catalogue import CATALOGUE, kind_named
from workbench.gap.effects.effect import Effect
from workbench.gap.prediction.residuals import FitData
from workbench.gap.prediction.workers import ALONE
from workbench.gap.search.fit import fit
from workbench.gap.search.screening import by_continuation
from workbench.gap.search.search import Search
from workbench.rig.elements import CubicSpring

CUBIC, NOISE = kind_named("cubic_spring"), 1e-5


@pytest.fixture(scope="module")
def rig(hinged_rig):
    return hinged_rig()


@pytest.fixture(scope="module")
def search(rig, record_of):
    """A search beside a spring so stiff that motions a millionth apart part within the record."""

    def make(stiffness: float, level: float, seed: int) -> Search:
        rng = np.random.default_rng(seed)
        command = level * np.repeat(rng.normal(size=200), 10)[None]
        real = replace(rig, elements=(CubicSpring(0.62, stiffness),))
        data = FitData((record_of(real, command, rng, substeps=8),), np.full(4, NOISE))
        quick, nominal = data.stepped(2), data.by_channel(data.residual(rig))
        return Search(rig, data, quick, quick, CATALOGUE, lambda text, share: None, ALONE, nominal)

    return make


def test_rigs_let_go_by_degrees_come_to_whole_records_where_those_let_go_at_once_do_not(rig, search):
    # which of them part depends on the last bit, so they are counted
    at_once, by_degrees = 0, 0
    for stiffness, level, seed in ((2e5, 2.0, 3), (2e5, 2.0, 4), (4e4, 2.0, 4), (1e5, 2.0, 5), (1e5, 1.0, 3)):
        one = search(stiffness, level, seed)
        start = (Effect(CUBIC, None, {"at": 0.6, "stiffness": 0.8 * stiffness}),)
        ahead = fit(rig, start, one.data.one_step_ahead(rig).stepped(8), iterations=8, tolerance=1e-4)
        at_once += fit(rig, ahead.effects, one.data.stepped(8), iterations=25).cost < 2.0
        by_degrees += by_continuation(one, start, 25).cost < 2.0
    assert by_degrees >= at_once + 2
