"""Taps: collisions of a tip on a bent lever, which pulls it away from the sample, as a table over speed and pull.

A cantilever that is shaken near its resonance meets the sample slowly, bent by nearly its amplitude: the
lever turns the tip round as much as the sample does. Gap 0 may be out of reach of the lever's motion alone, so that
speeds and times are those at the *plane*, the gap where the bridge breaks: beyond, the tip moves freely. At the plane
the pull is g (the acceleration of the gap), below it the lever adds its stiffness.

A tap is light, turned round in the bridge, or hard, with a solid junction. Light taps are followed from the gap where
they turn, hard ones from the energy with which the junction forms, against time to where they come from and with it to
where they go. Both are smooth functions of the squared speed at the plane, in Chebyshev's series, as are their
coefficients of ln g.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from afm_jax.apparatus.cantilever import Cantilever
from afm_jax.contact.bridge_leg import Way, collocate
from afm_jax.contact.contact import Contact
from afm_jax.contact.driven import Driven, free_tip
from afm_jax.contact.junction import find_junction
from afm_jax.contact.junction_leg import pass_through_junction
from afm_jax.contact.law_of_contact import tabulated
from afm_jax.impact.lasting_impact import PulledImpact, Taps, polynomials, stretched
from afm_jax.solve.derivatives import largest
from afm_jax.solve.lanes import compiled_quickly
from afm_jax.solve.quadrature import gauss_nodes

PULLS, SPEEDS = 7, 18
"""Pulls of a table, and speeds of light and of hard taps each."""
_NODES, _ITERATIONS, _JUNCTION, _ARC = 16, 6, 16, 6
_BARRIER_GAPS, _GAPS, _TURN_GAPS = 24, 32, 128
_DRAWN, _WIDEST = 1.1, 0.02
"""Weakest pull of light taps: over what the bridge draws, and over the strongest."""
_FARTHEST = 100.0
"""Speed with which a junction forms at most, in terms of the speed that hysteresis takes."""
_ABOVE, _ROUND = 0.05, 0.05
"""In terms of what hysteresis takes: energy of the weakest hard tap above what it needs to get away, and the width over
which this need is smoothed where another barrier becomes the highest."""


class _Near(NamedTuple):
    """D = scale exp(y^2), y linear in the fraction: smooth where the tip is slow at the inner end."""

    scale_nm: Float[Array, "..."]
    start_y: Float[Array, "..."]
    end_y: Float[Array, "..."]

    def at(self, fraction: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the gap in nm, and the path |dD| per fraction of the way."""
        width = self.end_y - self.start_y
        y = self.start_y + width * fraction
        gap = self.scale_nm * jnp.exp(y * y)
        return gap, 2.0 * width * y * gap


class _Stretch(NamedTuple):
    """Kinetic energy at the end in aJ; integrals over time of 1, gap, squared speed, gap times time and its square."""

    energy: Float[Array, ""]
    time: Float[Array, ""]
    gap: Float[Array, ""]
    action: Float[Array, ""]
    moment: Float[Array, ""]
    second: Float[Array, ""]


