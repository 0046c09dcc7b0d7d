"""Contacts between rod and support spring, counted in the acceleration of the rod and in x_rel.

Acceleration. Out of contact the rod obeys a linear law, acceleration = b0 + b1 x_rel + b2 rate + b3 cos(Omega t) +
b4 sin(Omega t). It is fitted to the samples that are clear of the gap; where the acceleration falls short of it, the
spring pushes back: a spike. x_rel. It exceeds the gap. Sensor zero and stated gap are known to some tens of um only, so
the impact line is placed where the spikes vanish, if there are any.

Both are counted on the record folded onto one period of the motion, with two levels (``SPIKE_LEVELS``,
``CROSSING_LEVELS``, in standard errors): a contact begins above the higher and ends below the lower one. The count holds
where all pairs of levels and both kinds of evidence give the same number, and more than half of the single periods
show it too.
"""

from dataclasses import dataclass

import numpy as np

from capsule_id.records.fold import intervals_above, local_polynomials

SPIKE_LEVELS = ((1.5, 4.5), (2.0, 5.0), (2.5, 6.0))
CROSSING_LEVELS = ((-1.0, 1.0), (-3.0, 1.0))
_GRID = 8  # places per sample of the record, on the folded period
_NARROW = 1.25  # samples, half-width for x_rel and its rate near a contact; cubic
_POINTS = 9  # the narrow window holds at least about as many samples of the folded record
_WIDE = 0.02  # of the period of the drive, half-width for the linear law: rates with little noise
_CLEAR = 0.05  # of the travel of x_rel: this far below the gap counts as clear of it ...
_CLEAR_SD = 5.0  # ... and as many sd of the stated gap
_IN_CONTACT = 6.0  # standard errors of a spike that count for placing the impact line
_LINE_ERRORS = (-2.0, 0.0, 2.0)  # sd of the impact line at which crossings are counted
_LINE_SAMPLES = 2  # of the folded record in contact, for placing the line
_FEWEST = 10  # samples per unknown of the linear law
_SINGLE = 3  # samples whose mean is looked at where a single period is counted; a contact lasts longer
_LAW = 5  # unknowns of the linear law


@dataclass(frozen=True)
class ImpactLine:
    """The impact line: x_rel where contacts begin and its sd, m (sensor zero included); scatter of x_rel about it."""

    value: float
    sd: float
    scatter: float


@dataclass(frozen=True)
class Contacts:
    """Contacts over one period of the motion.

    count : contacts per period of the motion, None where the evidence disagrees
    spikes : counts by ``SPIKE_LEVELS``, () without acceleration
    crossings : counts by ``CROSSING_LEVELS`` at the impact line less 2 of its sd, at it, and at it plus 2 sd
    impact_line : the impact line where the record shows it, None where there are too few spikes: then it is the stated gap
    duration : of the shortest contact, s, None without contacts
    agreeing, cycles : periods of the motion counted singly with the same result, and all that were counted
    reason : why there is no count, or ""
    """

    count: int | None
    spikes: tuple[int, ...]
    crossings: tuple[int, ...]
    impact_line: ImpactLine | None
    duration: float | None
    agreeing: int
    cycles: int
    reason: str = ""


@dataclass(frozen=True)
class Cycle:
    """A record to fold: channels (n,) SI, drive and gap. ``period``: of the motion, s. ``noise_sd``: of x_rel, m."""

    time: np.ndarray
    x_rel: np.ndarray
    acceleration: np.ndarray | None
    Omega: float
    period: float
    gap: float
    gap_sd: float
    noise_sd: float

    @property
    def phase(self) -> np.ndarray:
        """Time within the period of the motion, s."""
        return (self.time - self.time[0]) % self.period

    @property
    def step(self) -> float:
        """Sampling step, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    @property
    def places(self) -> np.ndarray:
        """Grid on the folded period, s."""
        return np.linspace(0.0, self.period, max(int(_GRID * self.period / self.step), 2), endpoint=False)

    def mean(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean over one sampling step at ``places``, which holds a sample of every cycle; and its sd for unit noise."""
        found = local_polynomials(self.phase, values, self.period, self.places, 0.5 * self.step, 0)
        return found.value, found.sd


