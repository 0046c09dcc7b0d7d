"""The motion of a record: folding, period, label, mean velocity and contacts."""

from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.special import logsumexp, softmax
from scipy.stats import norm

from capsule_id.parameters import STANDING, STEP_SD
from capsule_id.records.periods import (
    DECIDED,
    Repeat,
    find_period,
    first_true,
    intervals_above,
    local_polynomials,
    period_word,
)
from capsule_id.records.tones import (
    BEYOND_CHANCE,
    VISIBLE,
    Harmonic,
    fit_harmonic,
    recorded_drive,
    relative_position,
    stated_gap,
    stated_Omega,
)
from capsule_id.rig.filters import Record, uneven_sampling
from capsule_id.rig.model import Table

# mean velocity: Estimates the mean velocity of the capsule, its standard error and the direction of motion with its
# probability.


#: Confidence of a decision, moving or standing.
CONFIDENCE = 0.99
_MOST_HARMONICS = 24  # of the motion's frequency in the periodic part of X2
_SAMPLES_PER_VELOCITY = 4  # at least
_ADVANCES = 2000  # values of the advance, for the integrals of the probabilities


@dataclass(frozen=True)
class MeanVelocity:
    """Mean velocity of the capsule, m/s, its standard error, and direction "F", "B", "S", or None with the reason.

    ``probability`` is that of the most probable direction.
    """

    velocity: float
    velocity_sd: float
    direction: str | None
    probability: float
    reason: str = ""


def fit_mean_velocity(time: Record, x_capsule: Record, T: float, period: int | None) -> MeanVelocity:
    """Mean velocity over the record.

    With a known period n of the motion: the slope of a straight line plus harmonics of 1/(n T), by least squares. Its
    standard error is that of white noise and of the scatter of the advances beyond it. Otherwise: the mean of the
    advances over successive excitation periods, with the standard error of their scatter.

    Direction: "F" or "B" where the 99 % interval of the advance per period lies beyond 1e-7 m, "S" where it lies
    within ±1e-7 m, else None. Probability: the three directions are equally probable beforehand, and the advance of a
    moving capsule is log-uniform from 1e-7 m to the range of the record.

    Parameters
    ----------
    time, x_capsule : (n,) s and m
    T : period of the drive, s
    period : of the motion in excitation periods; None or 0 where there is none
    """
    velocity, sd = (
        _slope_with_harmonics(time, x_capsule, period * T) if period else _mean_of_advances(time, x_capsule, T)
    )
    margin = norm.ppf(0.5 + CONFIDENCE / 2.0) * sd * T
    advance = velocity * T
    probability = _probabilities(advance, sd * T, float(np.ptp(x_capsule)))
    # A margin that is no number decides nothing.
    moves, stands = abs(advance) - margin > STANDING, abs(advance) + margin < STANDING
    word = ("F" if advance > 0.0 else "B") if moves else "S" if stands else None
    reason = f"direction: advance {1e6 * advance:.3g} ± {1e6 * sd * T:.2g} um per period, standing is below 0.1 um"
    likeliest = max(probability.values()) if word is None else probability[word]
    return MeanVelocity(velocity, sd, word, likeliest, "" if word else reason)


def _probabilities(advance: float, sd: float, largest: float) -> dict[str, float]:
    """Posterior probability of each direction, given the advance per period and its standard error, m."""
    if not np.isfinite(sd):
        return dict.fromkeys("FBS", 1.0 / 3.0)
    moving = np.geomspace(STANDING, max(largest, 2.0 * STANDING, 2.0 * abs(advance)), _ADVANCES)
    standing = np.linspace(-STANDING, STANDING, _ADVANCES)
    logs = {
        word: float(np.asarray(logsumexp(norm.logpdf(advance, values, np.maximum(sd, spacing)))))
        for word, values, spacing in (
            ("F", moving, np.gradient(moving)),
            ("B", -moving, np.gradient(moving)),
            ("S", standing, np.gradient(standing)),
        )
    }
    return dict(zip(logs, softmax(list(logs.values())).tolist(), strict=True))


