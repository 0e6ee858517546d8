"""Laws that hold for every structure, tried on random ones: to 1e-9, by quadrature and scaling of the test's own."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from workbench.design.laws.imsc import imsc
from workbench.design.loop.closed_loop import close_loop, impulse_state, initial_response
from workbench.design.spillover.spillover import finite_spillover
from workbench.rig.actuators import Actuator
from workbench.rig.rig import Rig
from workbench.rig.sensors import Sensor
from workbench.rig.simulate import move
from workbench.structure.damping import ModalDamping
from workbench.structure.member import Bar, Beam
from workbench.structure.supports import End, PointMass, PointSpring

EXACT = 1e-9
FEW, MANY = 15, 1000
COMMON = dict(deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)


def between(low, high):
    """Spread evenly over the decades."""
    return st.floats(np.log(low), np.log(high)).map(lambda e: float(np.exp(e)))


@st.composite
def profiles(draw, length, size):
    if draw(st.booleans()):
        return size * draw(between(0.3, 3.0))
    n = draw(st.integers(2, 4))
    inner = sorted(draw(st.lists(st.floats(0.1, 0.9), min_size=n - 2, max_size=n - 2)))
    x = np.array([0.0, *inner, 1.0])
    if (np.diff(x) < 0.05).any():
        x = np.linspace(0.0, 1.0, n)
    return length * x, size * np.array([draw(between(0.3, 3.0)) for _ in x])


@st.composite
def structures(draw, free=True):
    """(structure, n_modes): a bar or a beam of any size, profiles, ends, attachments and tension."""
    beam = draw(st.booleans())
    length, mass, omega = draw(between(0.01, 100)), draw(between(1e-3, 1e3)), draw(between(0.1, 1e4))
    # the stiffness that gives a uniform structure about the frequency ω
    stiffness = mass * omega**2 * (length / np.pi) ** (4 if beam else 2)
    spring = stiffness / length ** (3 if beam else 1)
    named = ["hinged", "clamped", "free", "sliding"] if beam else ["fixed", "free"]
    named = named if free else [name for name in named if name in ("hinged", "clamped", "fixed")]
    elastic = st.builds(
        End, between(0.1, 1e3).map(lambda k: k * spring), between(0.1, 1e3).map(lambda k: k * spring * length**2)
    )
    ends = [draw(st.sampled_from(named) | elastic) for _ in range(2)]
    places = st.floats(0.05, 0.95).map(lambda x: x * length)
    masses = st.builds(PointMass, places, between(0.01, 3.0).map(lambda m: m * mass * length))
    springs = st.builds(PointSpring, places, between(0.1, 300.0).map(lambda k: k * spring))
    parts = draw(st.lists(masses | springs, max_size=2))
    common = dict(
        length=length,
        mass_per_length=draw(profiles(length, mass)),
        left=ends[0],
        right=ends[1],
        attachments=tuple(parts),
    )
    stiff = draw(profiles(length, stiffness))
    n_modes = draw(st.integers(2, 8))
    if not beam:
        return Bar(axial_stiffness=stiff, **common), n_modes
    tension = draw(st.just(0.0) | between(0.1, 30.0)) * stiffness / length**2
    return Beam(bending_stiffness=stiff, tension=tension, **common), n_modes


def stiffness_of(structure):
    return structure.bending_stiffness if isinstance(structure, Beam) else structure.axial_stiffness


def with_stiffness(structure, profile, **changes):
    name = "bending_stiffness" if isinstance(structure, Beam) else "axial_stiffness"
    return replace(structure, **{name: profile}, **changes)


def energies(structure, modes):
    """∫ m φ_r φ_s dx and the bilinear form of the potential energy, by Gauss's rule between all breaks."""
    order = 2 if isinstance(structure, Beam) else 1
    mass, stiffness = structure.mass_per_length, stiffness_of(structure)
    marks = {0.0, structure.length, *mass.breaks, *stiffness.breaks, *(p.at for p in structure.attachments)}
    marks |= set(np.linspace(0.0, structure.length, 6))
    marks = np.array(sorted(m for m in marks if 0 <= m <= structure.length))
    half = 0.5 * np.diff(marks)
    x = (marks[:-1, None] + half[:, None] * (1 + NODES)).ravel()
    w = (half[:, None] * WEIGHTS).ravel()

    def form(weights, derivative):
        values = modes.phi(x, derivative)
        return values.T @ (weights[:, None] * values)

    kinetic, potential = form(w * mass(x), 0), form(w * stiffness(x), order)
    if order == 2 and structure.tension:
        potential = potential + form(structure.tension * w, 1)
    for at, end in ((0.0, structure.left), (structure.length, structure.right)):
        for derivative, spring in enumerate((end.translation, end.rotation)[:order]):
            if 0 < spring < np.inf:
                row = modes.phi(at, derivative)
                potential = potential + spring * row.T @ row
    for part in structure.attachments:
        row = modes.phi(part.at)
        if isinstance(part, PointMass):
            kinetic = kinetic + part.mass * row.T @ row
        else:
            potential = potential + part.stiffness * row.T @ row
    return kinetic, potential


