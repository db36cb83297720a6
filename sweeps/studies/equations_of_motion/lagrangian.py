"""The energies and equations of motion of the bongoboard (Section VI-A), derived with SymPy.

Wheel, board, legs and pelvis are rigid; a foot plate of any mass is glued to the board. The generalised
coordinates are the three absolute angles of wheel, board and legs, in which the mass matrix is sparse.
Products of sines and cosines are turned into sums, a unique form, in which equal coefficients of the energies
can be found and lumped: they are constants of the robot, and what is left of the equations is short.

The bongoboard is the paper's, or a disturbed one, where the floor slopes, the pelvis' centre of mass is off
its middle, and a moment acts on the wheel. Coordinates are those of the floor: what slopes there is gravity.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import sympy as sp
from sympy.simplify.fu import TR8

# Physical parameters, and where generated code finds them.
PARAMETERS = {
    "m_w": "robot.wheel_mass",
    "m_b": "robot.board_mass",
    "m_f": "foot_mass",
    "m_l": "robot.leg_mass",
    "m_p": "robot.pelvis_mass",
    "I_p": "robot.pelvis_inertia",
    "r": "robot.wheel_radius",
    "L_b": "robot.board_length",
    "h_b": "robot.board_thickness",
    "L_f": "robot.foot_length",
    "h_a": "robot.ankle_height",
    "L_l": "robot.leg_length",
    "g": "robot.gravity",
}
DISTURBED = {**PARAMETERS, "g": "robot.gravity * np.cos(slope)", "g_x": "-robot.gravity * np.sin(slope)"}
DISTURBED |= {"e_x": "pelvis_x", "e_y": "pelvis_y"}
m_w, m_b, m_f, m_l, m_p, I_p, r, L_b, h_b, L_f, h_a, L_l, g = sp.symbols(list(PARAMETERS))
g_x, e_x, e_y = sp.symbols("g_x e_x e_y")

# Coordinates q and their rates: the global angles of wheel, board and legs.
alpha_w, phi, psi = coordinates = sp.symbols("alpha_w phi psi")
d_alpha_w, d_phi, d_psi = rates = sp.symbols("d_alpha_w d_phi d_psi")
q, dq = sp.Matrix(coordinates), sp.Matrix(rates)
torque, moment = sp.symbols("torque moment")

# What the shortened equations are written in, and what it means.
alpha_b = sp.Symbol("alpha_b")
sin_phi, cos_phi, sin_theta, cos_theta, sin_psi, cos_psi = sp.symbols(
    "sin_phi cos_phi sin_theta cos_theta sin_psi cos_psi"
)
MEANING = {
    alpha_b: phi - alpha_w,
    sin_phi: sp.sin(phi),
    cos_phi: sp.cos(phi),
    sin_theta: sp.sin(psi - phi),
    cos_theta: sp.cos(psi - phi),
    sin_psi: sp.sin(psi),
    cos_psi: sp.cos(psi),
}


class Body(NamedTuple):
    """A rigid body: its mass, inertia about its centre, centre (x, y) and global angle."""

    mass: sp.Expr
    inertia: sp.Expr
    centre: sp.Matrix
    angle: sp.Expr


class Energies(NamedTuple):
    """Kinetic and potential energy with symbols for coefficients, and what these stand for."""

    kinetic: sp.Expr
    potential: sp.Expr
    coefficients: dict[sp.Symbol, sp.Expr]


def bodies(disturbed: bool) -> list[Body]:
    """List wheel, board, foot plate, the two legs and the pelvis; heights count from the wheel's centre."""
    tangent = sp.Matrix([sp.cos(phi), sp.sin(phi)])
    normal = sp.Matrix([-sp.sin(phi), sp.cos(phi)])
    along_legs = sp.Matrix([-sp.sin(psi), sp.cos(psi)])

    wheel = sp.Matrix([-r * alpha_w, 0])
    board = wheel + (r + h_b / 2) * normal + r * (phi - alpha_w) * tangent
    foot = board + (h_b + h_a) / 2 * normal
    ankles = board + (h_b / 2 + h_a) * normal
    off_centre = e_x * tangent + e_y * normal if disturbed else sp.zeros(2, 1)
    return [
        Body(m_w, m_w * r**2 / 2, wheel, alpha_w),
        Body(m_b, m_b * (L_b**2 + h_b**2) / 12, board, phi),
        Body(m_f, m_f * (L_f**2 + h_a**2) / 12, foot, phi),
        Body(2 * m_l, 2 * m_l * L_l**2 / 12, ankles + L_l / 2 * along_legs, psi),
        Body(m_p, I_p, ankles + L_l * along_legs + off_centre, phi),
    ]


