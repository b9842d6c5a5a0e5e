"""Plane curves in closed form: their points, derivatives and, by exact arc length, headings and curvatures.

World: x, y in metres, angles counter-clockwise from +x; a curvature is positive to the left. Every curve
starts at parameter 0 and is exact at any parameter and any arc length.
"""

from __future__ import annotations

import inspect
import math
import numbers
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy.interpolate
import scipy.special
from numpy.typing import ArrayLike, NDArray

from pipelines.simulation.channels import rng_of

Floats = NDArray[np.float64]

# a Gauss-Legendre rule of eight nodes, and the end of the interval with no weight: its speed is needed too
_NODES, _WEIGHTS = (np.append(rule, end) for rule, end in zip(np.polynomial.legendre.leggauss(8), (1, 0), strict=True))
_CLOSE_M = 1e-9  # a curve is closed when its ends meet so closely


class Frenet(NamedTuple):
    """A curve at n arc lengths.

    Attributes:
        point_m: x and y [2, n].
        heading_rad: direction of the tangent, continuous over full turns [n].
        curvature: its derivative by the arc length, 1/m [n].
        curvature_rate: second derivative, 1/m² [n].
    """

    point_m: Floats
    heading_rad: Floats
    curvature: Floats
    curvature_rate: Floats


class Curve(ABC):
    """A plane curve p(t) from t = 0, differentiable three times but for the joints of its pieces.

    Attributes:
        closed: whether it ends where it began and goes round again, either way.
        length_m: length of one round, or of an open curve; infinite where the curve does not end.
    """

    closed: bool = False

    @property
    @abstractmethod
    def length_m(self) -> float:
        """Length of one round, or of an open curve; infinite where the curve does not end."""

    @abstractmethod
    def derivative(self, t: Floats, order: int) -> Floats:
        """The derivative of that order, 0 to 3, by the parameter: [2, ...] for parameters [...]."""

    @abstractmethod
    def measured(self, start_m: float, stop_m: float) -> Callable[[Floats], Frenet]:
        """The curve by its arc length, for arc lengths from `start_m` to `stop_m`."""

    def point(self, t: ArrayLike) -> Floats:
        """Points [..., 2] in metres."""
        return np.moveaxis(self.derivative(np.asarray(t, dtype=np.float64), 0), 0, -1)

    def tangent(self, t: ArrayLike) -> Floats:
        """First derivative [..., 2]."""
        return np.moveaxis(self.derivative(np.asarray(t, dtype=np.float64), 1), 0, -1)

    def along(self, start_m: float, stop_m: float) -> Callable[[Floats], Frenet]:
        """`measured`, for arc lengths that must lie on the curve (to 1e-9 of its length).

        Raises:
            ValueError: they lead beyond an end of the curve.
        """
        slack = 1e-9 * self.length_m
        if not self.closed and math.isfinite(slack) and (start_m < -slack or stop_m > self.length_m + slack):
            raise ValueError(
                f"the drive leads from {start_m:.6g} m to {stop_m:.6g} m of a curve of {self.length_m:.6g} m: "
                "drive less long or make the curve longer"
            )
        return self.measured(start_m, stop_m)


# --------------------------------------------------- arc length where no formula gives it


class SmoothCurve(Curve):
    """A curve in any parameter, whose arc length is integrated and inverted numerically to the last digits.

    Attributes:
        panel: width in the parameter over which the curve is smooth.
        end: parameter of the end of an open curve, or of one round; infinite where the curve does not end.
    """

    panel: float
    end: float = math.inf

    @cached_property
    def length_m(self) -> float:
        """Length of one round, or of an open curve; infinite where the curve does not end."""
        if math.isinf(self.end):
            return math.inf
        edges = _refined(self, np.linspace(0.0, self.end, 1 + math.ceil(self.end / self.panel)))
        return math.fsum(_arc_lengths(self, edges[:-1], edges[1:]))

    def measured(self, start_m: float, stop_m: float) -> Callable[[Floats], Frenet]:
        """The curve by its arc length, for arc lengths from `start_m` to `stop_m`."""
        return ArcLength(self, start_m, stop_m)


