"""Free vibration of the rod, motor switched on, capsule at rest (paper, section 2.2): k1 and c."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.experiments.base import (
    About,
    Start,
    ValuesBySymbol,
    axis_label,
    band,
    clock_parameters,
    stated_rate,
    stretch,
)
from capsule_id.experiments.checks import LEVEL, autocorrelation, ljung_box, refit
from capsule_id.experiments.context import Fitted
from capsule_id.experiments.free_vibration.checks import CHECKS, later_start, stiffness_by_record
from capsule_id.experiments.free_vibration.declaration import AMPLITUDE, TURNING_TIME
from capsule_id.experiments.free_vibration.hidden_terms import check_hidden_terms, reduced_record
from capsule_id.experiments.free_vibration.models import (
    UNKNOWNS,
    Decrement,
    damping_of_peaks,
    decay,
    decay_moments,
    equilibrium,
    fold,
    logarithmic_decrement,
    rates,
    steps_of,
    trend,
    uniform_step,
    viscous_basis,
    viscous_fit,
)
from capsule_id.experiments.free_vibration.noise import ReadingTimes, noise_parameters, whiten
from capsule_id.experiments.free_vibration.readings import (
    CHANNELS,
    Channel,
    DecayModel,
    block_mean,
    block_means,
    channel_of,
    decay_window,
    is_even,
    stated_model,
)
from capsule_id.experiments.free_vibration.second_fit import (
    Screened,
    Screening,
    decay_starts,
    first_turning_point,
    further_parameters,
    nested_starts,
)
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel, SurfaceExperiment
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit, Moments
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.records.release import shortened
from capsule_id.records.tones import noise_level, other_tone
from capsule_id.rig.filters import choose_window, savitzky_golay
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.views import Comparison, Curve, Facts, Finding, Points, ResultTable

# tables: Views of free decays: estimates by record, comparison of the stated with the quoted model, and the fitted
# curve.


def decay_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Compare k1 and c of every record alone with the paper's protocol."""
    k1, k1_sd, deflection = stiffness_by_record(records, fit.values)
    rows = []
    for i, record in enumerate(records):
        raw, smooth = record.paper_decrement(smooth=False), record.paper_decrement()
        ours = refit(record, record.local(fit.values), [])
        rows.append(
            {
                "record": record.label,
                "largest deflection, m": deflection[i],
                "k1, N/m": k1[i],
                "± k1": k1_sd[i],
                "c, N s/m": ours["c"][0],
                "± c": ours["c"][1],
                "k1 = m1Ω_o²": smooth.k1 if smooth else np.nan,
                "c, smoothed peaks": smooth.c if smooth else np.nan,
                "c, raw peaks": raw.c if raw else np.nan,
            }
        )
    return [ResultTable("decays.records", pd.DataFrame(rows).set_index("record"))]


def damping_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Correlations of the damping parameters; [] where all damping is viscous."""
    symbols = dict.fromkeys(symbol for record in records for symbol in record.model.symbols if symbol != "k_cubic")
    if not symbols:
        return []
    names = ["c", *symbols]
    frame = pd.DataFrame(fit.correlation(names), index=pd.Index(names, name="correlation"), columns=names)
    return [ResultTable("decays.damping", frame)]


def second_fit_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Compare the decays alone under the stated model and under the quoted one; [] where both are the same."""
    del fit
    replaced = [(record, record.about.screened) for record in records if record.about.screened is not None]
    if not replaced:
        return []
    # Both fits use the same samples, so that their BIC can be compared.
    thins = [replace(DecayModel.stated(record.table.settings), thin=record.model.thin) for record, _ in replaced]
    stated = [Screening(record, model.thin).fit(model)[0] for (record, _), model in zip(replaced, thins, strict=True)]
    rows = []
    for role, model, fits in (
        ("stated", thins[0], stated),
        ("quoted", replaced[0][0].model, [screened for _, screened in replaced]),
    ):
        means = {symbol: _weighted_mean(fits, symbol) for symbol in ("k1", "c", *model.symbols)}
        white = all(ljung_box(one.residuals)[1] * len(records) >= LEVEL for one in fits)
        rows.append(
            {
                "fit": role,
                "model": model.name,
                "parameters": ", ".join(f"{name} = {mean:.5g} ± {sd:.2g}" for name, (mean, sd) in means.items()),
                "noise, SI": float(np.mean([one.noise for one in fits])),
                "BIC": sum(one.bic for one in fits),
                "residuals white": "yes" if white else "no",
            }
        )
    frame = pd.DataFrame(rows).set_index("fit")
    frame["BIC"] -= frame["BIC"].min()
    return [ResultTable("decays.second_fit", frame, {"lines": replaced[0][0].model.lines})]