def _slope_with_harmonics(time: Record, values: Record, T: float) -> tuple[float, float]:
    """Slope and its standard error beside harmonics of 1/T."""
    step = (time[-1] - time[0]) / (len(time) - 1)
    most = min(_MOST_HARMONICS, int(0.5 * T / step) - 1, len(time) // (2 * _SAMPLES_PER_VELOCITY) - 1)
    angle = 2.0 * np.pi / T * np.multiply.outer(time, np.arange(1, most + 1))
    middle = time - time.mean()
    design = np.concatenate([np.ones((len(time), 1)), middle[:, None], np.cos(angle), np.sin(angle)], axis=1)
    q, triangle = np.linalg.qr(design)
    values = values - values.mean()
    coordinates = q.T @ values
    variance = max(float(np.sum(values**2) - np.sum(coordinates**2)), 0.0) / max(len(time) - design.shape[1], 1)
    slope = np.linalg.solve(triangle.T, np.eye(design.shape[1])[1])  # the row of the pseudoinverse is q @ slope
    waves = design[:, 2:] @ np.linalg.solve(triangle, coordinates)[2:]
    scatter = _scatter_of_advances(time, values - waves, T, variance)
    return float(slope @ coordinates), float(np.hypot(np.sqrt(variance) * np.linalg.norm(slope), scatter))


def _scatter_of_advances(time: Record, places: Record, T: float, variance: float) -> float:
    """Standard error of the mean velocity by the advances per T that scatter beyond white noise; 0 without such scatter.

    variance : of the noise of ``places`` (n,), m^2
    """
    number = np.floor((time - time[0]) / T).astype(int)
    found, counts = np.unique(number, return_counts=True)
    advances = np.diff(ndimage.mean(places, number, found[:-1]))
    if len(advances) < 2:
        return 0.0
    noise = 2.0 * variance / float(np.mean(counts[:-1]))
    scatter = float(np.var(advances, ddof=1))
    if scatter < noise * (1.0 + VISIBLE * np.sqrt(3.0 / len(advances))):
        return 0.0
    return float(np.sqrt((scatter - noise) / len(advances)) / T)


def _mean_of_advances(time: Record, values: Record, T: float) -> tuple[float, float]:
    """Mean advance over successive whole periods, per second, and its standard error."""
    count = int((time[-1] - time[0]) / T)
    if count < 1:
        return float((values[-1] - values[0]) / (time[-1] - time[0])), float("inf")
    places = np.interp(time[0] + T * np.arange(count + 1), time, values)
    sd = float(np.std(np.diff(places), ddof=1) / np.sqrt(count) / T) if count > 1 else float("inf")
    return float((places[-1] - places[0]) / (count * T)), sd


# contacts: Counts contacts between rod and support spring, in the acceleration of the rod and in x_rel.
#
# Acceleration. Out of contact the rod obeys a linear law, acceleration = b0 + b1 x_rel + b2 rate + b3 cos(Omega t)
# + b4 sin(Omega t). It is fitted to the samples far from contact. In contact the spring pushes the rod back, and
# the acceleration is below this law: a spike. x_rel exceeds the gap during a contact. Sensor zero and stated gap
# are known to some tens of um only. Where spikes exist, the impact line is the x_rel at which they vanish.
#
# Both are counted on the record folded onto one period of the motion, with two levels (``SPIKE_LEVELS``,
# ``CROSSING_LEVELS``, in standard errors): a contact begins above the higher and ends below the lower one. The count is
# accepted if all pairs of levels and both methods give the same number, and more than half of the single periods
# agree.


SPIKE_LEVELS = ((1.5, 4.5), (2.0, 5.0), (2.5, 6.0))
CROSSING_LEVELS = ((-1.0, 1.0), (-3.0, 1.0))
_PLACES_PER_SAMPLE = 8  # grid points per sampling step, on the folded period
# samples, half-width of the cubic for x_rel and its rate near a contact: where the phases of all cycles together are
# finer than a sampling step, and where a whole number of steps in a period repeats the same ones, four at least
_NARROW_HALF_WIDTH, _REPEATED_HALF_WIDTH = 1.25, 2.05
_NARROW_SAMPLES = 9  # samples of the folded record in the narrow window, at least about this many
_WIDE_HALF_WIDTH = 0.02  # of the excitation period, half-width for the linear law: rates with little noise
_CLEARANCE_SHARE = 0.05  # of the range of x_rel: samples this far below the gap are clear of contact,
_CLEARANCE_SDS = 5.0  # and this many sd of the stated gap below it
_IMPACT_LINE_SHIFTS = (-2.0, 0.0, 2.0)  # sd; crossings are counted at the impact line shifted by these
_FEWEST_CONTACT_SAMPLES = 2  # of the folded record in contact, needed for the impact line
_SAMPLES_PER_UNKNOWN = 10  # samples per unknown of the linear law
_AVERAGED_SAMPLES = 3  # samples of the moving mean in single periods; a contact lasts longer
_ODDS_OF_A_CYCLE = 3.0  # that a single period shows the true number of contacts


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
    impact_line : from the spikes; None where they are too few and the stated gap is used
    duration : of the shortest contact, s, None without contacts
    agreeing, cycles : number of single periods with the same count, and number of single periods
    reason : why the count is None, or ""
    """

    count: int | None
    spikes: tuple[int, ...]
    crossings: tuple[int, ...]
    impact_line: ImpactLine | None
    duration: float | None
    agreeing: int
    cycles: int
    reason: str = ""

    @property
    def probability(self) -> float:
        """Of the count: a single period shows the true count with the probability 3/4, and any other with 1/4."""
        return 1.0 / (1.0 + _ODDS_OF_A_CYCLE ** (self.cycles - 2 * self.agreeing))


@dataclass(frozen=True)
class Cycle:
    """A record for folding: channels (n,) SI, drive and gap. ``period``: of the motion, s. ``noise_sd``: of x_rel, m."""

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
        return np.linspace(0.0, self.period, max(int(_PLACES_PER_SAMPLE * self.period / self.step), 2), endpoint=False)

    @property
    def narrow(self) -> float:
        """Half-width, s, of the narrowest window of a cubic."""
        phase = np.sort(self.phase)
        widest = np.max(np.diff(phase, append=phase[0] + self.period))
        return (_REPEATED_HALF_WIDTH if widest > 0.5 * self.step else _NARROW_HALF_WIDTH) * self.step

    def mean(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean over one sampling step at ``places``, with a sample of every cycle, and its sd for unit noise."""
        # Rounding shall not leave out both samples half a step away.
        half = 0.5 * (1.0 + 1e-9) * self.step
        found, sd = local_polynomials(self.phase, values, self.period, self.places, half, 0)
        return found[0], sd[0]


def find_contacts(cycle: Cycle) -> Contacts:
    """Count the contacts of a record whose motion has the period ``cycle.period``."""
    push = _shortfall(cycle)
    seen = _impact_line(cycle, push) if push else None
    line = seen or ImpactLine(cycle.gap, cycle.gap_sd, cycle.noise_sd)
    single = cycle.x_rel - line.value
    mean, sd = cycle.mean(cycle.x_rel)
    above = [(mean - line.value - shift * line.sd) / (sd * line.scatter) for shift in _IMPACT_LINE_SHIFTS]
    crossings = tuple(len(intervals_above(z, *levels)) for z in above for levels in CROSSING_LEVELS)
    if push is None:
        spikes, z, single, levels = (), above[len(above) // 2], single / cycle.noise_sd, CROSSING_LEVELS[-1]
    else:
        shortfall, noise_sd, shared_sd = push
        mean, sd = cycle.mean(shortfall)
        z = mean / np.hypot(sd * noise_sd, cycle.mean(shared_sd)[0])
        spikes = tuple(len(intervals_above(z, *pair)) for pair in SPIKE_LEVELS)
        single, levels = shortfall / np.hypot(noise_sd, shared_sd), SPIKE_LEVELS[1]
    stretches = intervals_above(z, *levels)
    single = np.convolve(single, np.full(_AVERAGED_SAMPLES, _AVERAGED_SAMPLES**-0.5), mode="same")
    agreeing, cycles = _agreeing_cycles(cycle, single, levels, stretches)
    counts = set(spikes + crossings)
    words = ["/".join(map(str, one)) or "not recorded" for one in (spikes, crossings)]
    reason = first_true(
        (any(length >= len(z) for _, length in stretches), "contacts: the rod does not leave the spring"),
        (len(counts) > 1, f"contacts: spikes {words[0]}, crossings of the gap {words[1]}"),
        (
            2 * agreeing <= cycles,
            f"contacts: {agreeing} of {cycles} single periods show the {crossings[0]} of all together",
        ),
    )
    count = None if reason else counts.pop()
    shortest = min((length for _, length in stretches), default=0) * cycle.period / len(z)
    return Contacts(count, spikes, crossings, seen, shortest or None, agreeing, cycles, reason)


#: Linear law minus acceleration, (n,), the sd of its white noise, and (n,) the sd from the law and the smoothed x_rel in it,
#: m/s^2; neighbours and periods share this error.
Shortfall = tuple[np.ndarray, float, np.ndarray]


def _shortfall(cycle: Cycle) -> Shortfall | None:
    """Linear law minus acceleration; None without one that varies or without enough samples clear of contact."""
    if cycle.acceleration is None or np.ptp(cycle.acceleration) == 0.0:
        return None
    wide, _ = local_polynomials(
        cycle.phase,
        cycle.x_rel,
        cycle.period,
        cycle.phase,
        max(cycle.narrow, _WIDE_HALF_WIDTH * 2.0 * np.pi / cycle.Omega),
        3,
    )
    clear = _clear_of_gap(cycle, wide[0])
    terms = _linear_law_terms(cycle, wide)[clear]
    if len(terms) < _SAMPLES_PER_UNKNOWN * terms.shape[1]:
        return None
    scale = np.linalg.norm(terms, axis=0)
    q, triangle = np.linalg.qr(terms / scale)
    law = np.linalg.solve(triangle, q.T @ cycle.acceleration[clear]) / scale
    half = max(cycle.narrow, 0.5 * _NARROW_SAMPLES * cycle.period / len(cycle.time))
    near, near_sd = local_polynomials(cycle.phase, cycle.x_rel, cycle.period, cycle.phase, half, 3)
    terms = _linear_law_terms(cycle, near)
    shortfall = terms @ law - cycle.acceleration
    # A step that exceeds the motion clear of contact hides the noise: what is left is the rounding.
    rounding = float(np.min(np.diff(np.unique(cycle.acceleration)))) * STEP_SD
    sd = max(float(np.std(shortfall[clear])), rounding)
    of_law = sd * np.linalg.norm(np.linalg.solve(triangle.T, (terms / scale).T), axis=0)
    of_terms = cycle.noise_sd * np.hypot(law[1] * near_sd[0], law[2] * near_sd[1])
    return shortfall, sd, np.hypot(of_law, of_terms)


def _linear_law_terms(cycle: Cycle, local: np.ndarray) -> np.ndarray:
    angle = cycle.Omega * cycle.time
    return np.stack([np.ones_like(angle), *local[:2], np.cos(angle), np.sin(angle)], axis=1)


def _clear_of_gap(cycle: Cycle, x_rel: np.ndarray) -> np.ndarray:
    """Which samples are well below the gap and have only such samples in the wide window: (n,) bool."""
    below = x_rel < cycle.gap - max(_CLEARANCE_SDS * cycle.gap_sd, _CLEARANCE_SHARE * float(np.ptp(x_rel)))
    if below.all():
        return below
    others = KDTree(np.unique(cycle.phase[~below])[:, None], boxsize=cycle.period)
    distance = np.asarray(others.query(cycle.phase[:, None])[0])
    return below & (distance > _WIDE_HALF_WIDTH * 2.0 * np.pi / cycle.Omega)


def _impact_line(cycle: Cycle, push: Shortfall) -> ImpactLine | None:
    """The x_rel at which the spikes vanish, by regression of x_rel on them."""
    shortfall, noise_sd, shared = push
    (force, sd), (x_rel, _) = cycle.mean(shortfall), cycle.mean(cycle.x_rel)
    deep = force > BEYOND_CHANCE * sd * noise_sd
    # A mean across an edge of a contact is biased: drop half a sampling step on either side.
    touching = np.all(
        [np.roll(deep, shift) for shift in range(-_PLACES_PER_SAMPLE // 2, _PLACES_PER_SAMPLE // 2 + 1)], axis=0
    )
    count = touching.sum() / _PLACES_PER_SAMPLE
    if count < _FEWEST_CONTACT_SAMPLES:
        return None
    shared_sd = float(np.mean(cycle.mean(shared)[0][touching]))
    force, x_rel, sd = force[touching], x_rel[touching], sd[touching]
    # Noise in the regressor reduces the slope: subtract its known variance.
    variance = float(np.var(force) - np.mean(sd**2) * noise_sd**2)
    if variance <= 0.0:
        return None
    slope = float(np.mean((force - force.mean()) * (x_rel - x_rel.mean())) / variance)
    value = float(x_rel.mean() - slope * force.mean())
    residual = x_rel - slope * force - value
    regression_sd = np.std(residual) * np.sqrt((1.0 + force.mean() ** 2 / variance) / count)
    scatter = max(float(np.std(residual / sd)), cycle.noise_sd)
    return ImpactLine(value, float(np.hypot(regression_sd, slope * shared_sd)), scatter)


def _agreeing_cycles(
    cycle: Cycle, z: np.ndarray, levels: tuple[float, float], stretches: list[tuple[int, int]]
) -> tuple[int, int]:
    """Number of single cycles with the contact count of the folded record, and number of cycles, cut far from contacts."""
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


# label: Labels the motion of a record, P-<n>-<F|B|S>-<m> as in the paper, with its probability and the evidence.
#
# drive -> period by repeat -> mean velocity -> contacts on the folded record -> label


UNDECIDED = "undecided"


@dataclass(frozen=True)
class Evidence:
    """Evidence for a label; None where the channels for it were not recorded.

    drive : the tone of the current
    Omega : rad/s, of the current, else of x_rel, else as stated
    repeat, mean_velocity, contacts : results of the single steps
    reasons : what is missing for the whole label, () for a whole one
    """

    drive: Harmonic | None
    Omega: float
    repeat: Repeat | None
    mean_velocity: MeanVelocity | None
    contacts: Contacts | None
    reasons: tuple[str, ...]


class MeasuredMotion(NamedTuple):
    """Label, mean velocity and evidence.

    label : in the format of ``response``, its period alone ("P-1"), or "undecided" where no probability reaches 0.9
    mean_velocity : of the capsule, m/s; NaN if x_capsule was not recorded
    probability : of the label; of the most probable period where it is undecided; NaN without any
    """

    label: str
    mean_velocity: float
    evidence: Evidence
    probability: float


def measured_motion(table: Table) -> MeasuredMotion:
    """Label, mean velocity and evidence of a recorded run.

    Parameters
    ----------
    table : a ``forced_run`` of a rig; period and contacts need x_rel (or x_base and x_capsule), direction needs x_capsule

    The label describes the record, not a settled motion of the model: "P-1" means that it repeats within the scatter
    from cycle to cycle. The probability of a whole label is the product of those of period, direction and contacts.
    """
    time, columns = table["time"], table.columns
    drive = recorded_drive(table)
    Omega = drive.Omega if drive else stated_Omega(table)
    if (error := uneven_sampling(time)) is not None:
        reason = f"{error.rule} ({error.value})"
        return MeasuredMotion(
            UNDECIDED, float("nan"), Evidence(drive, Omega, None, None, None, (reason,)), float("nan")
        )
    relative = relative_position(table)
    if drive is None and relative:
        Omega = fit_harmonic(time, relative[0], Omega).Omega
    T = 2.0 * np.pi / Omega
    repeat = find_period(time, relative[0], T, relative[1]) if relative else None
    period = repeat.period if repeat else None
    velocity = fit_mean_velocity(time, table["x_capsule"], T, period) if "x_capsule" in columns else None
    scatter = float(np.hypot(repeat.noise_sd, repeat.scatter)) if repeat else 0.0
    contacts = None
    if period and relative and table.settings.spring is not None:
        # Contacts of a spring behind the rod bend the line of the acceleration.
        shows = "acceleration_rod" in columns and table.settings.spring_back is None
        gap, acceleration = stated_gap(table), table["acceleration_rod"] if shows else None
        cycle = Cycle(time, relative[0], acceleration, Omega, period * T, gap.value, gap.sd, scatter)
        contacts = find_contacts(cycle)
    mean_velocity = velocity.velocity if velocity else float("nan")
    label, probability, reasons = _label(repeat, velocity, contacts)
    evidence = Evidence(drive, Omega, repeat, velocity, contacts, reasons)
    return MeasuredMotion(label, mean_velocity, evidence, probability)


def _label(
    repeat: Repeat | None, velocity: MeanVelocity | None, contacts: Contacts | None
) -> tuple[str, float, tuple[str, ...]]:
    """The label, its probability, and what is missing for the whole label."""
    if repeat is None:
        return UNDECIDED, float("nan"), ("x_rel was not recorded",)
    if repeat.period is None:
        return UNDECIDED, repeat.probability, (repeat.reason,)
    period = period_word(repeat.period)
    missing = {"x_capsule was not recorded": velocity, "spring and gap are not stated": contacts}
    reasons = [
        *(part.reason for part in missing.values() if part is not None and part.reason),
        *(words for words, part in missing.items() if part is None),
    ]
    if velocity is None or contacts is None or contacts.count is None or reasons or repeat.period == 0:
        return period, repeat.probability, tuple(reasons) if repeat.period else ()
    whole = f"{period}-{velocity.direction}-{Fraction(contacts.count, repeat.period)}"
    probability = repeat.probability * velocity.probability * contacts.probability
    if probability < DECIDED:
        return period, repeat.probability, (f"{whole} has the probability {probability:.2f}",)
    return whole, probability, ()
