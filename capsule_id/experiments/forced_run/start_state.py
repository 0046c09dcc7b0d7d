"""Starting values of a forced run from its record: state, drive, springs and friction; division into parts."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import integrate, ndimage, optimize

from capsule_id.experiments.base import About
from capsule_id.records.tones import SIGNIFICANT, noise_level, tone_at
from capsule_id.rig.model import Table
from capsule_id.rig.schema import SHORTEST_RECORD

# slides: Starting values of spring, damper and friction from a record with both ends of the rod's spring.
#
# Where the capsule slides in one direction, its equation of motion is linear in the unknowns. Integrated twice from the
# start of the slide, it needs no derivative of the record:
#
#     m2 X2 = k1 ∬(r + x0) + c ∫(r − r(0)) − sign(Y2) F t²/2 + a + b t,   r = x_base − x_capsule


#: Samples whose mean speed tells whether the capsule slides: this share of a period.
SMOOTHED = 1.0 / 30.0
#: The capsule slides where its speed exceeds this share of its largest speed. Shortest slide, samples.
SLIDING, SHORTEST_SLIDE = 0.2, 10
#: Least starting value of the damping ratio of capsule and spring.
LEAST_DAMPING = 1e-3


def slides(time: np.ndarray, r: np.ndarray, X2: np.ndarray, period: float, m2: float) -> dict[str, float] | None:
    """Estimate spring, damper and constant friction from the slides of a record; None where they do not determine them.

    Values, SI, by name: k1, c, friction, the extension of the spring where r = 0, the mean speed of the sliding capsule.

    Parameters
    ----------
    time, r, X2 : (n,) s, m, m; r differs from the spring's extension by a constant
    period : of the motion, s
    m2 : mass of the capsule, kg
    """
    samples = max(3, round(SMOOTHED * period * len(time) / (time[-1] - time[0])))
    rate = ndimage.uniform_filter1d(np.gradient(X2, time), samples)
    direction = np.where(np.abs(rate) > SLIDING * np.max(np.abs(rate)), np.sign(rate), 0.0)
    edges = np.flatnonzero(np.diff(direction)) + 1
    pieces = np.split(np.arange(len(time)), edges.tolist())
    slides = [i for i in pieces if direction[i[0]] != 0.0 and len(i) >= SHORTEST_SLIDE]
    own = [_slide(time[i], r[i], m2 * X2[i], float(direction[i[0]])) for i in slides]
    if not own:
        return None
    rows = np.concatenate(own)
    size = np.linalg.norm(rows, axis=0)
    if not np.all(size > 0.0):
        return None
    # The constant part of the extension has either sign.
    design = rows[:, [0, 1, 2, 2, 3]] * np.array([1.0, 1.0, 1.0, -1.0, 1.0]) / size[[0, 1, 2, 2, 3]]
    found = optimize.nnls(design, rows[:, 4])[0] / size[[0, 1, 2, 2, 3]]
    k1, c, force, friction = float(found[0]), float(found[1]), float(found[2] - found[3]), float(found[4])
    if not (k1 > 0.0 and friction > 0.0):
        return None
    speed = float(np.mean(np.abs(rate[direction != 0.0])))
    c = max(c, 2.0 * LEAST_DAMPING * float(np.sqrt(k1 * m2)))
    return {"k1": k1, "c": c, "friction": friction, "extension": force / k1, "speed": speed}


def _slide(time: np.ndarray, r: np.ndarray, momentum: np.ndarray, direction: float) -> np.ndarray:
    """(n, 5) coefficients of k1, c, k1 x0 and F, and ``momentum`` = m2 X2, of one slide, without its line in time."""
    t = time - time[0]
    once = integrate.cumulative_trapezoid(r, t, initial=0.0)
    twice = integrate.cumulative_trapezoid(once, t, initial=0.0)
    rows = np.stack([twice, once - r[0] * t, 0.5 * t**2, -0.5 * direction * t**2, momentum], axis=1)
    line = np.linalg.qr(np.stack([np.ones_like(t), t], axis=1))[0]
    return rows - line @ (line.T @ rows)


# rough: Starting values of a forced run: state and drive at the first sample, estimated from the record.


#: Number of samples of the polynomials through the start of the record. A line gives the capsule's speed, a parabola
#: position and speed of the rod.
LINE_SAMPLES, PARABOLA_SAMPLES = 4, 9
#: Frequency, rad/s, and damping ratio of the rod at the medians of the default priors. Without a current they give the
#: lag of x_rel's fundamental behind the drive, which suffices as a starting value.
ROD_FREQUENCY, ROD_DAMPING = 115.0, 0.16


@dataclass(frozen=True)
class RunStart:
    """Starting values estimated from a record, SI.

    Attributes
    ----------
    x_rel, rate, capsule_rate : m, m/s, m/s at the first sample; 0 where the channel is missing, and the speed of a
        capsule that does not move significantly
    length : amplitude of the rod's motion, m
    amplitude : amplitude of the current, A (NaN where it is not recorded)
    phase : phase of the drive, rad, in (-pi, pi]
    noise : noise level by channel
    """

    x_rel: float
    rate: float
    capsule_rate: float
    length: float
    amplitude: float
    phase: float
    noise: Mapping[str, float]


@dataclass(frozen=True)
class AboutRun(About):
    """Inputs of a run that no likelihood reads.

    Attributes
    ----------
    record : label of the whole record
    leads : whether the run is a whole record, or the first part of one
    start_is_open : whether no kind of initial state is stated
    rough : state and drive at the first sample, estimated from the record (the speed by the model, where available)
    """

    record: str = field(compare=False)
    leads: bool = field(compare=False)
    start_is_open: bool = field(compare=False)
    rough: RunStart = field(compare=False)


def rough_start(time: np.ndarray, channels: Mapping[str, np.ndarray], Omega: float) -> RunStart:
    """Estimate the starting values of a run.

    Parameters
    ----------
    time : (n,) s
    channels : by column name, (n,) each, SI; at least one
    Omega : excitation frequency, rad/s
    """
    noise = {name: max(noise_level(y), 1e-5 * float(np.ptp(y)), 1e-12) for name, y in channels.items()}
    amplitude, phase = float("nan"), 0.0
    if "current" in channels:
        amplitude, phase, _ = tone_at(time, channels["current"], Omega)
    elif "x_rel" in channels:
        ratio = Omega / ROD_FREQUENCY
        lag = np.arctan2(2.0 * ROD_DAMPING * ratio, 1.0 - ratio**2)
        phase = float(np.angle(np.exp(1j * (tone_at(time, channels["x_rel"], Omega)[1] + lag))))
    x_rel = rate = 0.0
    if "x_rel" in channels:
        x_rel, rate = _polynomial(time, channels["x_rel"], PARABOLA_SAMPLES, 2)[0]
        length = 0.5 * float(np.ptp(channels["x_rel"]))
    elif "acceleration_rod" in channels:
        # Contacts are short spikes, and quartiles are robust against them.
        length = float(np.subtract(*np.quantile(channels["acceleration_rod"], [0.75, 0.25]))) / Omega**2
    else:
        length = max(float(np.ptp(channels.get("x_capsule", 0.0))), 1e-4)
    capsule_rate = 0.0
    if "x_capsule" in channels:
        (_, slope), factor = _polynomial(time, channels["x_capsule"], LINE_SAMPLES, 1)
        if abs(slope) > SIGNIFICANT * factor * noise["x_capsule"]:
            capsule_rate = slope
    return RunStart(x_rel, rate, capsule_rate, length, amplitude, phase, noise)


def _polynomial(time: np.ndarray, values: np.ndarray, samples: int, order: int) -> tuple[tuple[float, float], float]:
    """Value and rate at the first sample, of a polynomial through ``samples`` samples; sd of the rate per noise sd."""
    samples = min(samples, len(time))
    design = np.vander(time[:samples] - time[0], order + 1, increasing=True)
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ values[:samples]
    return (float(coefficients[0]), float(coefficients[1])), float(np.linalg.norm(inverse[1]))


# parts: Multiple shooting: division of a record into parts, each with its own initial state.
#
# Where a motion amplifies small errors, one initial state cannot predict a whole record. It can predict a part of a few
# periods. All parts share gap, drive, noise and delays.


#: Separator between record label and number in the label of a part. File names do not contain it.
PART_MARK = "~"
#: Largest shift of a cut towards smooth motion, as a fraction of a part's length.
LEEWAY = 0.3


def parts_of(table: Table, seconds: float) -> list[Table]:
    """Divide the record into parts of about ``seconds``; return [``table``] if it is not longer."""
    time = table["time"]
    count = max(1, min(round((time[-1] - time[0]) / seconds), len(time) // SHORTEST_RECORD))
    if count == 1:
        return [table]
    edges = _edges(table, count)
    parts = []
    for i in range(count):
        rows = slice(*edges[i : i + 2])
        columns = {name: replace(column, values=column.values[rows]) for name, column in table.columns.items()}
        label = f"{table.label}{PART_MARK}{i + 1}"
        parts.append(replace(table, label=label, columns=columns, rows=table.rows[rows]))
    return parts


def _edges(table: Table, count: int) -> list[int]:
    """First samples of ``count`` parts, and the end.

    The state at a first sample comes from a parabola through the next samples. A cut therefore avoids samples where a
    contact begins or ends, or where the capsule sticks or slips.
    """
    samples = len(table["time"])
    length, rough = samples / count, _roughness(table)
    edges = [0]
    for i in range(1, count):
        first, last = (int((i + side * LEEWAY) * length) for side in (-1.0, 1.0))
        first = max(first, edges[-1] + SHORTEST_RECORD)
        window = rough[first : last + 1]
        edges.append(first + int(np.argmin(window)) if len(window) else int(i * length))
    return [*edges, samples]


def _roughness(table: Table) -> np.ndarray:
    """(n,) residual of a parabola through the samples from each one on, summed over positions, in units of noise."""
    time, n = table["time"], PARABOLA_SAMPLES
    total = np.zeros(len(time))
    # One projection serves all samples. It is approximate for uneven sampling, which suffices to choose a cut.
    design = np.vander(np.arange(n) - 0.5 * (n - 1), 3)
    rest = np.eye(n) - design @ np.linalg.pinv(design)
    for name in ("x_rel", "x_capsule"):
        if name in table.columns and len(time) >= n:
            windows = np.lib.stride_tricks.sliding_window_view(table[name], n)
            miss = np.sqrt(np.sum((windows @ rest) ** 2, axis=1))
            total[: len(miss)] += miss / max(float(np.median(miss)), 1e-300)
            total[len(miss) :] = np.inf
    return total