def half_wave(structure):
    """The frequency of one half wave, rad/s: a scale where all modes are rigid-body ones."""
    order = 2 if isinstance(structure, Beam) else 1
    middle = 0.5 * structure.length
    ratio = stiffness_of(structure)(middle) / structure.mass_per_length(middle)
    return np.sqrt(ratio) * (np.pi / structure.length) ** order


def orthonormality(drawn):
    """∫ m φ_r φ_s dx = δ_rs (2.5), and the potential energy of each pair is ω_r² δ_rs (2.6)."""
    structure, n_modes = drawn
    modes = structure.modes(n_modes)
    kinetic, potential = energies(structure, modes)
    np.testing.assert_allclose(kinetic, np.eye(n_modes), rtol=0, atol=EXACT)
    size = max(modes.omega[-1], half_wave(structure)) ** 2
    np.testing.assert_allclose(potential, np.diag(modes.omega**2), rtol=0, atol=EXACT * size)


def alike(modes, others, scale_of_omega, scale_of_phi, x, others_x):
    """Frequencies and shapes agree up to scales and signs; shapes as far as their frequencies lie apart."""
    omega = scale_of_omega * modes.omega
    np.testing.assert_allclose(others.omega, omega, rtol=EXACT, atol=0)
    shapes, theirs = scale_of_phi * modes.phi(x), others.phi(others_x)
    apart = np.abs(np.subtract.outer(omega, omega)) + np.diag(np.full(omega.size, np.inf))
    clear = apart.min(axis=1) > 1e-2 * omega[-1] / omega.size
    clear[-1] = False  # its neighbour above is not at hand
    size = np.abs(shapes).max()
    signs = np.sign(np.einsum("xr,xr->r", shapes, theirs))
    np.testing.assert_allclose((signs * theirs)[:, clear], shapes[:, clear], rtol=0, atol=10 * EXACT * size)


def mirrored(structure):
    length = structure.length

    def turned(profile):
        return replace(
            profile, function=lambda x: profile(length - x), breaks=tuple(sorted(length - b for b in profile.breaks))
        )

    return with_stiffness(
        structure,
        turned(stiffness_of(structure)),
        mass_per_length=turned(structure.mass_per_length),
        left=structure.right,
        right=structure.left,
        attachments=tuple(replace(part, at=length - part.at) for part in structure.attachments),
    )


def symmetry(drawn):
    """Seen from the other side a structure has the same frequencies, and its shapes turned round."""
    structure, n_modes = drawn
    x = structure.length * np.linspace(0.0, 1.0, 33)
    alike(structure.modes(n_modes), mirrored(structure).modes(n_modes), 1.0, 1.0, x, structure.length - x)


