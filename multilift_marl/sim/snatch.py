"""The peak of a snatch, which lasts less than a physics step: a slack cable that goes taut between moving ends.

MuJoCo's tension is the mean over a step. For the default cable and 1 m/s the force is 1000 N when it goes taut and down
to a half after 0.3 ms, so that mean depends on the time step. The peak does not: until the ends have turned round they
are two bodies on a spring and damper with what else acts on them nearly constant.
"""

from __future__ import annotations

from math import atan2, atanh, cos, cosh, exp, pi, sin, sinh, sqrt

from multilift_marl._jit import kernel


@kernel
def snatch_peak(speed, acceleration, mass, stiffness, damping):
    """Return the largest tension [N] of a cable that goes taut at a speed.

    With the stretch s, m s̈ = m a - k s - c ṡ and F = k s + c ṡ = m (a - y), where y = s̈ follows the same equation
    without a. F is largest at once, c v, if it falls from there, and else where ẏ first vanishes.

    Args:
        speed: at which the ends part as the cable goes taut, v > 0 [m/s].
        acceleration: at which they would part without the cable, a [m/s²].
        mass: m, with which the ends resist being pulled together [kg].
        stiffness, damping: k [N/m], c [N s/m].
    """
    start = acceleration - damping * speed / mass
    slope = -(stiffness * speed + damping * start) / mass
    if slope >= 0.0:
        return damping * speed
    square, decay = stiffness / mass, 0.5 * damping / mass
    # y = e^(-σ t) (y_0 C + (ẏ_0 + σ y_0) S/ω) and ẏ = e^(-σ t) (ẏ_0 C - (σ ẏ_0 + k/m y_0) S/ω), with sine and cosine
    # S, C of ω t, hyperbolic ones if the damping is more than critical.
    fall = decay * slope + square * start
    gap = square - decay * decay
    if gap > 1e-9 * square:
        rate = sqrt(gap)
        time = atan2(slope * rate, fall) / rate
        if time < 0.0:
            time += pi / rate
        even, odd = cos(rate * time), sin(rate * time) / rate
    elif gap < -1e-9 * square:
        rate = sqrt(-gap)
        if fall >= 0.0 or slope * rate <= fall:
            return damping * speed if acceleration <= 0.0 else max(damping * speed, mass * acceleration)
        time = atanh(slope * rate / fall) / rate
        even, odd = cosh(rate * time), sinh(rate * time) / rate
    else:
        time = slope / fall
        even, odd = 1.0, time
    lowest = exp(-decay * time) * (start * even + (slope + decay * start) * odd)
    return max(damping * speed, mass * (acceleration - lowest))