class ArcLength:
    """A smooth curve by its arc length.

    The arc length ∫|p'| dt is summed up over panels, each fine enough for a Gauss-Legendre rule of eight
    nodes; the parameter of an arc length is found by Newton's method on the last panel's integral.
    What is found for an arc length depends on nothing else that is asked for.

    Args:
        curve: the curve.
        start_m: least arc length that will be asked for.
        stop_m: greatest one.

    Raises:
        ValueError: the curve has a cusp there.
    """

    def __init__(self, curve: SmoothCurve, start_m: float, stop_m: float) -> None:
        behind, ahead = _panels(curve, -1, min(start_m, 0.0)), _panels(curve, 1, max(stop_m, 0.0))
        t = np.concatenate([behind[:0:-1], ahead])
        zero = len(behind) - 1
        s = np.concatenate([[0.0], np.cumsum(_arc_lengths(curve, t[:-1], t[1:]))])
        tangent = curve.derivative(t, 1)
        heading = np.unwrap(np.arctan2(tangent[1], tangent[0]))
        whole_turns = np.rint((heading[zero] - np.arctan2(tangent[1, zero], tangent[0, zero])) / (2 * np.pi))
        self._curve, self._t, self._s = curve, t, s - s[zero]
        self._heading, self._pace = heading - 2 * np.pi * whole_turns, 1 / _norm(tangent)

    def parameter(self, s_m: Floats) -> Floats:
        """The parameters [n] of arc lengths [n]."""
        k = self._panel(s_m)
        start, width = self._t[k], self._t[k + 1] - self._t[k]
        length, target = self._s[k + 1] - self._s[k], s_m - self._s[k]
        # a cubic through both ends with the right slopes is a good first guess
        x = target / length
        first, last = self._pace[k] * length, self._pace[k + 1] * length
        t: Floats = start + x * (first + x * (3 * width - 2 * first - last + x * (first + last - 2 * width)))
        active = np.ones(np.shape(s_m), dtype=bool)
        for _ in range(20):
            length, speed = _arc(self._curve, start, t)
            step = np.where(active, (target - length) / speed, 0.0)
            t = t + step
            active &= np.abs(step) > 1e-9 * width  # Newton squares the error: the next step would be nothing
            if not active.any():
                break
        return t

    def __call__(self, s_m: Floats) -> Frenet:
        """The curve at arc lengths [n]."""
        t = self.parameter(s_m)
        point, p1, p2, p3 = (self._curve.derivative(t, order) for order in range(4))
        speed = _norm(p1)
        cross, along = p1[0] * p2[1] - p1[1] * p2[0], p1[0] * p2[0] + p1[1] * p2[1]
        cross_rate = p1[0] * p3[1] - p1[1] * p3[0]
        angle = np.arctan2(p1[1], p1[0])
        return Frenet(
            point_m=point,
            heading_rad=angle + 2 * np.pi * np.rint((self._heading[self._panel(s_m)] - angle) / (2 * np.pi)),
            curvature=cross / speed**3,
            curvature_rate=(cross_rate - 3 * cross * along / speed**2) / speed**4,
        )

    def _panel(self, s_m: Floats) -> NDArray[np.intp]:
        """Numbers [n] of the panels where arc lengths [n] lie."""
        k: NDArray[np.intp] = np.searchsorted(self._s, s_m, side="right") - 1
        return np.minimum(np.maximum(k, 0), len(self._s) - 2)


def _norm(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt(vectors[0] ** 2 + vectors[1] ** 2))


def _arc(curve: Curve, start: Floats, stop: Floats) -> tuple[Floats, Floats]:
    """Signed arc lengths [n] between parameters [n], by one Gauss-Legendre rule each, and |p'| at the end [n]."""
    half = (stop - start) / 2
    speeds = _norm(curve.derivative(start[:, None] + half[:, None] * (1 + _NODES), 1))
    return half * (speeds * _WEIGHTS).sum(-1), speeds[:, -1]


