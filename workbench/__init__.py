"""A workbench for the control of flexible structures.

structure → modes → rig → law → response → work → placement        design
record    → modes → structure                                       identification: the same types, backwards
rig + records → gap → effects → a better rig                        diagnosis
"""

from importlib import import_module

# Where each public name lives. A name is imported when it is first used, so that the command starts at once.
_HOMES = {
    "structure.profile": ("Profile",),
    "structure.member": ("Bar", "Beam"),
    "structure.supports": ("End", "PointDamper", "PointMass", "PointSpring"),
    "structure.damping": ("ModalDamping", "ProportionalDamping", "ViscousDamping"),
    "structure.modes": ("Modes", "SampledModes", "mac"),
    "structure.modification": ("attach",),
    "records.record": ("Channel", "Record"),
    "records.files": ("read_measured", "read_record", "write_record"),
    "records.transfer": ("impulse_record",),
    "records.transfer_functions": ("TransferFunctions",),
    "rig.actuators": ("Actuator",),
    "rig.sensors": ("Sensor",),
    "rig.elements": (
        "AirDrag",
        "BoucWen",
        "Clearance",
        "CoulombFriction",
        "CubicSpring",
        "EvenSpring",
        "LinearDamper",
        "LinearSpring",
        "MidplaneStretching",
        "OneSidedStop",
        "PeriodicForce",
        "PowerDamper",
        "PowerSpring",
        "RandomForce",
    ),
    "rig.rig": ("Rig",),
    "rig.simulate": ("simulate",),
    "rig.statespace": ("state_space",),
    "identification.free_decay.ibrahim": ("stacked_delays", "two_delays"),
    "identification.free_decay.refinement": ("Refined", "amplitudes", "bound", "refine"),
    "identification.free_decay.order": ("Identified", "identify"),
    "identification.ring_down": ("RingDown", "ring_down"),
    "identification.free_decay.proportional": ("ProportionalFit", "proportional_fit"),
    "identification.driven": ("Driven", "identify_driven"),
    "identification.transfer": ("TransferModes", "coherence_noise", "identify_transfer"),
    "identification.signal.aliases": ("Aliases", "aliases"),
    "identification.signal.data_quality": ("ailments", "check_fit"),
    "identification.ambient": ("AmbientModes", "ambient_decays", "identify_ambient"),
    "identification.free_decay.amplitude": ("AmplitudeDependence", "amplitude_dependence"),
    "identification.signal.decay": ("decay_start",),
    "identification.shapes.eigenfunctions": ("KnownEnds", "eigenfunctions"),
    "identification.shapes.bands": ("Bands", "eigenfunction_bands"),
    "identification.updating.distributions": ("Basis", "Distributions", "mass_and_stiffness"),
    "identification.updating.self_check": ("choose_terms", "self_check"),
    "identification.updating.sensitivity": ("LocalLoss",),
    "identification.updating.fitted_structure": ("FittedStructure",),
    "identification.updating.structure_task": ("GaussianPrior",),
    "identification.updating.structure_fit": ("choose_structure", "fit_structure"),
    "identification.updating.local_loss": ("LossFound", "find_loss"),
    "identification.signal.synthesis": ("free_decay", "struck"),
    "design.laws.law": ("DesignError", "Law"),
    "design.laws.imsc": ("imsc", "imsc_poles"),
    "design.laws.coupled": ("coupled_lqr", "coupled_poles"),
    "design.spillover.on_off": ("on_off", "on_off_work", "respond_on_off"),
    "design.estimation.controller": ("Controller", "close_with", "filtered"),
    "design.estimation.observers": ("kalman", "luenberger"),
    "design.spillover.explain": ("Explanation", "explain"),
    "design.spillover.remedies": ("remedies", "sensors_that_suffice"),
    "design.placement.how_many": ("how_many_modes",),
    "design.spillover.robustness": ("draw_modes", "survival_of", "survive", "wrong_by"),
    "design.spillover.judge": ("Judged", "judge", "judge_on_off"),
    "design.placement.sensor_placement": ("place_sensors",),
    "design.placement.certificate": ("Certificate", "certify"),
    "design.estimation.modal_filter": ("ModalFilter", "displacement_filter", "hermite_filter"),
    "design.estimation.closed_loop": ("ClosedLoop", "Response", "close_loop", "impulse_state", "respond"),
    "design.spillover.spillover": (
        "Spillover",
        "distributed_cost",
        "effort",
        "finite_spillover",
        "modal_cost",
        "quadratic_cost",
        "spillover",
    ),
    "design.placement.placement": ("Placement", "nodes_of_mode", "place", "placement_task", "scan"),
    "cases.case": ("read_case",),
    "gap.diagnose": ("diagnose",),
    "gap.report.verdict": ("Verdict",),
    "draw.plot": ("plot",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str):
    if name not in _HOME_OF:
        raise AttributeError(f"workbench has no {name!r}; its names are {', '.join(__all__)}")
    return getattr(import_module(f"workbench.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return __all__
