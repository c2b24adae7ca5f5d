"""What a lock-in and a peak detector see of a single-impact orbit, by dense sampling and quadrature in float64.

Conventions: rest is height 0, the response is z ~ a cos(omega t/N + phi), and t = 0 when the platform is highest.
"""

from typing import Any

import numpy as np

from tests.brute_force import Floats
from tests.reference_flight import Constants, platform, propagator


def pieces(k: Constants, order: int, leaving: float, after: float, flight: float) -> list[tuple[float, float, Any]]:
    """Return (start, end, z(t)) of the flight and of the piece in contact.

    In contact z = z_p; the length of that piece has the sign of the delay.
    """
    z0 = platform(k, leaving, np)[0]

    def in_flight(t: Floats) -> Floats:
        p11, p12, _, _ = propagator(k, t - leaving, np)
        return p11 * z0 + p12 * after

    end = leaving + order * k.drive_period
    return [(leaving, leaving + flight, in_flight), (leaving + flight, end, lambda t: platform(k, t, np)[0])]


def peak(k: Constants, order: int, leaving: float, after: float, flight: float) -> float:
    """Return the greatest height above rest: 20,001 samples of each piece, then a parabola through the best three."""
    best = -np.inf
    for start, end, height in pieces(k, order, leaving, after, flight):
        if end <= start:
            continue
        t = np.linspace(start, end, 20001)
        z = height(t)
        top = int(z.argmax())
        best = max(best, float(z[top]))
        if 0 < top < len(z) - 1:
            bend = z[top - 1] - 2 * z[top] + z[top + 1]
            best = max(best, float(z[top] - (z[top + 1] - z[top - 1]) ** 2 / (8 * bend)))
    return best


def lockin(k: Constants, order: int, leaving: float, after: float, flight: float) -> complex:
    """Return 2/T times the integral of z exp(-i omega t/N) over one response period T, by Gauss-Legendre panels."""
    nodes, weights = np.polynomial.legendre.leggauss(32)
    period = order * k.drive_period
    total = 0j
    for start, end, height in pieces(k, order, leaving, after, flight):
        edges = np.linspace(start, end, 16 * order + 1)
        half = 0.5 * (edges[1] - edges[0])
        t = edges[:-1, None] + half * (1 + nodes)
        total += complex(np.sum(half * weights * height(t) * np.exp(-1j * k.drive / order * t)))
    return 2 * total / period