def _weighted_mean(fits: "Sequence[Screened]", symbol: str) -> tuple[float, float]:
    """Mean of the estimates of every record, weighted by their standard errors, and its standard error."""
    weight = np.array([one.errors[symbol] for one in fits]) ** -2.0
    return float(np.average([one.values[symbol] for one in fits], weights=weight)), float(np.sum(weight) ** -0.5)


def decay_comparison(e: "FreeVibration", theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
    """Return the readings, the curve at ``theta``, the band of at most 50 ``draws``, and the residuals of one record."""

    def curve(values: ValuesBySymbol) -> np.ndarray:
        raw, design = e.unwhitened(values, np)
        return e.values - raw + e.width * design @ e.nuisance_mean(values)

    unit, time = e.column.to_display, e.time + float(decay_window(e.table)[0][0])
    lower, upper = band(np.array([curve(draw) for draw in draws[:50]]) * unit)
    residuals = np.asarray(e.residuals(theta, np))[: e.n]
    return Comparison(
        e.kind,
        e.label,
        f"{e.label}: free decay",
        "time [s]",
        axis_label(e.column),
        (Points(e.label, time, e.values * unit),),
        (Curve(f"this fit, {e.model_name}", time, curve(theta) * unit, lower, upper),),
        time,
        residuals,
        autocorrelation(residuals, min(60, e.n // 4)),
        1.96 / float(np.sqrt(e.n)),
    )


# experiment: Free vibration of the rod, motor switched on, capsule at rest (paper, section 2.2): k1 and c.


#: Default prior of a record's noise, without reading error: log-normal, median 1 % of its range, factor 100.
NOISE_MEDIAN, NOISE_FACTOR = 0.01, 100.0
#: Twice the damping ratio up to which an even record is summed in closed form.
UNIFORM = 0.6
#: Polynomial order of the Savitzky–Golay filter in the paper's estimator.
SMOOTHING_ORDER = 3
#: A rough viscous fit whose residuals are this many times the noise misses a force.
MISFIT = 3.0


@dataclass(frozen=True)
class DecayAbout(About):
    """Further inputs of a decay.

    Attributes
    ----------
    screened : a fit of the record by a screening of models; it gives the starting point of a fit
    rough : the paper's estimate, or that of a least-squares fit where there are too few peaks
    """

    screened: "Screened | None" = field(default=None, compare=False)
    rough: Decrement | None = field(default=None, compare=False)


class FreeVibration(SurfaceExperiment):
    """One channel of one raw record; all records share k1, c and the parameters of further forces.

    For viscous damping and a linear spring the two solutions enter linearly and are integrated out. Any other decay
    starts at its last turning point before the record, which is sampled. Offset and linear drift are integrated out.

    The readings are block means of the record (``capsule_id.experiments.free_vibration.readings``), at ``time``
    (n,); ``relative_sd`` is the sd of one over that of a sample, () or (n,).
    """

    time: np.ndarray
    values: np.ndarray
    times: ReadingTimes
    nodes: np.ndarray
    weights: np.ndarray
    relative_sd: np.ndarray
    width: float
    reading_sd: float
    side: float
    folded: np.ndarray
    step: float
    clock_rate: float | None
    about: DecayAbout = eqx.field(static=True)
    model: DecayModel = eqx.field(static=True)
    half_cycles: int = eqx.field(static=True)
    uniform: bool = eqx.field(static=True)
    #: Order of the time derivative of x_rel that the readings are.
    order: int = eqx.field(static=True)

    time_series = True
    checks = (*CHECKS, check_hidden_terms)
    tables = (decay_table, damping_table, second_fit_table)

    def __init__(
        self,
        table: Table,
        rig: Rig,
        friction: FrictionModel = EQUATION_1,
        model: DecayModel | None = None,
        screened: "Screened | None" = None,
    ) -> None:
        """Make one record; ``model`` None: as stated in the settings; ``screened`` gives starts."""
        self.friction = friction
        self.model = model or stated_model(table)
        self.order = CHANNELS[channel_of(table)].order
        time, values = decay_window(table)
        elapsed = time - float(time[0])
        blocks = block_means(elapsed, values, self.model.thin, by_sample=channel_of(table) != "x_rel")
        self.time, self.values, self.nodes, self.weights = blocks.time, blocks.values, blocks.nodes, blocks.weights
        self.times = ReadingTimes.of(blocks)
        self.relative_sd = np.squeeze(1.0 / np.sqrt(self.times.count))
        self.width = NUISANCE_WIDTH * float(np.ptp(self.values))
        self.reading_sd = table.columns[channel_of(table)].reading_sd
        self.about = DecayAbout(table, rig, (), screened)
        rough = self._rough()
        self.about = replace(self.about, rough=rough)
        step = uniform_step(self.time)
        linear = self.model == DecayModel(thin=self.model.thin) and self.relative_sd.ndim == 0
        # The sums over an even record have no values at critical damping and beyond.
        self.uniform = step is not None and linear and bool(rough.c < UNIFORM * np.sqrt(rough.k1 * self.mass))
        if self.uniform:
            # Means of equal blocks of a viscous decay are such a decay, sampled at their middles.
            self.nodes, self.weights = self.time[:, None], np.ones((len(self.time), 1))
        self.step = step or 0.0
        self.folded = fold(self.values) if self.uniform else np.zeros((0, 0))
        self.side, self.half_cycles = 1.0, 0
        self.clock_rate = stated_rate(table)
        rows = [parameter("k1"), parameter("c"), self.channel.noise.named(table.label, self.noise_prior())]
        if self.model.whitened:
            period = 2.0 * np.pi / rough.Omega_o
            rows += noise_parameters(self.model, self.time, period, table.label)
        if not self.closed:
            turning = first_turning_point(self)
            self.side = float(np.sign(turning[1]))
            # The margin allows for a frequency 1.25 times the rough estimate.
            self.half_cycles = int(1.25 * rough.Omega_o * float(self.time[-1]) / np.pi) + 5
            rows += further_parameters(self.model.symbols, rough.k1, self.mass, self.largest_deflection)
            rows += [
                AMPLITUDE.named(
                    table.label, Prior("lognormal", self.deflection * float(np.ptp(self.values)), NUISANCE_WIDTH)
                ),
                TURNING_TIME.named(table.label, Prior("normal", 0.0, float(self.time[-1]))),
            ]
        self.about = replace(self.about, parameters=(*rows, *clock_parameters(table, rig)))

    def with_table(self, table: Table) -> "FreeVibration":
        """Return the record of another part of its table, with the same model."""
        return self if table is self.table else FreeVibration(table, self.rig, self.friction, self.model)

    def with_model(self, model: DecayModel, screened: "Screened | None" = None) -> "FreeVibration":
        """Return the same record with another model; its fit ``screened`` gives the starting point."""
        return FreeVibration(self.table, self.rig, self.friction, model, screened)

    @classmethod
    def second_models(
        cls, records: "Sequence[Any]", readings: Sequence[Finding] = ()
    ) -> tuple[list[Any], list[Finding]]:
        from capsule_id.experiments.free_vibration.second_fit import second_models

        return second_models(records, readings)

    @property
    def stated_words(self) -> tuple[str, ...]:
        """Keys of the model that the entry states; a second fit leaves them as they are."""
        words = ("damping", "stiffness", "drift", "noise")
        return tuple(word for word in words if getattr(self.table.settings, word) is not None)

    @property
    def replaced(self) -> bool:
        """Whether a second fit has chosen the model."""
        return self.about.screened is not None

    @property
    def explains_trend(self) -> bool:
        return self.model.drift == "gp"

    @property
    def closed(self) -> bool:
        """Whether the solution is closed and linear in its initial conditions."""
        return not self.model.symbols

    def noise_prior(self) -> Prior:
        """Default prior of the record's noise sd, m."""
        return Prior("lognormal", NOISE_MEDIAN * float(np.ptp(self.values)), NOISE_FACTOR)

    def motion_parameters(self, rough: Decrement) -> tuple[Parameter, Parameter]:
        """Parameters for x_rel and its rate at the first sample, with wide priors."""
        x_start = parameter("x_start", self.label, Prior("normal", 0.0, self.width))
        return x_start, parameter("y_start", self.label, Prior("normal", 0.0, self.width * rough.Omega_o))

    @property
    def scatters(self) -> tuple[str]:
        return (self.channel.noise.symbol,)

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1",)

    @property
    def column(self) -> Column:
        return self.table.columns[channel_of(self.table)]

    @property
    def channel(self) -> Channel:
        """The recorded quantity."""
        return tuple(CHANNELS.values())[self.order]

    @property
    def deflection(self) -> float:
        """x_rel over the magnitude of the channel, at the rough frequency; SI."""
        return 1.0 if self.order == 0 else abs(self.channel.deflection(self.rough_decrement().Omega_o))

    @property
    def observed(self) -> np.ndarray:
        return self.values

    @property
    def work(self) -> int:
        # A step of a half cycle takes as long as twelve readings, correlated noise of a reading as three.
        steps = 0 if self.closed else self.half_cycles * steps_of(self.half_cycles)
        return self.n * (4 if self.model.whitened else 1) + 12 * steps

    @property
    def model_name(self) -> str:
        """Name for the legend."""
        return self.model.name

    def unwhitened(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Any, Any]:
        """Measured minus predicted (n,), and the design (n, p) of the nuisances in units of ``width``."""
        trend = xp.ones((self.n, 1))
        if self.model.drift == "linear":
            trend = xp.stack([xp.ones(self.n), xp.asarray(self.time) / self.time[-1] - 0.5], axis=1)
        nodes = xp.asarray(self.nodes).ravel() * stretch(self.clock_rate, theta)
        if self.closed:
            basis = viscous_basis(nodes, theta["k1"], theta["c"], theta["m1"], xp)
            basis = block_mean(basis, self.weights, xp)
            return self.values, xp.concatenate([basis, trend], axis=1)
        forces = {symbol: theta[symbol] for symbol in ("k1", "c", "m1", *self.model.symbols)}
        motion = decay(nodes, forces, theta["amplitude"], theta["turning_time"], self.half_cycles)
        return self.values - self.side * block_mean(xp.asarray(motion[self.order]), self.weights, xp), trend

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        raw, design = self.unwhitened(theta, xp)
        if not self.model.whitened:
            return (Misfit(raw, (self.reading_sd * self.relative_sd) ** 2, self.relative_sd, self.width * design),)
        columns = xp.concatenate([xp.reshape(raw, (-1, 1)), self.width * design], axis=1)
        white = xp.asarray(whiten(self.times, columns, self.model, theta))
        return (Misfit(white[:, 0], 0.0, 1.0, white[:, 1:]),)

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        if not self.uniform or xp is np:
            return super().summaries(theta, xp)
        gamma, omega = (rate * stretch(self.clock_rate, theta) for rate in rates(theta["k1"], theta["c"], theta["m1"]))
        yy, ay, aa = decay_moments(self.folded, self.n, self.step, gamma, omega)
        variance = (self.reading_sd * self.relative_sd) ** 2
        return (Moments(yy, self.width * ay, self.width**2 * aa, self.n, variance, self.relative_sd),)

    # -- the paper's estimator and starts ---------------------------------------------------------------------------

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Time, s from the first sample, and the channel, SI, of every sample, thinned or not."""
        time, values = decay_window(self.table)
        return time - time[0], values

    @property
    def condensed(self) -> tuple[np.ndarray, np.ndarray]:
        """As ``whole``; of a long record block means, for the paper's estimate. Their times start at the first mean."""
        time, values = shortened(*decay_window(self.table))
        return time - time[0], values

    @property
    def even(self) -> bool:
        """Whether the record is evenly sampled, as the paper's filter requires."""
        return is_even(self.condensed[0])

    def smoothed(self) -> np.ndarray:
        """The condensed record after Savitzky–Golay, m; raw for a record sampled unevenly, which the filter rejects."""
        time, values = self.condensed
        if not self.even:
            return values
        window = self.table.settings.smoothing_window or choose_window(time, values, SMOOTHING_ORDER)
        return savitzky_golay(time, values, window, SMOOTHING_ORDER)

    def decrement(self, smooth: bool = True) -> Decrement | None:
        """Return peaks and logarithmic decrement, from the smoothed or the raw record; None with too few peaks."""
        (time, values), smoothed = self.condensed, self.smoothed()
        return logarithmic_decrement(time, smoothed if smooth else values, self.mass, smoothed, jumps=self.order == 2)

    def paper_decrement(self, smooth: bool = True) -> Decrement | None:
        """Estimate k1 and c of this record as in the paper; None also for a record sampled unevenly."""
        return self.decrement(smooth) if self.even else None

    @property
    def mass(self) -> float:
        """Measured mass of the rod, kg."""
        return self.rig.mass("m1")

    def rough_decrement(self) -> Decrement:
        """The paper's estimate, or that of a least-squares fit where there are too few peaks."""
        return self.about.rough or self._rough()

    def _rough(self) -> Decrement:
        decrement = self.decrement()
        if decrement is not None and decrement.delta > 0.0:
            return decrement
        found = viscous_fit(self.time, self.values)
        if self.order == 0 and np.std(found.left) > MISFIT * noise_level(self.values):
            # Dry friction is a constant force up to the first turning point, where the rest of the record misleads.
            period = int(np.sum(self.time - self.time[0] < 2.0 * np.pi / found.omega))
            turn = int(np.argmax(np.abs(self.values[:period] - self.values[0])))
            if turn >= 2 * UNKNOWNS:
                found = viscous_fit(self.time[:turn], self.values[:turn])
                found = found._replace(gamma=max(found.gamma, 0.01 * found.omega))  # a stroke tells little of it
        return found.decrement(self.mass)

    def rough_damping(self, symbols: Sequence[str]) -> dict[str, float]:
        """Rough c, and those of F_dry and c_q in ``symbols``, SI, from the peaks; {} with too few of them."""
        decrement = self.decrement()
        return {} if decrement is None else damping_of_peaks(decrement, self.mass, self.deflection, symbols)

    def starts(self) -> dict[str, Start]:
        return decay_starts(self)

    def nested_starts(self) -> Sequence[Mapping[str, float]]:
        return nested_starts(self)

    # -- interface to the report and the checks ---------------------------------------------------------------------

    @property
    def largest_deflection(self) -> float:
        """Largest distance of a sample from the rest position, m."""
        return self.deflection * float(np.max(np.abs(self.values - equilibrium(self.values))))

    def reduced(self, theta: ValuesBySymbol) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See ``capsule_id.experiments.free_vibration.hidden_terms.Decay``."""
        return reduced_record(self, theta)

    @property
    def cycles(self) -> np.ndarray:
        return self.time * self.rough_decrement().Omega_o / (2.0 * np.pi)

    def damping_trend(self) -> Facts:
        """Drift of damping and frequency of the peaks with amplitude, see ``trend``; empty without drift."""
        decrement = self.decrement()
        facts = {} if decrement is None else trend(decrement, noise_level(self.values))
        return facts and {**facts, "amplitude": tuple(self.deflection * size for size in facts["amplitude"])}

    def largest_force(self, theta: ValuesBySymbol) -> float:
        """Largest |f| over the record, N; f = k1 x_rel + c d(x_rel)/dt."""
        if self.order > 0:
            return float(theta["k1"]) * self.largest_deflection
        x = self.smoothed() - equilibrium(self.values)
        return float(np.max(np.abs(theta["k1"] * x + theta["c"] * np.gradient(x, self.condensed[0]))))

    def noise_facts(self) -> Facts:
        facts = {"present": self.model.additions, "second": self.replaced, "lines": self.model.lines}
        facts |= {"tone": other_tone(self.time, self.values)}
        return {"model": "decay", "stated": self.stated_words, **facts, **self.damping_trend(), **later_start(self)}

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        return decay_comparison(self, theta, draws)