@compiled_quickly()
def tapped(contact: Contact, lever: Cantilever, pulls: Float[Array, " 2"]) -> PulledImpact:
    """Return the table of a contact's taps, differentiable in every parameter.

    Args:
        contact: the contact, of numbers.
        lever: for its mass and frequency.
        pulls: weakest and strongest pull at the plane, in nm/us^2.
    """
    junction = find_junction(contact)
    tip = free_tip(contact, junction, lever.mass_ng)._replace(lever_n_per_m=lever.stiffness_n_per_m)
    plane = tip.ends_nm
    # by how much the lever pulls more at gap 0 than at the plane
    raised = lever.angular_frequency**2 * plane
    near, far, off = junction.forms_gap_nm, tip.forms_nm, junction.breaks_gap_nm
    ends, more = _pull_ranges(tip, pulls, raised)
    # at gap 0, of shape (pulls, kinds): light taps, hard ones, and hard ones with hardly any pull
    first, last = ends + more
    pull = raised + first * (last / first) ** jnp.asarray(0.5 - 0.5 * _points(PULLS))[:, None] - more
    fraction = jnp.asarray(0.5 - 0.5 * _points(SPEEDS))
    taken = jnp.maximum(junction.hysteresis_aj, 1e-6)
    scale = jnp.sqrt(2.0 * taken / lever.mass_ng)

    def of_hard(g):
        bent = tip._replace(pull=g)
        formed = 0.5 * lever.mass_ng * (scale * jnp.sinh(stretched(jnp.asarray(_FARTHEST)) * fraction)) ** 2
        formed = formed + _needed(contact, bent, plane, taken)
        return formed, jax.vmap(lambda energy: pass_through_junction(bent, energy, _JUNCTION))(formed)

    # a light tap begins at rest where it turns, a hard one with the energies where the junction forms and breaks
    turns = jax.vmap(lambda g: _turns(tip._replace(pull=g), near, far))(pull[:, 0])
    nothing = jnp.zeros_like(turns)
    light = (turns, turns), (nothing, nothing), _Stretch(*(nothing,) * 6)
    formed, inside = jax.vmap(jax.vmap(of_hard))(pull[:, 1:])
    moments = (inside.time_us ** (n - 1) * inside.gap_nm_us / n for n in (2, 3))
    solid = _Stretch(inside.energy_aj, inside.time_us, inside.gap_nm_us, inside.action, *moments)
    hard = (jnp.full_like(formed, near), jnp.full_like(formed, off)), (formed, inside.energy_aj), solid
    lanes = jax.tree.map(lambda light, hard: jnp.concatenate([light[:, None], hard], axis=1), light, hard)

    def of_pull(g, lanes):
        return jax.vmap(lambda lane: _tap(contact, tip._replace(pull=g), plane, *lane))(lanes)

    taps = jax.vmap(jax.vmap(of_pull))(pull, lanes)
    return PulledImpact(_filled(taps, ends, more, far / near, scale), tabulated(contact, lever.mass_ng), plane)


def _pull_ranges(
    tip: Driven, pulls: Float[Array, " 2"], raised: Float[Array, ""]
) -> tuple[Float[Array, "2 kinds"], Float[Array, " kinds"]]:
    """Return weakest and strongest pull at the plane of the three kinds of taps, and what is added for the logarithm.

    The kinds are light taps, hard ones, and hard ones where the lever hardly pulls, or pushes.
    """
    near, far = tip.junction.forms_gap_nm, tip.forms_nm
    between = near * (far / near) ** jnp.linspace(0.0, 1.0, _GAPS)
    # where the bridge draws more than the lever pulls no tip turns round
    drawn = _DRAWN * largest(-tip.bridge.force(between)) / tip.mass_ng - raised
    least = jnp.maximum(pulls[0], _WIDEST * pulls[1])
    weakest = jnp.stack([jnp.maximum(least, drawn), least])
    ends = jnp.stack([weakest, jnp.maximum(pulls[1], 1.01 * weakest)])
    ends = jnp.concatenate([ends, jnp.stack([jnp.minimum(pulls[0], 0.5 * least), least])[:, None]], axis=1)
    return ends, jnp.maximum(raised - ends[0], 0.0) * jnp.array([0.0, 0.0, 1.0])


def _turns(tip: Driven, near: Float[Array, ""], far: Float[Array, ""]) -> Float[Array, " speeds"]:
    """Return the gaps where light taps turn whose speeds, but for the loss, are at the places of the series."""
    gaps = far * (near / far) ** jnp.linspace(0.0, 1.0, _TURN_GAPS)
    risen = tip.potential(gaps) - tip.potential(far)
    left = jnp.expm1(jnp.log(far / near) * jnp.asarray(0.5 + 0.5 * _points(SPEEDS))) / (far / near - 1.0)
    inner = jnp.exp(jnp.interp(risen[-1] * (1.0 - left), risen, jnp.log(gaps)))
    return jnp.concatenate([far[None], inner[1:-1], near[None]])


