"""Former names of attributes and arguments: each gives the new one, and says so."""

import importlib
import pkgutil
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

import workbench
from workbench.design.estimation.digital import sampled
from workbench.design.estimation.observers import luenberger_controller
from workbench.design.export.export import export
from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.placement.task import placement_task
from workbench.design.spillover.explain import explain_spillover
from workbench.design.spillover.performance import Performance
from workbench.design.spillover.remedies import Remedy, spillover_remedies
from workbench.design.spillover.robustness import Robustness
from workbench.design.spillover.spillover import spillover
from workbench.gap.effects.catalogue import kind_named
from workbench.gap.effects.effect import Effect
from workbench.renamed import Renamed, former_arguments
from workbench.rig.actuators import Actuator
from workbench.rig.sensors import Sensor
from workbench.structure.damping import ProportionalDamping
from workbench.structure.member import Beam

MODES = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged").modes(2)
LAW = imsc(MODES, 1, [Actuator("F1", 3.0)], weight=1.0)


def former_names():
    """(class, former name, new name) of every former name in the package."""
    for module in pkgutil.walk_packages(workbench.__path__, "workbench."):
        if module.name.endswith("__main__"):
            continue
        for thing in vars(importlib.import_module(module.name)).values():
            if isinstance(thing, type) and thing.__module__ == module.name:
                yield from ((thing, old, r._new) for old, r in vars(thing).items() if isinstance(r, Renamed))


def test_a_former_name_gives_the_new_attribute_with_a_warning():
    class Beam:
        span = Renamed("length")

        def __init__(self):
            self.length = 10.0

    with pytest.warns(DeprecationWarning, match="Beam.span is now length; the old name goes with the next version"):
        assert Beam().span == 10.0


def test_every_former_name_leads_to_an_attribute_that_is_there():
    found = list(former_names())
    assert len(found) >= 18
    for owner, old, new in found:
        own = {f.name for f in fields(owner)} if is_dataclass(owner) else set()
        assert new in own or hasattr(owner, new), f"{owner.__name__}.{old} leads to {new}, which is not there"
        assert old not in own


def test_a_former_argument_is_taken_for_the_new_one_with_a_warning():
    @former_arguments(span="length")
    def area(length, *, width):
        return length * width

    assert area(2.0, width=3.0) == 6.0
    with pytest.warns(DeprecationWarning, match=r"area\(span=...\) is now .*area\(length=...\)"):
        assert area(span=2.0, width=3.0) == 6.0


def test_a_response_in_the_former_order_of_arguments_is_the_same_and_warns():
    loop, time, state = close_loop(MODES, LAW), [0.0, 0.5], np.ones(4)
    expected = initial_response(loop, time, state).modal
    for args, names in (((state, time), {}), ((state,), {"time": time}), ((), {"time": time, "state": state})):
        with pytest.warns(DeprecationWarning, match=r"is now initial_response\(loop, timepts, initial_state\)"):
            np.testing.assert_array_equal(initial_response(loop, *args, **names).modal, expected)
    rising = np.arange(4.0)  # may be instants or a state
    with pytest.raises(ValueError, match="name them"):
        initial_response(loop, rising, rising + 1.0)
    named = initial_response(loop, timepts=rising + 1.0, initial_state=rising).modal
    np.testing.assert_array_equal(named[:, :1], initial_response(loop, [1.0], rising).modal)


def test_an_actuator_takes_the_kind_of_earlier_versions_for_its_quantity():
    with pytest.warns(DeprecationWarning, match=r"Actuator\(kind=...\) is now Actuator\(quantity=...\)"):
        moment = Actuator("M", 1.0, kind="moment")
    assert moment == Actuator("M", 1.0, "moment") == Actuator("M", 1.0, quantity="moment")
    with pytest.warns(DeprecationWarning, match="Actuator.kind is now quantity"):
        assert moment.kind == "moment"


def test_damping_takes_the_coefficients_of_earlier_versions():
    with pytest.warns(DeprecationWarning, match=r"ProportionalDamping\(g\d=...\) is now"):
        damping = ProportionalDamping(g1=0.002, g2=0.1)
    assert damping == ProportionalDamping(0.002, 0.1) == ProportionalDamping(mass=0.1, stiffness=0.002)
    with pytest.warns(DeprecationWarning, match="ProportionalDamping.g1 is now stiffness"):
        assert damping.g1 == 0.002
    with pytest.warns(DeprecationWarning, match="ProportionalDamping.g2 is now mass"):
        assert damping.g2 == 0.1