def _arc_lengths(curve: Curve, start: Floats, stop: Floats) -> Floats:
    return _arc(curve, start, stop)[0]


def _refined(curve: Curve, edges: Floats) -> Floats:
    """Edges of panels, halved until halving changes no arc length and the curve turns little in each."""
    for _ in range(40):
        start, stop = edges[:-1], edges[1:]
        middle = (start + stop) / 2
        whole, halves = _arc_lengths(curve, start, stop), _arc_lengths(curve, start, middle)
        halves = halves + _arc_lengths(curve, middle, stop)
        tangent = curve.derivative(edges, 1)
        (ax, bx), (ay, by) = ((way[:-1], way[1:]) for way in tangent)
        turn = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
        # far out the nodes themselves are rounded, and no halving helps against that
        rounding = 4 * np.finfo(np.float64).eps * np.abs(stop) / np.abs(stop - start)
        coarse = (np.abs(whole - halves) > (1e-14 + rounding) * np.abs(halves)) | (np.abs(turn) > 0.5)
        if not coarse.any():
            return edges
        edges = np.insert(edges, np.flatnonzero(coarse) + 1, middle[coarse])
    raise ValueError("the curve has a cusp, where it has no heading: change its parameters")


def _panels(curve: SmoothCurve, sign: int, reach_m: float) -> Floats:
    """Edges of panels from parameter 0 until the arc length is `reach_m` or an open curve ends."""
    edges, length, n = [np.zeros(1)], 0.0, 0
    endless = curve.closed or math.isinf(curve.end)
    last = math.inf if endless else round(curve.end / curve.panel)
    if sign < 0 and (reach_m == 0 or not endless):
        return edges[0]
    while n == 0 or (abs(length) < abs(reach_m) and n < last):
        more = int(min(n + max(32, n // 2), last))
        block = _refined(curve, np.arange(n, more + 1, dtype=np.float64) * (sign * curve.panel))
        length += float(np.sum(_arc_lengths(curve, block[:-1], block[1:])))
        edges.append(block[1:])
        n = more
    return np.concatenate(edges)


def _quarter_turns(phase: Floats, n: int) -> tuple[Floats, Floats]:
    """Cosine and sine of phase + nπ/2: the n-th derivatives of a point that runs round the unit circle."""
    cos, sin = np.cos(phase), np.sin(phase)
    return ((cos, sin), (-sin, cos), (-cos, -sin), (sin, -cos))[n % 4]


class Wave(NamedTuple):
    """`cosine` cos ωt + `sine` sin ωt, vectors (x, y) in metres."""

    omega: float
    cosine: tuple[float, float]
    sine: tuple[float, float]


class Waves(SmoothCurve):
    """A uniform motion and a sum of waves: p(t) = origin + drift t + Σ (cosine_k cos ω_k t + sine_k sin ω_k t).

    Args:
        waves: the waves.
        drift: (x, y) in metres for each unit of the parameter.
        origin: (x, y) in metres.
        end: the parameter after which a closed curve begins again.
    """

    def __init__(
        self,
        waves: Sequence[Wave],
        *,
        drift: tuple[float, float] = (0.0, 0.0),
        origin: tuple[float, float] = (0.0, 0.0),
        end: float = math.inf,
    ) -> None:
        self._waves = tuple((wave.omega, np.array(wave.cosine), np.array(wave.sine)) for wave in waves)
        self._drift, self._origin = np.array(drift), np.array(origin)
        self.end, self.closed = end, math.isfinite(end)
        self.panel = math.pi / 4 / max((wave.omega for wave in waves), default=1.0)

    def derivative(self, t: Floats, order: int) -> Floats:
        """The derivative of that order by the parameter: [2, ...]."""
        straight = (t, np.ones_like(t), np.zeros_like(t), np.zeros_like(t))[order]
        out: Floats = np.multiply.outer(self._drift, straight)
        if order == 0:
            out += self._origin.reshape(2, *[1] * np.ndim(t))
        for omega, cosine, sine in self._waves:
            cos, sin = _quarter_turns(omega * t, order)
            size = omega**order
            out += np.multiply.outer(size * cosine, cos)
            out += np.multiply.outer(size * sine, sin)
        return out


class Spiral(SmoothCurve):
    """An Archimedean spiral (start + rate t)(cos t, sin t)."""

    panel = math.pi / 4

    def __init__(self, start_m: float, rate_m: float) -> None:
        self._start_m, self._rate_m = start_m, rate_m

    def derivative(self, t: Floats, order: int) -> Floats:
        """The derivative of that order by the parameter: [2, ...]."""
        out = (self._start_m + self._rate_m * t) * np.stack(_quarter_turns(t, order))
        if order:
            out += order * self._rate_m * np.stack(_quarter_turns(t, order - 1))
        return np.asarray(out)


class Spline(SmoothCurve):
    """A cubic spline through points [n, 2]; the parameter counts them, in between it follows their distances."""

    panel = 0.25

    def __init__(self, points: Floats, *, closed: bool) -> None:
        points = np.concatenate([points, points[:1]]) if closed else points
        knots = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        self._spline = scipy.interpolate.CubicSpline(knots, points, bc_type="periodic" if closed else "not-a-knot")
        self._knots, self._gaps = knots, np.diff(knots)
        self.closed, self.end = closed, float(len(self._gaps))

    def derivative(self, t: Floats, order: int) -> Floats:
        """The derivative of that order by the parameter: [2, ...]."""
        n = len(self._gaps)
        whole = np.floor(t) if self.closed else np.clip(np.floor(t), 0, n - 1)
        k = whole.astype(np.intp) % n
        chord = self._knots[k] + (t - whole) * self._gaps[k]
        return np.asarray(np.moveaxis(self._spline(chord, order), -1, 0) * self._gaps[k] ** order)


# ------------------------------------------------------- curves whose parameter is the arc length


class Piece(NamedTuple):
    """A stretch of a way: its curvature rises by `rate` (1/m²) a metre from `curvature` (1/m) on."""

    length_m: float
    curvature: float = 0.0
    rate: float = 0.0


class Pieces(Curve):
    """Straight lines, circular arcs and clothoids, tangent to one another; the parameter is the arc length.

    At a joint of pieces of different curvature the angular velocity of a body that follows it jumps.

    Args:
        pieces: the pieces in their order.
        origin: x and y of the start in metres.
        heading_rad: direction at the start.
        closed: whether the way begins again at its end.

    Raises:
        ValueError: a piece has no length, or a closed way does not close.
    """

    def __init__(
        self,
        pieces: Sequence[Piece],
        *,
        origin: tuple[float, float] = (0.0, 0.0),
        heading_rad: float = 0.0,
        closed: bool = False,
    ) -> None:
        if not pieces or min(piece.length_m for piece in pieces) <= 0:
            raise ValueError("a way of pieces needs pieces, each longer than 0 m")
        self.closed = closed
        self._curvature, self._rate = (np.array(column) for column in list(zip(*pieces, strict=True))[1:])
        lengths = np.array([piece.length_m for piece in pieces])
        self._s = np.concatenate([[0.0], np.cumsum(lengths)])
        turns = lengths * (self._curvature + self._rate * lengths / 2)
        self._heading = heading_rad + np.concatenate([[0.0], np.cumsum(turns)])
        steps = self._step(np.arange(len(pieces)), lengths)
        self._points = np.array(origin)[:, None] + np.concatenate([np.zeros((2, 1)), np.cumsum(steps, axis=1)], axis=1)
        gap = self._points[:, -1] - self._points[:, 0]
        if closed and np.hypot(*gap) > _CLOSE_M:
            raise ValueError(f"the way ends {np.hypot(*gap):.3g} m from where it began: it is not closed")

    @property
    def length_m(self) -> float:
        """Length of all pieces."""
        return float(self._s[-1])

    @property
    def joints_m(self) -> Floats:
        """Arc lengths [n + 1] where pieces begin and the last one ends."""
        return self._s.copy()

    def measured(self, start_m: float, stop_m: float) -> Callable[[Floats], Frenet]:
        """The curve by its arc length; it is known for any."""
        return self.frenet

    def frenet(self, s_m: Floats) -> Frenet:
        """The curve at arc lengths [...]; beyond its ends an open way goes on as its first and last piece."""
        rounds = np.floor(s_m / self.length_m) if self.closed else np.zeros(np.shape(s_m))
        s = s_m - rounds * self.length_m
        k = np.clip(np.searchsorted(self._s, s, side="right") - 1, 0, len(self._rate) - 1)
        u = s - self._s[k]
        turned = self._heading[-1] - self._heading[0]
        return Frenet(
            point_m=self._points[:, k] + self._step(k, u),
            heading_rad=self._heading[k] + u * (self._curvature[k] + self._rate[k] * u / 2) + rounds * turned,
            curvature=self._curvature[k] + self._rate[k] * u,
            curvature_rate=self._rate[k] + np.zeros(np.shape(s_m)),
        )

    def derivative(self, t: Floats, order: int) -> Floats:
        """The derivative of that order by the arc length: [2, ...]."""
        at = self.frenet(t)
        tangent = np.stack([np.cos(at.heading_rad), np.sin(at.heading_rad)])
        normal = np.stack([-tangent[1], tangent[0]])
        if order == 0:
            return at.point_m
        if order == 1:
            return tangent
        if order == 2:
            return np.asarray(at.curvature * normal)
        return np.asarray(at.curvature_rate * normal - at.curvature**2 * tangent)

    def _step(self, k: NDArray[np.intp], u: Floats) -> Floats:
        """Way [2, ...] from the start of pieces k to `u` metres into them: ∫ exp(i(θ + κv + cv²/2)) dv."""
        heading, curvature, rate = self._heading[k], self._curvature[k], self._rate[k]
        half = curvature * u / 2
        chord = u * np.sinc(half / np.pi)
        step = np.stack([chord * np.cos(heading + half), chord * np.sin(heading + half)])
        bent = rate != 0
        if np.any(bent):
            step[:, bent] = _clothoid(heading[bent], curvature[bent], rate[bent], u[bent])
        return step


def _clothoid(heading: Floats, curvature: Floats, rate: Floats, length: Floats) -> Floats:
    """∫ exp(i(θ + κv + cv²/2)) dv from 0 to `length` [2, n], c ≠ 0, by Fresnel's integrals.

    With the square completed, θ + κv + cv²/2 = θ - κ²/(2c) ± (π/2) x², x = (v + κ/c) √(|c|/π).
    """
    scale, sign = np.sqrt(np.abs(rate) / np.pi), np.sign(rate)
    sine_0, cosine_0 = scipy.special.fresnel(scale * curvature / rate)
    sine_1, cosine_1 = scipy.special.fresnel(scale * (length + curvature / rate))
    x, y = (cosine_1 - cosine_0) / scale, sign * (sine_1 - sine_0) / scale
    base = heading - curvature**2 / (2 * rate)
    cos, sin = np.cos(base), np.sin(base)
    return np.stack([cos * x - sin * y, sin * x + cos * y])


def _corner(turn_rad: float, radius_m: float, ease: float) -> tuple[Piece, ...]:
    """A turn by `turn_rad`: a clothoid, an arc, a clothoid; the clothoids make the share `ease` of the turn."""
    angle, curvature = abs(turn_rad), math.copysign(1 / radius_m, turn_rad)
    eased, arc = ease * angle * radius_m, (1 - ease) * angle * radius_m
    pieces = (
        Piece(eased, 0.0, curvature / eased if eased else 0.0),
        Piece(arc, curvature),
        Piece(eased, curvature, -curvature / eased if eased else 0.0),
    )
    return tuple(piece for piece in pieces if piece.length_m > 0)


def _chord(pieces: Sequence[Piece]) -> float:
    """Distance from the start to the end of pieces."""
    way = Pieces(pieces)
    return float(_norm(way.derivative(np.array(way.length_m), 0)))


# ------------------------------------------------------------------------------- by name


def line(heading_rad: float = 0.0) -> Curve:
    """A straight line from the origin."""
    return Waves((), drift=(math.cos(heading_rad), math.sin(heading_rad)))


def circle(radius_m: float = 1.2) -> Curve:
    """A circle from the origin, starting along +x, to the left; a negative radius gives its mirror image behind."""
    _demand(radius_m != 0, f"a circle of radius {radius_m} m")
    return Waves(
        [Wave(1.0, (0.0, -radius_m), (radius_m, 0.0))],
        origin=(0.0, radius_m),
        end=2 * math.pi,
    )


def square(side_m: float = 2.0, corner_m: float = 0.3, ease: float = 0.0) -> Curve:
    """A square with rounded corners, from the origin along +x, to the left.

    Args:
        side_m: distance of opposite sides.
        corner_m: least radius of the corners.
        ease: share of each corner's turn that is made in clothoids, 0…1; with 0 the corners are arcs and the
            curvature jumps, above it is continuous.
    """
    _demand(side_m > 0 and corner_m > 0, f"a square of {side_m} m with corners of {corner_m} m")
    _demand_ease(ease)
    cut = _cut(math.pi / 2, corner_m, ease)
    points = np.array([[0, 0], [side_m, 0], [side_m, side_m], [0, side_m]], dtype=np.float64) - [cut, 0]
    return polyline(points, corner_m, ease, closed=True)


def figure_eight(length_m: float = 3.45, width_m: float = 1.37, start_rad: float = 0.0) -> Curve:
    """The figure eight (length sin t, width sin 2t) of the paper's test, 19 m a round; it crosses itself.

    It starts at t = `start_rad`, at the crossing for 0.
    """
    _demand(length_m != 0 and width_m != 0, f"a figure eight of {length_m} m by {width_m} m")
    sin, cos, sin2, cos2 = (f(k * start_rad) for k in (1, 2) for f in (math.sin, math.cos))
    long = Wave(1.0, (length_m * sin, 0.0), (length_m * cos, 0.0))
    wide = Wave(2.0, (0.0, width_m * sin2), (0.0, width_m * cos2))
    return Waves([long, wide], end=2 * math.pi)


def spiral(start_m: float = 0.5, pitch_m: float = 0.6) -> Curve:
    """An Archimedean spiral that opens by `pitch_m` a turn and never meets itself."""
    _demand(start_m >= 0 and pitch_m > 0, f"a spiral from {start_m} m by {pitch_m} m a turn")
    return Spiral(start_m, pitch_m / (2 * math.pi))


def serpentine(amplitude_m: float = 0.4, wavelength_m: float = 2.4) -> Curve:
    """A sine along +x: left and right in turns; it never meets itself."""
    _demand(wavelength_m > 0, f"a serpentine of wavelength {wavelength_m} m")
    return Waves([Wave(2 * math.pi / wavelength_m, (0.0, 0.0), (0.0, amplitude_m))], drift=(1.0, 0.0))


def wander(amplitude_m: float = 0.6, wavelength_m: float = 6.0, n_waves: int = 5, seed: int = 0) -> Curve:
    """A free way along +x that never repeats and never meets itself: sines of random lengths and phases.

    Args:
        amplitude_m: rms of the way's distance from its middle line.
        wavelength_m: the longest wave; the others are down to a third of it.
        n_waves: number of waves.
        seed: seed of their lengths and phases.
    """
    _demand(amplitude_m >= 0 and wavelength_m > 0 and n_waves > 0, f"{n_waves} waves of {amplitude_m}/{wavelength_m} m")
    rng = rng_of(seed, "wander")
    omegas = 2 * math.pi / wavelength_m * 3 ** rng.uniform(0, 1, n_waves)
    phases = rng.uniform(0, 2 * math.pi, n_waves)
    size = amplitude_m * math.sqrt(2 / n_waves)
    waves = [
        Wave(float(w), (0.0, size * math.sin(p)), (0.0, size * math.cos(p)))
        for w, p in zip(omegas, phases, strict=True)
    ]
    return Waves(waves, drift=(1.0, 0.0), origin=(0.0, -size * float(np.sin(phases).sum())))


def hypotrochoid(size_m: float = 1.5, petals: int = 5, winding: int = 2, loop: float = 0.2) -> Curve:
    """A closed star or rosette of `petals` loops that crosses itself, about the origin from (size, 0).

    p = size/(1 + loop) (exp(i w t) + loop exp(-i (n - w) t)) for n petals and winding w.

    Args:
        size_m: greatest distance from the origin.
        petals: number of loops n.
        winding: turns of the slower circle w, without a common factor with n.
        loop: radius of the faster circle against that of the slower.
    """
    fast = petals - winding
    _demand(
        size_m > 0 and winding > 0 and fast > 0, f"a hypotrochoid of {size_m} m, {petals} petals, winding {winding}"
    )
    _demand(math.gcd(petals, winding) == 1, f"{petals} petals and winding {winding} with a common factor")
    _demand(loop > 0 and abs(winding - loop * fast) > 0.05 * winding, f"a loop of {loop}, which makes cusps or none")
    slow_m = size_m / (1 + loop)
    fast_m = loop * slow_m
    return Waves(
        [Wave(winding, (slow_m, 0.0), (0.0, slow_m)), Wave(fast, (fast_m, 0.0), (0.0, -fast_m))], end=2 * math.pi
    )


def spline(points: ArrayLike, closed: bool = False) -> Curve:
    """A smooth way through points [n, 2] in metres; its curvature is continuous.

    Raises:
        ValueError: fewer than two points (three of a closed way), or the same one twice in a row.
    """
    return Spline(_points(points, closed), closed=closed)


def polyline(points: ArrayLike, corner_m: float = 0.3, ease: float = 0.0, closed: bool = False) -> Curve:
    """Straight lines through way points [n, 2] in metres with rounded corners.

    An open way begins and ends at its first and last point, a closed one begins after the first corner.

    Args:
        points: way points.
        corner_m: least radius of the corners.
        ease: share of each corner's turn that is made in clothoids, 0…1; with 0 the corners are arcs and the
            curvature jumps, above it is continuous.
        closed: whether the way leads back to the first point and round again.

    Raises:
        ValueError: too few points, the same one twice in a row, a way straight back, or two corners that
            do not fit between their points.
    """
    array = _points(points, closed)
    _demand(corner_m > 0, f"corners of {corner_m} m")
    _demand_ease(ease)
    legs = np.diff(np.concatenate([array, array[:1]]) if closed else array, axis=0)
    lengths, headings = np.hypot(*legs.T), np.arctan2(legs[:, 1], legs[:, 0])
    turns = (np.diff(headings, append=headings[0]) + np.pi) % (2 * np.pi) - np.pi  # at the end of each leg
    if not closed:
        turns[-1] = 0.0
    _demand(bool(np.all(np.abs(turns) < np.pi - 1e-6)), "a way straight back")
    cuts = np.array([_cut(float(turn), corner_m, ease) for turn in turns])
    straight = lengths - cuts - np.roll(cuts, 1)
    if np.min(straight) < -1e-12:
        k = int(np.argmin(straight))
        raise ValueError(
            f"the corners at both ends of leg {k} of {lengths[k]:.3g} m need {lengths[k] - straight[k]:.3g} m: "
            "take smaller corners"
        )
    pieces = []
    for length, turn in zip(straight, turns, strict=True):
        pieces += [Piece(float(length))] if length > 1e-12 else []
        pieces += _corner(float(turn), corner_m, ease)
    start = array[0] + cuts[-1] * legs[0] / lengths[0]
    return Pieces(pieces, origin=(float(start[0]), float(start[1])), heading_rad=float(headings[0]), closed=closed)


def lanes(length_m: float = 10.0, spacing_m: float = 1.5, count: int = 7, ease: float = 0.0) -> Curve:
    """Patrol lanes: `count` parallel straight lines, forth and back along x, joined by half turns.

    From the origin along +x; each lane lies `spacing_m` to the left of the one before (to the right for a
    negative spacing). The way is count · length + (count - 1) · π/2 · spacing long with `ease` 0.

    Args:
        length_m: length of the straight lines.
        spacing_m: distance of neighbouring lanes.
        count: number of lanes.
        ease: share of each turn that is made in clothoids, 0…1; with 0 the turns are half circles and the
            curvature jumps, above it is continuous.
    """
    _demand(length_m > 0 and spacing_m != 0 and count > 0, f"{count} lanes of {length_m} m every {spacing_m} m")
    _demand_ease(ease)
    radius_m = abs(spacing_m) / _chord(_corner(math.pi, 1.0, ease))
    pieces = [Piece(length_m)]
    for k in range(count - 1):
        turn = math.copysign(math.pi, spacing_m) * (-1) ** k
        pieces += [*_corner(turn, radius_m, ease), Piece(length_m)]
    return Pieces(pieces)


CURVES: Mapping[str, Callable[..., Curve]] = {
    "line": line,
    "circle": circle,
    "square": square,
    "figure-eight": figure_eight,
    "spiral": spiral,
    "serpentine": serpentine,
    "wander": wander,
    "hypotrochoid": hypotrochoid,
    "spline": spline,
    "polyline": polyline,
    "lanes": lanes,
}


def curve(name: str, **parameters: Any) -> Curve:
    """The curve of that name in `CURVES`, such as ``curve("figure-eight", length_m=3.45, width_m=1.37)``.

    Raises:
        ValueError: there is no such curve, it has no such parameter, or a value makes no curve.
    """
    return made("curve", CURVES, name, parameters)


T = TypeVar("T")


def made(kind: str, table: Mapping[str, Callable[..., T]], name: str, parameters: Mapping[str, Any]) -> T:
    """What the function of that name in a table makes of named parameters.

    Raises:
        ValueError: no such name or parameter, or one that is needed is missing; the message lists what there is.
            Or a value is no (finite) number where one is needed.
    """
    if name not in table:
        raise ValueError(f"no {kind} is named {name!r}; there are: {', '.join(sorted(table))}")
    signature = inspect.signature(table[name])
    try:
        signature.bind(**parameters)
    except TypeError as error:
        raise ValueError(f"{kind} {name!r}: {error}; its parameters are: {', '.join(signature.parameters)}") from error
    for key, value in parameters.items():
        wanted = _NUMBERS.get(signature.parameters[key].annotation)
        if wanted is not None and not (isinstance(value, wanted) and math.isfinite(value)):
            raise ValueError(f"{kind} {name!r}: {key} = {value!r} is no number of the right kind")
    return table[name](**parameters)


_NUMBERS: Mapping[Any, Any] = {"float": numbers.Real, "int": numbers.Integral}


def _demand(holds: bool, what: str) -> None:
    if not holds:
        raise ValueError(f"{what}: there is no such curve, change its parameters")


def _demand_ease(ease: float) -> None:
    _demand(0 <= ease <= 1, f"a share of {ease} of the turn in clothoids (0…1)")


def _cut(turn_rad: float, corner_m: float, ease: float) -> float:
    """What a rounded corner takes of each of its two legs."""
    if turn_rad == 0:
        return 0.0
    return _chord(_corner(turn_rad, corner_m, ease)) / (2 * math.cos(turn_rad / 2))


def _points(points: ArrayLike, closed: bool) -> Floats:
    array = np.asarray(points, dtype=np.float64)
    least = 3 if closed else 2
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < least or not np.all(np.isfinite(array)):
        raise ValueError(f"points of shape {array.shape}: at least {least} points (x, y) in metres are needed")
    around = np.concatenate([array, array[:1]]) if closed else array
    if np.any(np.all(np.diff(around, axis=0) == 0, axis=1)):
        raise ValueError("the same point twice in a row: leave one out")
    return array