def _points(count: int) -> np.ndarray:
    """Return where Chebyshev's polynomials are largest, from 1 to -1."""
    return np.cos(np.pi * np.arange(count) / (count - 1))


def _filled(
    taps: "_Tap",
    pulls: Float[Array, "2 kinds"],
    more: Float[Array, " kinds"],
    gaps: Float[Array, ""],
    scale: Float[Array, ""],
) -> Taps:
    """Return the series through taps of shape (pulls, kinds, speeds), at places that the loss has shifted."""
    low, last = taps.coming[:, :, 0], taps.coming[:, :, -1]
    farthest = stretched(jnp.sqrt(last[:, 1:] - low[:, 1:]) / scale)
    high = jnp.concatenate([last[:, :1], farthest], axis=1)
    table = Taps(jnp.zeros(()), low, high, gaps, scale, pulls, more)
    inner = jax.vmap(lambda low, high, at: jax.vmap(replace(table, low=low, high=high).place, 1, 1)(at))(
        low, high, taps.coming[:, :, 1:-1]
    )
    # the root of 0 has no derivative
    edge = jnp.ones_like(low)[:, :, None]
    place = jnp.concatenate([-edge, inner, edge], axis=2)
    values = jnp.stack([taps.coming - taps.leaving, taps.time, taps.area, taps.action, taps.late, taps.spread], axis=-1)
    terms = jax.vmap(jax.vmap(_solved))(polynomials(place, SPEEDS), values)
    inverse = jnp.asarray(np.linalg.inv(np.polynomial.chebyshev.chebvander(-_points(PULLS), PULLS - 1)))
    return replace(
        table,
        **{
            name: jnp.tensordot(inverse, part, axes=1)
            for name, part in (("terms", terms), ("low", low), ("high", high))
        },
    )