def energies(parameters: Iterable[str], disturbed: bool) -> Energies:
    """Sum the energies T(q, dq) and V(q) over the bodies, and lump the parameters."""
    kinetic = potential = sp.Integer(0)
    gravity = sp.Matrix([g_x if disturbed else 0, -g])
    for mass, inertia, centre, angle in bodies(disturbed):
        velocity = centre.jacobian(q) * dq
        spin = (sp.Matrix([angle]).jacobian(q) * dq)[0]
        kinetic += mass * velocity.dot(velocity) / 2 + inertia * spin**2 / 2
        potential -= mass * gravity.dot(centre)
    return lump(shorten(kinetic), shorten(potential), list(parameters))


def shorten(expression: sp.Expr) -> sp.Expr:
    """Expand into alpha_b, rates, and sines and cosines that are not multiplied with each other."""
    names = {function: name for name, function in MEANING.items() if name is not alpha_b}
    names[sp.sin(phi - psi)] = -sin_theta  # as SymPy writes sin(psi - phi)
    summed = sp.expand(TR8(sp.expand(expression)))
    return sp.expand(summed.xreplace(names).subs(phi, alpha_w + alpha_b))


def lump(kinetic: sp.Expr, potential: sp.Expr, parameters: list[str]) -> Energies:
    """Replace the coefficients of shortened energies by as few symbols as there are different ones."""
    monomials: dict[sp.Poly, list] = {}  # constant without number: [(which energy, number, monomial)]
    for which, energy in enumerate((kinetic, potential)):
        polynomial = sp.Poly(energy, alpha_b, *rates, *list(MEANING)[1:], alpha_w)
        for powers, coefficient in polynomial.terms():
            number, constant = sp.Poly(coefficient, *sp.symbols(parameters), domain="QQ").primitive()
            monomial = sp.prod(x**power for x, power in zip(polynomial.gens, powers, strict=True))
            sign = sp.sign(constant.LC())
            monomials.setdefault(sign * constant, []).append((which, sign * number, monomial))

    sums: list[sp.Expr] = [sp.Integer(0), sp.Integer(0)]
    coefficients = {}
    for i, (constant, terms) in enumerate(monomials.items()):
        # Doubled where a rate is squared, so that the mass matrix gets the coefficient itself.
        scale = min(abs(n) * (2 if any(m.has(rate**2) for rate in rates) else 1) for _, n, m in terms)
        c = sp.Symbol(f"c{i}")
        coefficients[c] = scale * constant.as_expr()
        for which, number, monomial in terms:
            sums[which] += number / scale * c * monomial
    return Energies(sums[0], sums[1], coefficients)


def equations_of_motion(lumped: Energies, disturbed: bool) -> tuple[sp.Matrix, sp.Matrix]:
    """Mass matrix M (3, 3) and right-hand side f (3,) of M(q) ddq = f(q, dq, u).

    Euler-Lagrange: d/dt (dL/d(dq)) - dL/dq = Q. The torque turns the legs against the board: Q = (0, -u, u).
    """
    lagrangian = sp.Matrix([(lumped.kinetic - lumped.potential).subs(MEANING)])
    momentum = lagrangian.jacobian(dq).T
    forces = sp.Matrix([moment if disturbed else 0, -torque, torque])
    mass_matrix = momentum.jacobian(dq)
    right_hand_side = forces + lagrangian.jacobian(q).T - momentum.jacobian(q) * dq
    return mass_matrix.applyfunc(shorten), right_hand_side.applyfunc(shorten)


def solve_symmetric(m: sp.Matrix, f: sp.Matrix) -> sp.Matrix:
    """Solve m ddq = f for ddq (3,) by Cramer's rule: one division, no branches."""
    cofactors = m.adjugate()
    return cofactors * f / (m[0, :] * cofactors[:, 0])[0]
