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

# Names of earlier versions that are no longer public, by the module that has them.
MOVED = {
    "design.estimation.controller": "Controller filtered",
    "design.estimation.modal_filter": "ModalFilter displacement_filter hermite_filter",
    "design.loop.closed_loop": "ClosedLoop Response close_with",
    "design.loop.on_off_response": "respond_on_off",
    "design.placement.certificate": "Certificate",
    "design.placement.placement": "nodes_of_mode",
    "design.placement.scan": "scan",
    "design.placement.task": "Placement",
    "design.spillover.explain": "Explanation",
    "design.spillover.robustness": "draw_modes",
    "design.spillover.spillover": (
        "Spillover distributed_cost effort finite_spillover modal_cost on_off_work quadratic_cost"
    ),
    "identification.ambient": "AmbientModes",
    "identification.free_decay.assumptions": (
        "AmplitudeDependence ProportionalFit amplitude_dependence proportional_fit"
    ),
    "identification.free_decay.ibrahim": "stacked_delays two_delays",
    "identification.free_decay.preparation": "decay_start",
    "identification.free_decay.refinement": "refine",
    "identification.frf": "coherence_noise",
    "identification.ring_down": "RingDown",
    "identification.shapes.bands": "Bands eigenfunction_bands",
    "identification.signal.aliases": "Aliases aliases",
    "identification.signal.synthesis": "free_decay",
    "identification.updating.distributions": "Basis Distributions choose_terms self_check",
    "identification.updating.sensitivity": "LocalLoss",
    "identification.updating.structure_fit": "FittedStructure",
    "identification.updating.structure_problem": "GaussianPrior",
    "records.frequency_responses": "impulse_record",
    "rig.elements": (
        "AirDrag BoucWen Clearance CoulombFriction CubicSpring EvenSpring LinearDamper LinearSpring "
        "MidplaneStretching OneSidedStop PeriodicForce PowerDamper PowerSpring RandomForce"
    ),
    "robust.redesign": "Redesign",
}
# Names of earlier versions, and what they are called now: a public name, or the path inside the package. They work for
# this version, with a warning.
RENAMED = {name: f"{module}.{name}" for module, names in MOVED.items() for name in names.split()} | {
    "Driven": "identification.driven.DrivenModes",
    "Identified": "identification.signal.modal_estimates.IdentifiedModes",
    "Judged": "design.spillover.performance.Performance",
    "KnownEnds": "identification.shapes.eigenfunctions.BoundaryConditions",
    "LossFound": "identification.updating.local_loss.LocatedDamage",
    "Refined": "identification.signal.modal_estimates.RefinedModes",
    "TransferFunctions": "FrequencyResponses",
    "TransferModes": "identification.frf.FrfModes",
    "ailments": "identification.signal.data_quality.data_faults",
    "ambient_decays": "identification.ambient.correlation_functions",
    "amplitudes": "identification.free_decay.refinement.modal_amplitudes",
    "bound": "identification.free_decay.refinement.cramer_rao_bound",
    "check_fit": "identification.signal.data_quality.check_data_quality",
    "explain": "explain_spillover",
    "find_loss": "locate_damage",
    "how_many_modes": "design.placement.controlled_modes.controlled_mode_count",
    "identify_transfer": "identify_frf",
    "judge": "design.spillover.performance.performance",
    "judge_on_off": "design.spillover.performance.on_off_performance",
    "kalman": "kalman_controller",
    "luenberger": "luenberger_controller",
    "place": "place_actuators",
    "prove": "verify",
    "remedies": "spillover_remedies",
    "respond": "initial_response",
    "sensors_that_suffice": "design.spillover.remedies.sufficient_sensors",
    "struck": "identification.signal.synthesis.impulse_response_modes",
    "survival_of": "design.spillover.robustness.stable_share",
    "survive": "design.spillover.robustness.robustness",
    "wrong_by": "design.spillover.robustness.perturbed_modes",
}


def __getattr__(name: str) -> object:
    if name not in RENAMED:
        return _public(name)
    room, _, new = f"workbench.{RENAMED[name]}".rpartition(".")
    warn(f"workbench.{name} is now {room}.{new}; the old name goes with the next version", DeprecationWarning, 2)
    return getattr(import_module(room), new)
