"""Stiffness and damping of contact by the restitution that they are to have.

MuJoCo's contact pushes by k and d on depth and speed over the effective mass, never pulls, and is solved implicitly. By
default d stops an approach within a step. With a restitution e the contact is a spring and damper that lasts for many
steps, with the damping ratio ζ for which they part at e times the speed (Schwager and Pöschel 2007, without pull):

    e = exp(-2 ζ acos(ζ)/√(1 - ζ²)).

Implicit steps h damp too, by ω h/2 at the natural frequency ω, which is left out of d = 2 ω (ζ - ω h/2), k = ω².

Friction has a damping of its own. MuJoCo's convex contact pushes apart what it slows (Anitescu 2006): with 5000 1/s a
box that slides at 2 m/s is thrown up by 46 mm, with the 1e-9 of a high restitution it slides without end.
"""

from __future__ import annotations

from math import acos, acosh, exp, sqrt

STIFFNESS = 6e4  # [1/s²] over the effective mass; with DAMPING a penetration fades with a time constant of 80 ms
DAMPING = 5e3  # [1/s] over the effective mass: stops an approach within a step, without bouncing or passing through
FRICTION = 0.3  # [-] damping of sliding, times the step: more throws up what slides, less feeds what tumbles
STICKING = 10.0  # [-] by how much friction yields less than contact: what sticks does not creep
_BOUNCE = 0.3  # [-] ω h of a contact that bounces: it lasts for ten steps


def contact_law(restitution: float, timestep: float) -> tuple[float, float]:
    """Return stiffness [1/s²] and damping [1/s] over the effective mass that give a restitution.

    Args:
        restitution: e [-], from 0 to below 1.
        timestep: h [s].
    """
    if restitution == 0.0:
        return STIFFNESS, DAMPING
    ratio = _damping_ratio(restitution)
    # At ω h = 2 ζ the steps' own damping is all that is needed: d = 0.
    frequency = min(_BOUNCE, 2 * ratio) / timestep
    return frequency**2, max(2 * frequency * (ratio - frequency * timestep / 2), 1e-9)  # MuJoCo takes no zero


def _damping_ratio(restitution: float) -> float:
    """Return the ζ of a restitution, by bisection."""
    low, high = 0.0, 1e3
    for _ in range(100):
        ratio = (low + high) / 2
        if ratio < 1.0:
            # acos(ζ)/√(1 - ζ²), continued beyond critical damping, where it is 1 at ζ = 1.
            angle = acos(ratio) / sqrt(1.0 - ratio * ratio)
        else:
            angle = acosh(ratio) / sqrt(ratio * ratio - 1.0) if ratio > 1.0 else 1.0
        if exp(-2.0 * ratio * angle) > restitution:
            low = ratio
        else:
            high = ratio
    return low