def test_an_effect_takes_the_deviations_of_earlier_versions_for_its_standard_errors():
    with pytest.warns(DeprecationWarning, match=r"Effect\(deviations=...\) is now"):
        one = Effect(kind_named("modulus_error"), None, {"factor": 1.1}, deviations={"factor": 0.01})
    assert one.std == {"factor": 0.01}
    with pytest.warns(DeprecationWarning, match="Effect.deviations is now std"):
        assert one.deviations is one.std


def test_the_matrices_of_a_controller_have_their_former_names_too():
    controller = luenberger_controller(MODES, LAW, [Sensor("y", 4.0)], poles=[-0.1 + 0.1j])
    former = {"state": "A", "reads": "B", "commands": "C", "direct": "D", "estimator": "L"}
    for one, names in ((controller, former), (sampled(controller, 0.1), {x.lower(): x for x in "ABCDE"})):
        for old, new in names.items():
            with pytest.warns(DeprecationWarning, match=f"Controller.{old} is now {new}"):
                assert getattr(one, old) is getattr(one, new)
            with pytest.warns(DeprecationWarning, match=rf"Controller\({old}=...\) is now"):
                changed = replace(one, **{old: 2.0 * getattr(one, new)})
            np.testing.assert_array_equal(getattr(changed, new), 2.0 * getattr(one, new))


def test_the_work_of_a_design_has_its_former_names_too():
    found = spillover(MODES, LAW, impulse_state(MODES, 4.0))
    names = {"by_mode": "work_by_mode", "residual": "residual_modes"}
    names |= {"controlled_total": "controlled_work", "residual_total": "residual_work"}
    for old, new in names.items():
        with pytest.warns(DeprecationWarning, match=f"Spillover.{old} is now {new}"):
            np.testing.assert_array_equal(getattr(found, old), getattr(found, new))
    assert found.residual_modes == (1,) and found.residual_work == found.work_by_mode[1]
    placed = placement_task(MODES, 1, impulse_at=4.0, weight=1.0).placed([3.0], "")
    with pytest.warns(DeprecationWarning, match="Placement.by_mode is now residual_work_by_mode"):
        np.testing.assert_array_equal(placed.by_mode, placed.residual_work_by_mode)
    for one, new in ((found, "work_by_mode"), (placed, "residual_work_by_mode")):
        with pytest.warns(DeprecationWarning, match=rf"\(by_mode=...\) is now .*\({new}=...\)"):
            assert getattr(replace(one, by_mode=[1.0, 2.0]), new)[1] == 2.0


def test_the_decay_rate_was_called_margin():
    controller = luenberger_controller(MODES, LAW, [Sensor("y", 3.0)], poles=[-0.1 + 0.1j])
    explained = explain_spillover(MODES, controller)
    sampled_design = export(MODES, controller, sample_rate_hz=100.0)
    with pytest.warns(DeprecationWarning, match=r"\(margins?=...\) is now"):
        remedy, share = (
            Remedy("gain", "", 0.5, margin=0.2, controller=controller),
            Robustness(margins=[1.0], work=[1.0]),
        )
        found = Performance(1.0, 1.0, 1.0, margin=0.1)
    for one in (explained, explained.loop, sampled_design, remedy, found):
        with pytest.warns(DeprecationWarning, match=f"{type(one).__name__}.margin is now decay_rate"):
            assert one.margin == one.decay_rate
    with pytest.warns(DeprecationWarning, match="margins is now decay_rates"):
        assert share.margins is share.decay_rates
    with pytest.warns(DeprecationWarning, match="reduced_margin is now reduced_decay_rate"):
        assert explained.reduced_margin == explained.reduced_decay_rate
    with pytest.warns(DeprecationWarning, match=r"reduced_margin=...\) is now"):
        assert replace(explained, reduced_margin=2.0).reduced_decay_rate == 2.0
    with pytest.warns(DeprecationWarning, match=r"spillover_remedies\(margin=...\) is now .*\(decay_rate=...\)"):
        spillover_remedies(MODES, lambda *_: controller, LAW.actuators, [3.0], margin=-1e9)


@pytest.mark.parametrize("transducer", [Actuator("F1", 2.0, delay=0.1), Sensor("d", 1.0)])
def test_whether_a_transducer_has_a_state_space_was_called_linear(transducer):
    with pytest.warns(DeprecationWarning, match="linear is now has_state_space"):
        assert transducer.linear is transducer.has_state_space
