"""Saving a design of the bench as a study."""

import re
from dataclasses import fields
from pathlib import Path

from workbench.cases.points import write_points
from workbench.rig.rig import Rig
from workbench.structure.domain import NamedPoints, Rectangle
from workbench.study.design_evaluation import Design, try_out
from workbench.study.runs.whole_file import write_whole
from workbench.study.templates import free_path

SCRIPT = '''"""Does the design found on the bench do what the bench showed?"""

from pathlib import Path

import numpy as np

from workbench.cases.nominal import read_rig
{imports}
from workbench.study.design_evaluation import Design, try_out

DESIGN = {design}
SHOWN, STABLE = {shown}, {stable}  # on the bench


def study(outcome, data=None):
    rig = read_rig(Path(__file__).with_suffix(".toml"))
    tried = try_out(rig, DESIGN)
    found = {{"W_R": tried.work.residual_work, "effort": tried.effort}}
    outcome.table("design", found)
    for name, value in SHOWN.items():
        outcome.check(f"{{name}}: against the bench, relative", abs(found[name] / value - 1.0) if value else 0.0, 1e-6)
    outcome.check("stable or not, against the bench", float((not tried.loop.unstable_poles.size) is not STABLE), 0.0)
    outcome.say(f"The closed loop is {{tried.loop.stability}}.")
    outcome.say("W_R = {{W_R:.3e}} for an effort of {{effort:.3e}}.".format(**found))
    outcome.figure("work", plot_work({{"this design": tried.work}}), "Spillover work by residual mode.")
{motion}'''
TABLE = re.compile(r"^([ \t]*)points[ \t]*=.*$", re.MULTILINE)
# imports and plots of the motion of a member, a plate and a frame
MEMBER = (
    """from workbench.draw.design import plot_motion, plot_work
from workbench.draw.motion import response_motion""",
    """    motion = response_motion({"controlled": tried.response}, actuators=tried.law.actuators)
    outcome.motion(motion, "The structure after the impulse, controlled; triangles are actuators.")
    x = np.linspace(0.0, rig.modes.length, 201)
    outcome.figure("motion", plot_motion({"controlled": tried.response}, x), "Displacement over place and time.")
""",
)
PLATE = (
    """from workbench.draw.design import plot_work
from workbench.draw.surface import plot_surface_motion""",
    """    figure = plot_surface_motion(
        {"controlled": tried.response},
        DESIGN.final_time * np.array([0.0, 0.1, 0.25, 0.5, 1.0]),
        actuators=np.array(DESIGN.actuators),
        impulse_at=DESIGN.impulse_at,
    )
    outcome.figure("motion", figure, "Displacement after the impulse (star), controlled (crosses are actuators).")
""",
)
FRAME = (
    """from workbench.draw.design import plot_work
from workbench.draw.motion import mode_motion""",
    """    motion = mode_motion({"structure": rig.modes}, actuators=tried.law.actuators)
    outcome.motion(motion, "Mode shapes; triangles are actuators.")
""",
)


def save(rig: Rig, structure: str, design: Design, name: str, folder: Path) -> Path:
    """Write a design as a study: folder/name.py, and the structure (TOML, and a table of named points) beside it."""
    path, domain = free_path(name, folder), rig.modes.domain
    tried = try_out(rig, design)
    imports, motion = PLATE if isinstance(domain, Rectangle) else FRAME if isinstance(domain, NamedPoints) else MEMBER
    arguments = "".join(f"    {field.name}={getattr(design, field.name)!r},\n" for field in fields(design))
    script = SCRIPT.format(
        design=f"Design(\n{arguments})",
        shown={"W_R": tried.work.residual_work, "effort": tried.effort},
        stable=not tried.loop.unstable_poles.size,
        imports=imports,
        motion=motion,
    )
    if isinstance(domain, NamedPoints):
        structure = TABLE.sub(rf'\1points = "{path.with_suffix(".csv").name}"', structure)
    write_whole(path.with_suffix(".toml"), structure)
    if isinstance(domain, NamedPoints):
        write_points(path.with_suffix(".csv"), domain, rig.modes.phi(domain.names))
    return write_whole(path, script)