def find_contacts(cycle: Cycle) -> Contacts:
    """Count the contacts of a record whose motion has the period ``cycle.period``."""
    push = _push(cycle)
    seen = _impact_line(cycle, push)
    line = seen or ImpactLine(cycle.gap, cycle.gap_sd, cycle.noise_sd)
    single = cycle.x_rel - line.value
    mean, sd = cycle.mean(cycle.x_rel)
    above = [(mean - line.value - shift * line.sd) / (sd * line.scatter) for shift in _LINE_ERRORS]
    crossings = tuple(len(intervals_above(z, *levels)) for z in above for levels in CROSSING_LEVELS)
    if push is None:
        spikes, z, single, levels = (), above[len(above) // 2], single / cycle.noise_sd, CROSSING_LEVELS[-1]
    else:
        mean, sd = cycle.mean(push.shortfall)
        z = mean / np.hypot(sd * push.sd, cycle.mean(push.shared_sd)[0])
        spikes = tuple(len(intervals_above(z, *pair)) for pair in SPIKE_LEVELS)
        single, levels = push.shortfall / np.hypot(push.sd, push.shared_sd), SPIKE_LEVELS[1]
    stretches = intervals_above(z, *levels)
    single = np.convolve(single, np.full(_SINGLE, _SINGLE**-0.5), mode="same")
    agreeing, cycles = _single_cycles(cycle, single, levels, stretches)
    counts = set(spikes + crossings)
    reason = ""
    if len(counts) > 1:
        reason = f"contacts: spikes {_shown(spikes)}, crossings of the gap {_shown(crossings)}"
    elif 2 * agreeing <= cycles:
        reason = f"contacts: {agreeing} of {cycles} single periods show the {counts.pop()} of all together"
    count = None if reason else counts.pop()
    shortest = min((length for _, length in stretches), default=0) * cycle.period / len(z)
    return Contacts(count, spikes, crossings, seen, shortest or None, agreeing, cycles, reason)


def _shown(counts: tuple[int, ...]) -> str:
    return "/".join(str(n) for n in counts) or "not recorded"


@dataclass(frozen=True)
class _Push:
    """What the acceleration falls short of the linear law by, (n,) m/s^2, the sd of its white noise, and (n,) that of the law
    and of the smoothed x_rel in it, which neighbours and periods share."""

    shortfall: np.ndarray
    sd: float
    shared_sd: np.ndarray


def _push(cycle: Cycle) -> _Push | None:
    """The spring's push on the rod, None without an acceleration or without enough samples clear of the gap."""
    if cycle.acceleration is None:
        return None
    wide = local_polynomials(
        cycle.phase, cycle.x_rel, cycle.period, cycle.phase, max(_NARROW * cycle.step, _WIDE * _drive(cycle)), 3
    )
    clear = _clear_of_gap(cycle, wide.value)
    if clear.sum() < _FEWEST * _LAW:
        return None
    terms = _terms(cycle, wide.value, wide.rate)[clear]
    scale = np.linalg.norm(terms, axis=0)
    q, triangle = np.linalg.qr(terms / scale)
    law = np.linalg.solve(triangle, q.T @ cycle.acceleration[clear]) / scale
    half = max(_NARROW, 0.5 * _POINTS * cycle.period / (len(cycle.time) * cycle.step)) * cycle.step
    near = local_polynomials(cycle.phase, cycle.x_rel, cycle.period, cycle.phase, half, 3)
    terms = _terms(cycle, near.value, near.rate)
    shortfall = terms @ law - cycle.acceleration
    sd = float(np.std(shortfall[clear]))
    of_law = sd * np.linalg.norm(np.linalg.solve(triangle.T, (terms / scale).T), axis=0)
    of_terms = cycle.noise_sd * np.hypot(law[1] * near.sd, law[2] * near.rate_sd)
    return _Push(shortfall, sd, np.hypot(of_law, of_terms))


def _drive(cycle: Cycle) -> float:
    return 2.0 * np.pi / cycle.Omega


def _terms(cycle: Cycle, x_rel: np.ndarray, rate: np.ndarray) -> np.ndarray:
    angle = cycle.Omega * cycle.time
    return np.stack([np.ones_like(angle), x_rel, rate, np.cos(angle), np.sin(angle)], axis=1)


def _clear_of_gap(cycle: Cycle, x_rel: np.ndarray) -> np.ndarray:
    """Samples well below the gap, and further from any other one than the wide window reaches: (n,) bool."""
    below = x_rel < cycle.gap - max(_CLEAR_SD * cycle.gap_sd, _CLEAR * float(np.ptp(x_rel)))
    if below.all():
        return below
    other = np.sort(cycle.phase[~below])
    other = np.concatenate([other - cycle.period, other, other + cycle.period])
    after = np.searchsorted(other, cycle.phase).clip(1, len(other) - 1)
    distance = np.minimum(cycle.phase - other[after - 1], other[after] - cycle.phase)
    return below & (distance > _WIDE * _drive(cycle))


def _impact_line(cycle: Cycle, push: _Push | None) -> ImpactLine | None:
    """Where the spikes vanish, by regression of x_rel on them."""
    if push is None:
        return None
    (force, sd), (x_rel, _) = cycle.mean(push.shortfall), cycle.mean(cycle.x_rel)
    deep = force > _IN_CONTACT * sd * push.sd
    # a mean over an edge of a contact is biased: drop half a sampling step more on either side
    touching = np.all([np.roll(deep, shift) for shift in range(-_GRID // 2, _GRID // 2 + 1)], axis=0)
    count = touching.sum() / _GRID
    if count < _LINE_SAMPLES:
        return None
    shared_sd = float(np.mean(cycle.mean(push.shared_sd)[0][touching]))
    force, x_rel, sd = force[touching], x_rel[touching], sd[touching]
    # noise in the regressor flattens a regression: subtract its known variance
    variance = float(np.var(force) - np.mean(sd**2) * push.sd**2)
    if variance <= 0.0:
        return None
    slope = float(np.mean((force - force.mean()) * (x_rel - x_rel.mean())) / variance)
    value = float(x_rel.mean() - slope * force.mean())
    residual = x_rel - slope * force - value
    regression_sd = np.std(residual) * np.sqrt((1.0 + force.mean() ** 2 / variance) / count)
    scatter = max(float(np.std(residual / sd)), cycle.noise_sd)
    return ImpactLine(value, float(np.hypot(regression_sd, slope * shared_sd)), scatter)


def _single_cycles(
    cycle: Cycle, z: np.ndarray, levels: tuple[float, float], stretches: list[tuple[int, int]]
) -> tuple[int, int]:
    """(cycles that show by themselves as many contacts as the folded record, cycles counted), cut far from contacts."""
    places = len(cycle.places)
    quiet = 0
    if stretches:
        ends = [((a + n) % places, b) for (a, n), (b, _) in zip(stretches, stretches[1:] + stretches[:1], strict=True)]
        widest = max(ends, key=lambda pair: (pair[1] - pair[0]) % places)
        quiet = widest[0] + ((widest[1] - widest[0]) % places) // 2
    start = (quiet % places) / places * cycle.period
    number = np.floor((cycle.time - cycle.time[0] - start) / cycle.period).astype(int)
    last = int((cycle.time[-1] - cycle.time[0] - start) / cycle.period)
    counts = [len(intervals_above(z[number == i], *levels)) for i in range(last)]
    return sum(n == len(stretches) for n in counts), len(counts)
