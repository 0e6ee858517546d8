"""A workbench for the control of flexible structures.

structure → modes → rig → law → response → work → placement        design
record    → modes → structure                                       identification: the inverse problem
rig + records → gap → effects → a better rig                        diagnosis
"""

from importlib import import_module
from warnings import warn

import lazy_loader

# The public names stand in `__init__.pyi`. Each is imported when it is first used, so that the command starts at once.
_public, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Names of earlier versions, and what they are called now: a public name, or the path inside the package. They work for
# this version, with a warning.
RENAMED = {
    "AirDrag": "rig.elements.AirDrag",
    "Aliases": "identification.signal.aliases.Aliases",
    "AmbientModes": "identification.ambient.AmbientModes",
    "AmplitudeDependence": "identification.free_decay.assumptions.AmplitudeDependence",
    "Bands": "identification.shapes.bands.Bands",
    "Basis": "identification.updating.distributions.Basis",
    "BoucWen": "rig.elements.BoucWen",
    "Certificate": "design.placement.certificate.Certificate",
    "Clearance": "rig.elements.Clearance",
    "ClosedLoop": "design.loop.closed_loop.ClosedLoop",
    "Controller": "design.estimation.controller.Controller",
    "CoulombFriction": "rig.elements.CoulombFriction",
    "CubicSpring": "rig.elements.CubicSpring",
    "Distributions": "identification.updating.distributions.Distributions",
    "Driven": "identification.driven.DrivenModes",
    "EvenSpring": "rig.elements.EvenSpring",
    "Explanation": "design.spillover.explain.Explanation",
    "FittedStructure": "identification.updating.structure_fit.FittedStructure",
    "GaussianPrior": "identification.updating.structure_problem.GaussianPrior",
    "Identified": "identification.signal.modal_estimates.IdentifiedModes",
    "Judged": "design.spillover.performance.Performance",
    "KnownEnds": "identification.shapes.eigenfunctions.BoundaryConditions",
    "LinearDamper": "rig.elements.LinearDamper",
    "LinearSpring": "rig.elements.LinearSpring",
    "LocalLoss": "identification.updating.sensitivity.LocalLoss",
    "LossFound": "identification.updating.local_loss.LocatedDamage",
    "MidplaneStretching": "rig.elements.MidplaneStretching",
    "ModalFilter": "design.estimation.modal_filter.ModalFilter",
    "OneSidedStop": "rig.elements.OneSidedStop",
    "PeriodicForce": "rig.elements.PeriodicForce",
    "Placement": "design.placement.task.Placement",
    "PowerDamper": "rig.elements.PowerDamper",
    "PowerSpring": "rig.elements.PowerSpring",
    "ProportionalFit": "identification.free_decay.assumptions.ProportionalFit",
    "RandomForce": "rig.elements.RandomForce",
    "Redesign": "robust.redesign.Redesign",
    "Refined": "identification.signal.modal_estimates.RefinedModes",
    "Response": "design.loop.closed_loop.Response",
    "RingDown": "identification.ring_down.RingDown",
    "Spillover": "design.spillover.spillover.Spillover",
    "TransferFunctions": "FrequencyResponses",
    "TransferModes": "identification.frf.FrfModes",
    "ailments": "identification.signal.data_quality.data_faults",
    "aliases": "identification.signal.aliases.aliases",
    "ambient_decays": "identification.ambient.correlation_functions",
    "amplitude_dependence": "identification.free_decay.assumptions.amplitude_dependence",
    "amplitudes": "identification.free_decay.refinement.modal_amplitudes",
    "bound": "identification.free_decay.refinement.cramer_rao_bound",
    "check_fit": "identification.signal.data_quality.check_data_quality",
    "choose_terms": "identification.updating.distributions.choose_terms",
    "close_with": "design.loop.closed_loop.close_with",
    "coherence_noise": "identification.frf.coherence_noise",
    "decay_start": "identification.free_decay.preparation.decay_start",
    "displacement_filter": "design.estimation.modal_filter.displacement_filter",
    "distributed_cost": "design.spillover.spillover.distributed_cost",
    "draw_modes": "design.spillover.robustness.draw_modes",
    "effort": "design.spillover.spillover.effort",
    "eigenfunction_bands": "identification.shapes.bands.eigenfunction_bands",
    "explain": "explain_spillover",
    "filtered": "design.estimation.controller.filtered",
    "find_loss": "locate_damage",
    "finite_spillover": "design.spillover.spillover.finite_spillover",
    "free_decay": "identification.signal.synthesis.free_decay",
    "hermite_filter": "design.estimation.modal_filter.hermite_filter",
    "how_many_modes": "design.placement.controlled_modes.controlled_mode_count",
    "identify_transfer": "identify_frf",
    "impulse_record": "records.frequency_responses.impulse_record",
    "judge": "design.spillover.performance.performance",
    "judge_on_off": "design.spillover.performance.on_off_performance",
    "kalman": "kalman_controller",
    "luenberger": "luenberger_controller",
    "modal_cost": "design.spillover.spillover.modal_cost",
    "nodes_of_mode": "design.placement.placement.nodes_of_mode",
    "on_off_work": "design.spillover.spillover.on_off_work",
    "place": "place_actuators",
    "proportional_fit": "identification.free_decay.assumptions.proportional_fit",
    "prove": "verify",
    "quadratic_cost": "design.spillover.spillover.quadratic_cost",
    "refine": "identification.free_decay.refinement.refine",
    "remedies": "spillover_remedies",
    "respond": "initial_response",
    "respond_on_off": "design.loop.on_off_response.respond_on_off",
    "scan": "design.placement.scan.scan",
    "self_check": "identification.updating.distributions.self_check",
    "sensors_that_suffice": "design.spillover.remedies.sufficient_sensors",
    "stacked_delays": "identification.free_decay.ibrahim.stacked_delays",
    "struck": "identification.signal.synthesis.impulse_response_modes",
    "survival_of": "design.spillover.robustness.stable_share",
    "survive": "design.spillover.robustness.robustness",
    "two_delays": "identification.free_decay.ibrahim.two_delays",
    "wrong_by": "design.spillover.robustness.perturbed_modes",
}


def __getattr__(name: str) -> object:
    if name not in RENAMED:
        return _public(name)
    room, _, new = f"workbench.{RENAMED[name]}".rpartition(".")
    warn(f"workbench.{name} is now {room}.{new}; the old name goes with the next version", DeprecationWarning, 2)
    return getattr(import_module(room), new)
