"""What does independent modal-space control give away against coupled LQR, and what does it save?"""

import control
import numpy as np

from workbench.design.closed_loop import impulse_state
from workbench.design.coupled import coupled_lqr
from workbench.design.imsc import imsc, riccati_gains, riccati_matrices
from workbench.design.spillover import effort, quadratic_cost, spillover
from workbench.draw.design import plot_comparison
from workbench.rig.actuators import Actuator
from workbench.structure.member import Beam

MODAL_WEIGHT = 20.0
# at the nodes of mode 5, B Bᵀ = ½ I, so R f² on modal forces is R/2 F² on actuator forces: one and the same problem
FORCE_WEIGHT = 10.0


def riccati_errors() -> tuple[float, float]:
    """Largest relative Riccati residual over five decades of R and of frequency; gains against control.lqr."""
    residual = gains = 0.0
    for omega in np.geomspace(1e-2, 1e3, 11):
        for weight in np.geomspace(1e-3, 1e2, 11):
            p = riccati_matrices(np.array([omega]), weight)[0]
            a, b, q = np.array([[0, 1], [-(omega**2), 0]]), np.array([[0.0], [1.0]]), np.diag([omega**2, 1.0])
            terms = (a.T @ p, p @ a, -p @ b @ b.T @ p / weight, q)
            size = np.max([np.abs(t) for t in terms], axis=0)
            residual = max(residual, float((np.abs(sum(terms)) / np.maximum(size, 1e-300))[size > 0].max()))
            peer = control.lqr(a, b, q, [[weight]])[0][0]
            mine = np.ravel(riccati_gains(omega, weight))
            gains = max(gains, float((np.abs(mine - peer) / np.abs(peer).max()).max()))
    return residual, gains


def study(outcome, data=None):
    beam = Beam(length=10.0, mass_per_length=1.0, bending_stiffness=1.0, left="hinged", right="hinged")
    modes = beam.modes(9)
    state = impulse_state(modes, 6.3)
    state[9 + 4 :] = 0.0

    def compared(places):
        actuators = [Actuator(f"F{i + 1}", x) for i, x in enumerate(places)]
        laws = {
            "IMSC": imsc(modes, 4, actuators, weight=MODAL_WEIGHT),
            "coupled LQR": coupled_lqr(modes, 4, actuators, weight=FORCE_WEIGHT),
        }
        return [
            {
                "law": label,
                "cost": quadratic_cost(modes, law, state, FORCE_WEIGHT),
                "effort": effort(modes, law, state),
                "W_R": spillover(modes, law, state).residual_total,
            }
            for label, law in laws.items()
        ]

    rows, crowded = compared((2.0, 4.0, 6.0, 8.0)), compared((1.3, 2.6, 3.9, 5.2))
    outcome.table("nodes_of_mode_5", rows)
    outcome.table("crowded", crowded)

    residual, gains = riccati_errors()
    outcome.check("Riccati residual of the closed form over five decades, relative", residual, 1e-12)
    outcome.check("gains against control.lqr mode by mode, relative", gains, 1e-8)
    outcome.check(
        "nodes of mode 5: cost of coupled LQR against IMSC, relative difference",
        abs(rows[1]["cost"] / rows[0]["cost"] - 1.0),
        1e-9,
    )
    outcome.check("cost of coupled LQR over IMSC, actuators crowded", crowded[1]["cost"] / crowded[0]["cost"], 1.0)
    outcome.say("actuators at the nodes of mode 5: IMSC and coupled LQR are the same law")
    outcome.say(
        f"actuators crowded: coupled LQR costs {crowded[1]['cost'] / crowded[0]['cost']:.3f} of IMSC, with"
        f" {crowded[1]['effort'] / crowded[0]['effort']:.3f} of its effort and"
        f" {crowded[1]['W_R'] / crowded[0]['W_R']:.3f} of its spillover"
    )
    outcome.figure("comparison", plot_comparison(crowded), "Actuators at 1.3, 2.6, 3.9, 5.2: coupled LQR beside IMSC.")
