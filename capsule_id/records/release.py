"""Finds the release of a free decay, whatever comes before it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d

from capsule_id.records.tones import BEYOND_CHANCE, FEWEST_IN_PERIOD, SIGNIFICANT, frequency_of, noise_level
from capsule_id.rig.filters import PIECE, loudest_part

#: Turning points differ by this fraction of the record's range, and by more than noise.
TURN = 0.12
#: The last leg between turning points that has this fraction of the largest one belongs to the free decay.
LEG = 0.3
#: The part of a leg whose steepest place gives the period, and the time that a cosine takes for it, in periods.
STEEP, STEEP_TIME = 0.3, 0.097
#: Fewer different readings behind a release are levels of a rounded tail.
FEWEST_LEVELS = 4
#: Where the leg has passed this fraction of its height, the release is past.
PAST = 0.8
#: Samples in a period that suffice; of more, means are taken. Fewest in a window.
SAMPLES, WINDOW = 100, 28
#: The motion ends where it stays so close to its last value: fraction of the range; or within the noise.
STILL = 0.015
#: Prior sds of dry friction, quadratic damping and a cubic spring, relative to the spring force at the amplitude.
FURTHER = np.array([0.1, 0.2, 0.1])
#: Error of the model relative to the amplitude, and what it gains with the sum of the further forces, up to a largest sum.
MODEL, MODEL_FURTHER, LARGEST_FURTHER = 0.003, 0.04, 0.3
#: Cost of a sample before the release, and least evidence of a release, in variances of the noise.
SAMPLE_COST, EVIDENCE = 6.0, 15.0
#: Evidence below which no release is looked for where one viscous decay describes the whole record; fewest samples of its
#: period, and steps to its poles.
NO_EVIDENCE, WHOLE, WHOLE_STEPS = 5.0, 20.0, 5
#: Residuals of a window that are this many times those of the windows within a period behind it show another motion.
MISFIT = 1.5
#: A decay with less damping oscillates; its windows grow by half a period, others by an eighth.
OSCILLATES = 0.3
#: The cut lies so much later than the release found, in periods; at least one sample.
MARGIN = 0.04
#: An earlier part of the same oscillation, this many periods long, is no motion before the release.
EARLIER = 1.5
#: Largest error of an earlier part of the same oscillation relative to its amplitude.
SAME = 0.2
#: A release changes the motion by this part of the sum of squares by which a hold would change it.
CHANGE = 0.1
#: Legs that last as long, and poles that are as large, up to these differences belong to one decay; legs from its first
#: one to where the search for the release begins.
REGULAR, ALIKE, LEGS = 0.3, 0.15, 3
#: A second excitation makes the amplitude this many times as large.
GROWTH = 1.15
#: A push moves the rod by this fraction of the range, and amplitudes differ by more than that of the largest one. A push
#: takes this many times as long as the free rod takes back.
SMALLEST, PUSHED = 0.05, 1.3
#: Time constants after which a decay has died out.
DIED_OUT = 4.0
#: Between two releases of one record the motion is smaller than this fraction of both amplitudes. The first decay ends
#: where its motion is this many times the smallest.
BETWEEN, ENDS = 0.3, 1.25
#: The last part of a pull, relative to the amplitude, where the search for its release begins.
PULLED = 0.7

Poles = tuple[float, float]


@dataclass(frozen=True)
class FreeDecay:
    """The part of a record that is free decay.

    Attributes
    ----------
    start : of the free decay, s; the first sample where the record begins with it
    stop : time at which another excitation begins, s; before ``start`` where it ends an earlier decay; None: none
    rest : duration of what comes before ``start``, s; 0 where the record begins with the free decay
    period : of the oscillation, s; that without damping where the decay does not oscillate
    pushed : whether the record begins with a push, within a period before ``start``
    """

    start: float
    stop: float | None
    rest: float
    period: float
    pushed: bool = False

    @property
    def end(self) -> float | None:
        """Time at which another excitation ends the free decay, s; None: none does."""
        return self.stop if self.stop is not None and self.stop > self.start else None


def find_free_decay(time: np.ndarray, values: np.ndarray, displacement: bool = False) -> FreeDecay | None:
    """Return the free decay inside a record; None where no motion exceeds the noise, or it is sampled too slowly.

    Parameters
    ----------
    time : (n,) s, increasing, evenly or unevenly spaced
    values : (n,) displacement, velocity or acceleration
    displacement : whether they are displacements; only these show a push before the release, and cannot jump
    """
    whole, (time, values) = time, shortened(time, values)
    if len(time) < len(whole):
        time[[0, -1]] = whole[[0, -1]]
    found = _find(*(np.asarray(a, float).tobytes() for a in (time, values)), displacement)
    first = 0 if found is None else int(np.searchsorted(time, found.start))
    if first and len(np.unique(values[first:])) < FEWEST_LEVELS:  # a tail at rest: the release lies before it
        return find_free_decay(time[:first], values[:first], displacement)
    return found


def find_releases(time: np.ndarray, values: np.ndarray, displacement: bool = False) -> list[slice]:
    """The rows of each free decay in a record of several releases, in order; [] where it has fewer than two.

    The rest at the end of a decay, the next pull and its hold belong to none of them.

    Parameters
    ----------
    time, values, displacement : as in ``find_free_decay``
    """
    last = find_free_decay(time, values, displacement)
    if last is None:
        return []
    size, found = max(int(last.period / float(np.median(np.diff(time)))), 1), list[slice]()
    end = len(time) if last.end is None else int(np.searchsorted(time, last.end))
    # The largest deflection in the period behind each sample; the last decay ends around the rest position.
    far = np.abs(values - np.mean(values[max(end - size, 0) : end]))
    motion = maximum_filter1d(far, size, origin=-(size // 2), mode="nearest")
    cuts = _lowest_between(motion, max(size // 8, 1))
    for first, stop in pairwise([0, *cuts, len(time)] if cuts else []):
        top = first + int(np.argmax(motion[first:stop]))
        if stop < len(time):
            least = float(np.min(motion[top:stop]))
            low = top + int(np.argmax(motion[top:stop] <= ENDS * least))
            # At rest the next pull is seen when it begins; in a swing it hides.
            over = np.flatnonzero(motion[low:stop] > 2.0 * least)
            resting = least < BEYOND_CHANCE * noise_level(values[first:stop])
            stop = low if not resting else low + int(over[0]) if len(over) else stop
        for row in (first + int(np.argmax(far[first:stop] > PULLED * motion[top])), first):
            decay = find_free_decay(time[row:stop], values[row:stop], displacement)
            if decay is None:
                continue
            begin = int(np.searchsorted(time, decay.start))
            last = stop if decay.end is None else min(stop, int(np.searchsorted(time, decay.end)))
            if last - begin > size and np.ptp(values[begin : begin + size]) > motion[top]:  # a hold does not swing
                found.append(slice(begin, last))
                break
    return found if len(found) > 1 else []


def _lowest_between(motion: np.ndarray, step: int) -> list[int]:
    """Rows of the smallest motion between two amplitudes, for which every ``step``-th row is looked at."""
    level = np.log(np.maximum(motion[::step], SMALLEST * np.max(motion))).tolist()
    top, low, cuts = level[0], 0, list[int]()
    for i, here in enumerate(level):
        if here - level[low] > -np.log(BETWEEN) < top - level[low]:
            cuts.append(low * step)
            top = here
        if here >= top:
            top, low = here, i
        elif here <= level[low]:  # the last one: the motion after it is the next pull
            low = i
    return cuts


@lru_cache(maxsize=8)
def _find(time_bytes: bytes, values_bytes: bytes, displacement: bool, smooth: bool = False) -> FreeDecay | None:
    """As ``find_free_decay``, for bytes of float64: the checks and the fit of a record all call it.

    ``smooth``: without fast modes, which a blow excites too.
    """
    time, values = np.frombuffer(time_bytes), np.frombuffer(values_bytes)
    turns = _turning_points(values) if len(values) >= WINDOW // 2 else np.zeros(0, int)
    if len(turns) < 2:
        return None
    sizes = np.abs(np.diff(values[turns]))
    last = int(np.flatnonzero(sizes >= LEG * np.max(sizes))[-1])
    period, past = _scale(time, values, int(turns[last]), int(turns[last + 1]))
    decay, over = None, float(time[turns[last + 1]])
    if period >= FEWEST_IN_PERIOD * np.median(np.diff(time)):
        lengths, first = np.diff(time[turns]), last
        while (
            first
            and sizes[first - 1] > 0.95 * sizes[first]
            and abs(lengths[first - 1] / lengths[first] - 1.0) < REGULAR
        ):
            first -= 1
        record, anchor = _Record.of(time, values, period, past)
        early = (
            min(record.at(float(time[turns[min(first + LEGS, len(turns) - 1)]])), anchor)
            if first + LEGS < last
            else anchor
        )
        whole = _whole(record, anchor, lengths, sizes) or _held(record, anchor, lengths, sizes)
        begin, fit, stop = whole or _release(record, anchor, early)
        over = float(record.time[begin]) + DIED_OUT / max(fit.poles[0] * fit.poles[1], 1e-9)
        start, pushed = float(time[0]), False
        if begin > 0 and np.sum(time >= record.time[begin]) > WINDOW // 4:
            free = float(record.time[begin])
            cut = max(int(np.searchsorted(time, free + MARGIN * period)), int(np.searchsorted(time, free, "right")))
            start, pushed = _push(time, values, free, period) if displacement else (free, False)
            start = start if start < free else max(start, float(time[min(cut, len(time) - 1)]))
        after = turns[time[turns] > start + 0.15 * period]  # the first leg of a record is not whole
        stop = _growth(time, values, after) if stop is None and len(after) > 4 else stop
        own, halves = 2.0 * np.pi / (fit.poles[0] * np.sqrt(max(1.0 - fit.poles[1] ** 2, 0.1))), np.diff(time[after])
        regular = (
            halves[np.abs(halves - np.median(halves)) < REGULAR * np.median(halves)] if len(after) > 4 else halves[:0]
        )
        if len(regular):
            own = 2.0 * float(np.mean(regular))
        decay = FreeDecay(start, stop, start - float(time[0]), own, pushed)
    slow = int(np.searchsorted(time, over, "right"))
    later = slow + _turning_points(values[slow:]) if len(time) - slow > WINDOW else np.zeros(0, int)
    if len(later) > 6 and not smooth and time[later[-1]] - time[later[0]] > 1.5 * period * (len(later) - 1):
        legs, sizes = np.diff(time[later]), np.abs(np.diff(values[later]))
        # The noise of a rod at rest turns too, but neither far nor regularly.
        far = np.median(sizes) > 2.0 * BEYOND_CHANCE * noise_level(values[slow:])
        if not far and np.quantile(np.abs(legs / np.median(legs) - 1.0), 0.9) > REGULAR:
            return decay
        width = int(np.mean(legs) / 4.0 / np.median(np.diff(time)))
        padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
        values = np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
        decay = _find(time_bytes, values.tobytes(), displacement, smooth=True)
    return decay


def _push(time: np.ndarray, values: np.ndarray, start: float, period: float) -> tuple[float, bool]:
    """Start of the free decay of a record that is cut at ``start``, s, and whether a push lies before it.

    A push leads to a turning point. At every displacement a free rod has more kinetic energy before a turning point than
    after it, whatever its spring and its damping: a rod that approaches the turning point no more slowly is free.
    """
    row, near = (int(np.searchsorted(time, start + part * period)) for part in (0.0, 0.2))
    away = values[:near] - values[min(int(np.searchsorted(time, start + 0.5 * period)), len(values) - 1)]
    top = int(np.argmax(np.abs(away)))
    height = np.sign(away[top]) * (values - values[0])
    climbs = height[top] > SMALLEST * np.ptp(values[row:]) and height[row - 1] > 0.5 * height[top]
    if not climbs or time[top] - time[0] > 0.5 * period:
        return start, False
    high = np.flatnonzero(height[: top + 1] < PAST * height[top])[-1]
    falls = [top + np.flatnonzero(height[top:] < part * height[top]) for part in (PAST, 0.0)]
    if len(falls[1]) and time[high] - time[0] < PUSHED * (time[falls[1][0]] - time[falls[0][0]]):
        return float(time[0]), False
    return max(start, float(time[top])), True


def _turning_points(values: np.ndarray) -> np.ndarray:
    """Indices of the turning points that differ by more than noise, and of the ends of the first and the last leg."""
    levels = np.median(np.stack([values[:-2], values[1:-1], values[2:]]), axis=0)
    limit = max(TURN * float(np.ptp(levels)), SIGNIFICANT * noise_level(values))
    turns, side, turn, other = list[int](), 0, 0, 0
    levels = levels.tolist()
    for i, level in enumerate(levels):
        if side == 0:  # turn is the highest place, other the lowest one
            turn, other = (i if level > levels[turn] else turn), (i if level < levels[other] else other)
            if levels[turn] - levels[other] > limit:
                side = 1 if turn > other else -1
                turns.append(min(turn, other))
                turn = i
        elif side * (level - levels[turn]) > 0.0:
            turn = i
        elif side * (levels[turn] - level) > limit:
            turns.append(turn)
            side, turn = -side, i
    return np.array([*turns, turn]) + 1


def _scale(time: np.ndarray, values: np.ndarray, begin: int, end: int) -> tuple[float, float]:
    """Period of the oscillation to a factor of two, from the steepest part of a leg, and a time behind its release."""
    rise = values[begin : end + 1] - values[begin]
    # Of coarse readings both ends may be equal.
    passed = np.maximum.accumulate(rise / (rise[-1] or rise[np.argmax(np.abs(rise))] or 1.0))
    levels = np.linspace(0.0, 1.0, 41)
    place = np.clip(np.searchsorted(passed, levels), 1, len(passed) - 1)
    low, high = passed[place - 1], passed[place]
    part = np.where(high > low, (levels - low) / np.where(high > low, high - low, 1.0), 1.0)
    times = time[begin + place - 1] + np.clip(part, 0.0, 1.0) * (time[begin + place] - time[begin + place - 1])
    steep = round(STEEP * 40)
    return float(np.min(times[steep:] - times[:-steep])) / STEEP_TIME, float(times[round(PAST * 40)])


def _growth(time: np.ndarray, values: np.ndarray, turns: np.ndarray) -> float | None:
    """Time before legs between ``turns`` that grow; None where none does. Two of them grow, and three were lower."""
    sizes = np.abs(np.diff(values[turns]))
    highest = np.max(np.lib.stride_tricks.sliding_window_view(np.pad(sizes, (2, 0), mode="edge"), 3), axis=1)
    grown = sizes > GROWTH * np.minimum.accumulate(np.concatenate([highest[:1], highest[:-1]])) + SMALLEST * np.max(
        sizes
    )
    twice = 1 + np.flatnonzero(grown[1:-1] & grown[2:])
    return float(time[turns[twice[0]]]) if len(twice) else None


@dataclass(frozen=True)
class _Fit:
    """A free decay fitted to a window: ``poles`` (angular frequency, damping ratio), the sum of squares, the sd of the
    residuals, that of the errors of the model, and the rest position."""

    poles: Poles
    cost: float
    sd: float
    model: float
    level: float


@dataclass(frozen=True)
class _Record:
    """Samples (n,) up to the end of the motion, an estimate of the period, and the sd of the noise."""

    time: np.ndarray
    values: np.ndarray
    period: float
    noise: float

    @classmethod
    def of(cls, time: np.ndarray, values: np.ndarray, period: float, past: float) -> tuple["_Record", int]:
        """The record of block means without the rest after the motion, and the index of the time ``past``."""
        size = max(min(int(period / np.median(np.diff(time)) / SAMPLES), len(time) // WINDOW), 1)
        time, values = (a[: len(a) // size * size].reshape(-1, size).mean(axis=1) for a in (time, values))
        noise, last = noise_level(values), np.median(values[-max(5, len(values) // 20) :])
        far = np.flatnonzero(np.abs(values - last) > max(SIGNIFICANT * noise, STILL * float(np.ptp(values))))
        anchor = min(int(np.searchsorted(time, past)), max(len(time) - 10, 0))
        end = max(far[-1] + 1 if len(far) else 0, anchor + 12)
        return cls(time[:end], values[:end], period, noise), anchor

    def at(self, time: float) -> int:
        """Index of the first sample at ``time`` or later."""
        return int(np.searchsorted(self.time, time))

    def end(self, begin: int) -> int:
        """End of the window that begins at a sample: a period, and ``WINDOW`` samples, later."""
        return min(max(self.at(self.time[begin] + self.period), begin + WINDOW), len(self.time))

    def starts(self) -> list[Poles]:
        """Poles from which a fit begins."""
        return [(2.0 * np.pi / self.period * a, zeta) for a, zeta in ((1.0, 0.05), (1.0, 0.5), (1.5, 1.0), (2.5, 1.6))]

    def fit(self, begin: int, end: int, starts: Iterable[Poles], steps: int) -> _Fit:
        """The best decay of samples ``begin`` to ``end`` from the ``starts``, by Gauss-Newton on the poles."""
        time, values = self.time[begin:end] - self.time[begin], self.values[begin:end]
        size = 0.5 * float(np.ptp(values))
        noise, found = max(self.noise, MODEL * size), list(starts)
        if len(found) > 1:
            found = [min((_fit(time, values, poles, noise, 4) for poles in found), key=lambda fit: fit[0])[1]]
        best = _fit(time, values, found[0], noise, steps)
        model = max((MODEL + MODEL_FURTHER * min(best[2], LARGEST_FURTHER)) * size, 1e-15)
        return _Fit(best[1], best[0], max(np.sqrt(best[0] / max(len(time) - 5, 1)), self.noise, model), model, best[3])


def _fit(
    time: np.ndarray, values: np.ndarray, poles: Poles, sd: float, steps: int
) -> tuple[float, Poles, float, float]:
    """Sum of squares, poles, sum of the further forces, and rest position of a decay; ``sd`` of the readings."""
    prior = np.zeros((3, 8))
    prior[[0, 1, 2], [5, 6, 7]] = sd / FURTHER
    wanted, step = np.concatenate([values, np.zeros(3)]), np.zeros(2)
    best = np.inf, poles, 0.0, 0.0
    for _ in range(steps + 1):
        columns = np.vstack([_columns(poles[0] * time, poles[1], values, sd), prior])
        linear = columns[:, [0, 1, 2, 5, 6, 7]]
        found = np.linalg.lstsq(linear, wanted, rcond=1e-10)[0]
        cost = float(np.sum((wanted - linear @ found) ** 2))
        if cost < best[0]:
            converged = best[0] - cost < 1e-3 * cost
            best = cost, poles, float(np.sum(np.abs(found[3:]))), float(found[0])
            if converged:
                break
            step = np.clip(np.linalg.lstsq(columns, wanted, rcond=1e-10)[0][3:5], -0.4, 0.4)
        else:
            step = step / 3.0
        poles = best[1][0] * float(np.exp(step[0])), float(np.clip(best[1][1] + step[1], 0.0, 2.5))
    return best


def _motions(phase: np.ndarray, zeta: float) -> tuple[np.ndarray, np.ndarray, complex, np.ndarray, np.ndarray]:
    """Offset and two free motions, their rates, (n, 3) each, the root of zeta^2 - 1, and poles and waves of a linear decay.

    Of two conjugate poles one is given, (1, 1), with its wave (1, n); of two real ones both, (2, 1), with theirs (2, n).
    """
    root = np.sqrt(complex(zeta**2 - 1.0))
    root = root if abs(root) > 1e-3 else 1e-3 + 0.0j
    swings = root.real == 0.0
    poles = np.array([[-zeta + root]]) if swings else np.array([[-zeta + root.real], [-zeta - root.real]])
    waves = np.exp(np.clip(np.real(poles) * phase, -60.0, 60.0)) * (np.exp(1j * root.imag * phase) if swings else 1.0)
    second = waves[0].imag / root.imag if swings else (waves[0] - waves[1]) / (2.0 * root.real)
    first = np.real(waves[0]) - np.real(poles[0]) * second
    motions, rates = np.ones((2, 3, len(phase)))
    motions[1:], rates[:] = (first, second), (0.0 * phase, -second, first - 2.0 * zeta * second)
    return motions.T, rates.T, root, poles, waves


def _columns(phase: np.ndarray, zeta: float, values: np.ndarray, sd: float) -> np.ndarray:
    """Offset, two free motions, derivatives by the poles, and responses to three further forces, (n, 8).

    The further forces are those along the decay that they cause: dry friction, quadratic damping and a cubic spring, each
    with the size of the spring force at the amplitude.

    Parameters
    ----------
    phase : (n,) time times angular frequency
    zeta : damping ratio
    values : (n,) readings; ``sd`` of their errors
    """
    motions, rates, root, poles, waves = _motions(phase, zeta)
    half, back, n = 0.5 * np.diff(phase), 1.0 / waves, len(phase)

    def response(forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement and rate, (k, n) each, from rest by forces (k, n)."""
        pulled, parts = forces[:, None] * back, np.zeros((len(forces), *waves.shape), waves.dtype)
        np.cumsum((pulled[..., 1:] + pulled[..., :-1]) * half, axis=2, out=parts[..., 1:])
        parts *= waves
        if root.real == 0.0:
            return np.imag(parts[:, 0]) / root.imag, np.imag(poles[0] * parts[:, 0]) / root.imag
        size, rates = 2.0 * root.real, poles * parts
        return (parts[:, 0] - parts[:, 1]) / size, (rates[:, 0] - rates[:, 1]) / size

    # The further forces have the prior ``FURTHER``.
    columns, wanted = np.zeros((6, n + 3)), np.zeros(n + 3)
    columns[:3, :n], wanted[:n] = motions.T, values
    columns[[3, 4, 5], [n, n + 1, n + 2]] = sd / FURTHER
    found = np.linalg.lstsq(motions, values, rcond=1e-9)[0]
    x, v = found[1:] @ motions.T[1:], found @ rates.T
    size = float(np.max(np.abs(x))) + 1e-300
    for turn in range(3):
        a, b = np.minimum(np.maximum(np.array([x, v]) / size, -3.0), 3.0)
        forces = -size * np.array([np.sign(b), b * np.abs(b), a * a * a, 2.0 / size * v][: 3 + turn // 2])
        further, rate = response(forces)
        if turn < 2:
            columns[3:, :n] = further
            found = np.linalg.lstsq(columns.T, wanted, rcond=1e-10)[0]
            x, v = found[1:] @ columns[1:, :n], found[:3] @ rates.T + found[3:] @ rate
    return np.concatenate([motions.T, [phase * v], further[3:], further[:3]]).T


def _whole(
    record: _Record, begin: int, lengths: np.ndarray, sizes: np.ndarray
) -> tuple[int, _Fit, float | None] | None:
    """As ``_release``, where one viscous decay describes the record from its first sample on; None: it does not.

    Without its first i samples the sum of squares is smaller by r' (1 - H)^-1 r, with their residuals r and their part H
    of the projection on the unknowns. More than the noise and the cost of the samples would show a release.

    Parameters
    ----------
    lengths, sizes : (l,) of the legs between turning points, s and as the readings
    """
    end = record.end(begin)
    time, values, half = record.time[:end] - record.time[0], record.values[:end], float(np.median(lengths))
    coarse = 2.0 * half < WHOLE * float(np.max(np.diff(time))) or np.min(sizes) == 0.0
    if len(lengths) < LEGS or coarse or record.noise == 0.0:
        return None
    loss = float(np.log(sizes[1] / sizes[-1])) / max(len(sizes) - 2, 1)
    omega, zeta = np.pi / half, float(np.clip(loss / np.hypot(np.pi, loss), 0.001, OSCILLATES))
    for _ in range(WHOLE_STEPS):
        motions, rates = _motions(omega * time, zeta)[:2]
        parts = np.linalg.lstsq(motions, values, rcond=1e-9)[0]
        by_zeta = (_motions(omega * time, zeta + 1e-5)[0] - motions) @ parts / 1e-5
        projection = np.linalg.qr(np.column_stack([motions, omega * time * (rates @ parts), by_zeta]))
        found = np.linalg.lstsq(projection.R, projection.Q.T @ values, rcond=1e-12)[0]
        step = np.clip(found[3:], -0.2, 0.2)
        omega, zeta = omega * float(np.exp(step[0])), float(np.clip(zeta + step[1], 1e-6, OSCILLATES))
    left = (values - projection.Q @ (projection.Q.T @ values)) / record.noise
    squares, few = np.cumsum(left**2), slice(len(left) // 2)
    if squares[-1] > len(left) + SIGNIFICANT * np.sqrt(2.0 * len(left)) or np.max(np.abs(step)) > 0.01:
        return None
    q = projection.Q[few]
    own, shared = np.cumsum(q * left[few, None], axis=0), np.cumsum(q[:, :, None] * q[:, None, :], axis=0)
    less = squares[few] + np.sum(own * np.linalg.solve(np.eye(5) - shared, own[:, :, None])[..., 0], axis=1)
    if np.max(less - SAMPLE_COST * np.arange(1, len(less) + 1)) > NO_EVIDENCE:
        return None
    return (
        0,
        _Fit((omega, zeta), float(squares[-1]) * record.noise**2, record.noise, record.noise, float(found[0])),
        None,
    )


def _held(record: _Record, begin: int, lengths: np.ndarray, sizes: np.ndarray) -> tuple[int, _Fit, float | None] | None:
    """As ``_whole``, where a hold comes before: the first sample that leaves the mean of those before it is free.

    The cut, ``MARGIN`` later than what this returns, is that sample. The hold is where the decay turns: a clipped top is
    none.
    """
    means = np.cumsum(record.values)[:-1] / np.arange(1.0, len(record.values))
    left = np.abs(record.values[1:] - means) > SIGNIFICANT * record.noise
    first = 1 + int(np.argmax(left))
    if first >= begin:
        return None
    after = replace(record, time=record.time[first:], values=record.values[first:])
    if (whole := _whole(after, begin - first, lengths, sizes)) is None:
        return None
    (omega, zeta), free = whole[1].poles, slice(after.end(begin - first))
    motions = _motions(omega * (after.time[free] - after.time[0]), zeta)[0]
    level, x, v = np.linalg.lstsq(motions, after.values[free], rcond=1e-9)[0]
    error = record.noise * np.sqrt(1.0 / first + 5.0 / len(motions))  # five unknowns
    if abs(np.hypot(x, v) - abs(means[first - 1] - level)) > SIGNIFICANT * error:
        return None
    return max(record.at(record.time[first] - MARGIN * record.period) - 1, 0), *whole[1:]


def _release(record: _Record, begin: int, early: int) -> tuple[int, _Fit, float | None]:
    """First sample of the free decay around sample ``begin``, its fit, and the end of an earlier decay, s.

    The search begins at the sample ``early`` where the same oscillation is there already.
    """
    fit = record.fit(begin, record.end(begin), record.starts(), 15)
    one = record.fit(early, record.end(early), [fit.poles], 8) if early < begin else fit
    # Less than a period shows no poles that could be compared.
    short = record.time[-1] - record.time[begin] < record.period
    if short or (abs(np.log(one.poles[0] / fit.poles[0])) < ALIKE and abs(one.poles[1] - fit.poles[1]) < ALIKE):
        begin, fit = early, one
    seen = [(begin, fit.sd)]
    while begin > 0:
        time, span = record.time, record.period * (0.5 if fit.poles[1] < OSCILLATES else 0.125)
        low = max(min(record.at(time[begin] - span), begin - 2), 0)
        sd = max(min((sd for i, sd in seen if time[i] <= time[begin] + record.period), default=fit.sd), fit.model)
        wider = record.fit(low, record.end(begin), [fit.poles], 4)
        later = record.fit(low, record.end(low), [wider.poles], 3)
        doubtful = wider.cost - fit.cost > sd**2 * (2.0 * (begin - low) + EVIDENCE) or later.sd > MISFIT * max(
            sd, later.model
        )
        if doubtful or low == 0:
            inside = max(min(record.at(time[begin] + max(span, 0.25 * record.period)), len(time) - 10), begin)
            inner = record.fit(inside, record.end(inside), [fit.poles, *record.starts()], 10)
            found, evidence = _border(record, low, inside, replace(inner, sd=max(min(inner.sd, sd), inner.model)))
            if found > low and evidence > EVIDENCE:
                inner = record.fit(found, record.end(found), [inner.poles, *record.starts()], 10)
                if _changes(record, found, inner):
                    growth, stop = _earlier(record, found, inner)
                    if growth > GROWTH:
                        return found, inner, stop
                    # Samples are lost or wrong here: the search goes on in front of them.
                    last = max(record.at(time[found] - 0.125 * record.period), min(WINDOW, found))
                    record, low = replace(record, time=time[:last], values=record.values[:last]), max(last - WINDOW, 0)
                seen = []
            later = record.fit(low, record.end(low), [fit.poles, *record.starts()], 10) if low else fit
        begin, fit = low, later
        seen.append((begin, fit.sd))
    return 0, fit, None


def _changes(record: _Record, row: int, fit: _Fit) -> bool:
    """Whether the motion before a sample is as far from the free decay behind it as that of a release."""
    first, end = record.at(record.time[row] - 0.25 * record.period), record.end(row)
    held = record.values.copy()
    held[first:row] = np.mean(held[row : row + 2])
    costs = [one.fit(first, end, [fit.poles], 4).cost - fit.cost for one in (record, replace(record, values=held))]
    noise = noise_level(record.values[first:row]) ** 2 * (row - first) if row - first > 8 else 0.0
    return costs[0] - noise > CHANGE * costs[1]


def _border(record: _Record, low: int, inside: int, fit: _Fit) -> tuple[int, float]:
    """Sample from ``low`` to ``inside`` from which one decay lasts to the end of the window, and the evidence for it."""
    cost, end = np.full(inside - low + 1, np.inf), record.end(inside)
    stride = max(1, inside - record.at(record.time[inside] - record.period / 32.0))
    best, poles = inside, fit.poles
    while True:
        if best < inside:
            poles = record.fit(best, end, [poles, *record.starts()], 12).poles
        for step, first, last in ((stride, best, low), (1, min(best + stride, inside), max(best - stride, low))):
            near = poles
            for i in range(first, last - 1, -step):
                one = record.fit(i, end, [near], 4)
                near = one.poles
                cost[i - low] = min(cost[i - low], one.cost / fit.sd**2 + SAMPLE_COST * (i - low))
                if cost[i - low] > np.min(cost) + 500.0:
                    break
        # What follows the release may be one exponential, whose poles lead to no fit of the whole.
        cost[0] = min(cost[0], record.fit(low, end, [poles, *record.starts()], 12).cost / fit.sd**2)
        again = low + int(np.argmin(cost))
        if again >= best:
            return again, float(cost[np.isfinite(cost)][0] - np.min(cost))
        best = again


def _earlier(record: _Record, row: int, fit: _Fit) -> tuple[float, float | None]:
    """Growth of the amplitude at a sample before which the same oscillation goes on, and the end of an earlier decay, s.

    Infinite where no such oscillation ends at this sample; None where none before it lasts ``EARLIER`` periods.
    """
    time, period = record.time, record.period
    if fit.poles[1] > 2.0 * OSCILLATES:
        return np.inf, None
    for end in np.arange(time[row] - period / 16.0, time[0] + 0.25 * period, -period):
        part = slice(record.at(end - 2.0 * period), record.at(end))
        values, stays = record.values[part], end - time[part.start] > EARLIER * period
        ends_here = end > time[row] - period
        if len(values) < 6 or np.ptp(values) < 2.0 * SIGNIFICANT * record.noise or not (stays or ends_here):
            continue
        poles = record.fit(part.start, part.stop, [fit.poles], 4).poles if stays else fit.poles
        columns = _motions(poles[0] * (time[part] - end), poles[1])[0]
        found = np.linalg.lstsq(columns, values, rcond=1e-9)[0]
        size, error = float(np.hypot(found[1], found[2])), np.mean((values - columns @ found) ** 2) - record.noise**2
        same = error < (SAME * max(size, 0.5 * float(np.ptp(values)))) ** 2 and abs(found[0] - fit.level) < LEG * size
        if same and abs(np.log(poles[0] / fit.poles[0])) < ALIKE:
            grown = 0.5 * float(np.ptp(record.values[row : record.end(row)])) / size if ends_here else np.inf
            return grown, (float(time[row]) if ends_here else float(end)) if stays else None
    return np.inf, None


def shortened(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of blocks of a long record, about ``PIECE`` of them and 32 or more in a period; a short record itself.

    Parameters
    ----------
    time, values : (n,) s, increasing, and readings
    """
    if len(time) < 2 * PIECE:
        return time, values
    part = loudest_part(values)
    step = float(np.ptp(time[part])) / (len(time[part]) - 1)
    size = max(1, min(len(time) // PIECE, int(1.0 / frequency_of(time, values) / step / 32.0)))
    count = len(time) // size * size
    shorter = np.stack([time, values])[:, :count].reshape(2, -1, size).mean(axis=2)
    return shorter[0], shorter[1]