def scaled(structure, a, b, c):
    """Length, mass and stiffness per length times a, b, c; attachments, ends and tension along with them."""
    order = 2 if isinstance(structure, Beam) else 1
    spring, inertia = c / a ** (2 * order - 1), b * a

    def stretched(profile, factor):
        return replace(
            profile, function=lambda x: factor * profile(x / a), breaks=tuple(a * break_ for break_ in profile.breaks)
        )

    def moved(part):
        if isinstance(part, PointMass):
            return PointMass(a * part.at, inertia * part.mass)
        return PointSpring(a * part.at, spring * part.stiffness)

    tension = {"tension": structure.tension * c / a**2} if order == 2 else {}
    return with_stiffness(
        structure,
        stretched(stiffness_of(structure), c),
        length=a * structure.length,
        mass_per_length=stretched(structure.mass_per_length, b),
        left=End(spring * structure.left.translation, spring * a**2 * structure.left.rotation),
        right=End(spring * structure.right.translation, spring * a**2 * structure.right.rotation),
        attachments=tuple(moved(part) for part in structure.attachments),
        **tension,
    )


def scaling(drawn, factors):
    """ω goes as √(c/b) / a² for a beam, √(c/b) / a for a bar; φ as 1/√(a b)."""
    (structure, n_modes), (a, b, c) = drawn, factors
    order = 2 if isinstance(structure, Beam) else 1
    x = structure.length * np.linspace(0.0, 1.0, 33)
    others = scaled(structure, a, b, c).modes(n_modes)
    alike(structure.modes(n_modes), others, np.sqrt(c / b) / a**order, 1 / np.sqrt(a * b), x, a * x)


def energy_balance(drawn, at, seed):
    """Under forces held over each interval the energy gained is Σ u_k (w_{k+1} - w_k) at the actuators, exactly; and
    under control it is the work of the control forces in all modes (5.60)."""
    structure, n_modes = drawn
    modes = replace(structure, damping=ModalDamping(0.0)).modes(n_modes)
    actuators = tuple(Actuator(f"F{i}", x * structure.length) for i, x in enumerate(at))
    rng = np.random.default_rng(seed)
    rig = Rig(modes, actuators, (Sensor("y", actuators[0].at),))
    commands = rng.standard_normal((len(at), 60))
    motion = move(rig, commands, sample_time=2.0 / modes.omega[-1])
    energy = 0.5 * (motion.velocity**2 + (modes.omega[:, None] * motion.displacement) ** 2).sum(axis=0)
    w = modes.phi([a.at for a in actuators]) @ motion.displacement
    work = np.cumsum((commands[:, :-1] * np.diff(w)).sum(axis=0))
    np.testing.assert_allclose(energy[1:], work, rtol=0, atol=EXACT * energy.max())

    push = np.abs(modes.phi(actuators[0].at)[0, 0])
    if push < 1e-2 * np.abs(modes.phi(np.linspace(0, structure.length, 50))[:, 0]).max():
        return  # this actuator cannot move the mode it is to control
    law = imsc(modes, 1, actuators[:1], weight=float(np.exp(rng.uniform(-3, 3))) / modes.omega[0] ** 2)
    loop, state = close_loop(modes, law), impulse_state(modes, 0.37 * structure.length)
    end = 20.0 / modes.omega[0]
    before, after = initial_response(loop, [0.0, end], state).energy.T
    gained = finite_spillover(loop, state, end).work_by_mode
    np.testing.assert_allclose(after - before, gained, rtol=0, atol=EXACT * max(before.sum(), after.sum()))


def few_and_many(law, *strategies):
    def few(drawn):
        law(*drawn)

    drawn = st.tuples(*strategies)
    return (settings(max_examples=n, **COMMON)(given(drawn)(few)) for n in (FEW, MANY))


PLACES = st.lists(st.floats(0.1, 0.9), min_size=1, max_size=3, unique=True)
LAWS = {
    law.__name__: tuple(few_and_many(law, *strategies))
    for law, *strategies in (
        (orthonormality, structures()),
        (symmetry, structures()),
        (scaling, structures(), st.tuples(*[between(0.01, 100)] * 3)),
        (energy_balance, structures(free=False), PLACES, st.integers(0, 2**32 - 1)),
    )
}


@pytest.mark.parametrize("law", LAWS)
def test_a_law_holds(law):
    LAWS[law][0]()


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_a_law_holds_a_thousand_times(law):
    LAWS[law][1]()