def _solved(matrix: Float[Array, "n n"], values: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Return the solution of a system whose matrix is nearly that of Chebyshev's polynomials at Chebyshev's points.

    Written out: over sets and pulls the library's own has been seen to wait for itself for ever.
    """
    count = matrix.shape[0]
    near = jnp.asarray(np.linalg.inv(np.polynomial.chebyshev.chebvander(-_points(count), count - 1)))

    def eliminate(index, rows):
        own = rows[index] / rows[index, index]
        return (rows - rows[:, index, None] * own).at[index].set(own)

    return lax.fori_loop(0, count, eliminate, near @ jnp.concatenate([matrix, values], axis=1))[:, count:]


def _needed(contact: Contact, tip: Driven, plane: Float[Array, ""], taken: Float[Array, ""]) -> Float[Array, ""]:
    """Return the energy in aJ with which the junction must form for the tip to come from the plane and to get back."""
    junction = tip.junction
    fraction = jnp.asarray(np.linspace(0.0, 1.0, _BARRIER_GAPS))
    on, breaks = junction.forms_gap_nm, junction.breaks_gap_nm
    out, back = breaks * (plane / breaks) ** fraction, on * (contact.bridge_forms_nm / on) ** fraction
    leaving = tip.elastic_aj - tip.pulled_aj(on, breaks) + tip.potential(out) - tip.potential(breaks)
    coming = tip.potential(back) - tip.potential(on)
    most = jnp.maximum(largest(leaving), largest(coming)) + _ABOVE * taken
    # a rounded maximum with a little energy
    least, width = _ABOVE * taken, _ROUND * taken
    return 0.5 * (most + least + jnp.sqrt((most - least) ** 2 + width**2))


class _Tap(NamedTuple):
    """Squared speeds at the plane, in and out, and integrals of a tap."""

    coming: Float[Array, "..."]
    leaving: Float[Array, "..."]
    time: Float[Array, "..."]
    area: Float[Array, "..."]
    action: Float[Array, "..."]
    late: Float[Array, "..."]
    spread: Float[Array, "..."]


def _tap(contact: Contact, tip: Driven, plane, gaps, energies, solid: _Stretch) -> _Tap:
    """Return a tap from the inner gaps of its ways in and out, with the kinetic energies there, and what is between."""

    def way(arrow, inner, outer, energy):
        return _outward(tip._replace(bridge=replace(tip.bridge, arrow=arrow)), inner, outer, energy)

    ends = jnp.stack([contact.bridge_forms_nm, plane])
    both = jax.vmap(way)(jnp.array([-1.0, 1.0]), jnp.stack(gaps), ends, jnp.stack(energies))
    coming, leaving = (jax.tree.map(lambda part, one=one: part[one], both) for one in (0, 1))
    before = _after(coming, _arc(tip, contact.bridge_forms_nm, plane, coming.energy))
    leaving = _after(solid, leaving)
    time, gap = before.time + leaving.time, before.gap + leaving.gap
    area = plane * time - gap
    # the middle of the tap is later than its turning by half of what its ways out and in differ by
    apart = 0.5 * (leaving.time - before.time)
    behind = leaving.moment - before.moment - apart * gap
    second = before.second + leaving.second - apart * (2.0 * behind + apart * gap)
    twice = 2.0 / tip.mass_ng
    return _Tap(
        coming=twice * before.energy,
        leaving=twice * leaving.energy,
        time=time,
        area=area,
        action=before.action + leaving.action,
        late=-behind / area,
        spread=(plane * time**3 / 12.0 - second) / area,
    )


def _after(first: _Stretch, second: _Stretch) -> _Stretch:
    """Return two legs, one after the other."""
    return _Stretch(
        energy=second.energy,
        time=first.time + second.time,
        gap=first.gap + second.gap,
        action=first.action + second.action,
        moment=first.moment + second.moment + first.time * second.gap,
        second=first.second + second.second + first.time * (2.0 * second.moment + first.time * second.gap),
    )


def _outward(tip: Driven, inner, outer, energy) -> _Stretch:
    """Return the way from an inner gap to an outer one, left with a kinetic energy."""
    push = -(tip.potential(inner * 1.001) - tip.potential(inner * 0.999)) / 0.002
    # how far inside the speed would vanish, in ln D
    margin = jnp.where(energy < push, jnp.maximum(energy, 0.0) / jnp.where(energy < push, push, 1.0), 1.0)
    margin = lax.stop_gradient(jnp.clip(margin, 1e-14, 1.0))
    start = jnp.sqrt(margin)
    course: Any = _Near(inner * jnp.exp(-margin), start, jnp.sqrt(margin + jnp.log(outer / inner)))
    total = energy + tip.potential(inner)
    slowest = 1e-9 * jnp.abs(tip.potential(outer) - tip.potential(inner)) + 1e-12
    collocation = collocate(
        Way(tip, -1.0, jnp.zeros(()), total, tip.potential(outer), course, slowest), _NODES, _ITERATIONS
    )
    return _stretch(collocation.passage.energy_aj, collocation.at.gap_nm, collocation.speed, collocation.time_slope)


def _arc(tip: Driven, inner, outer, energy) -> _Stretch:
    """Return the way of the lever alone: at the places of a steady pull, whose square root is thereby gone."""
    end = energy + tip.pulled_aj(inner, outer)
    first, last = (jnp.sqrt(2.0 / tip.mass_ng * jnp.maximum(one, 1e-9)) for one in (energy, end))
    fraction = jnp.asarray(gauss_nodes(_ARC)[0])
    time, steady = 2.0 * (outer - inner) / (first + last), first + (last - first) * fraction
    gap = inner + 0.5 * time * fraction * (first + steady)
    speed = jnp.sqrt(2.0 / tip.mass_ng * jnp.maximum(energy + tip.pulled_aj(inner, gap), 1e-9))
    return _stretch(end, gap, speed, time * steady / speed)


def _stretch(energy, gap, speed, time_slope) -> _Stretch:
    """Return a way from what it ends with, and gap, speed and time per fraction at Gauss nodes."""
    _, weights, cumulative = (jnp.asarray(part) for part in gauss_nodes(gap.shape[0]))
    lasted = cumulative @ time_slope
    parts = jnp.ones_like(gap), gap, speed**2, gap * lasted, gap * lasted**2
    return _Stretch(energy, *(weights @ (time_slope * part) for part in parts))
