"""Likelihood of progressions: displacement of the capsule after a number of drive periods, from rest."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.experiments.base import About, Fitted, Start, ValuesBySymbol, band, stacked
from capsule_id.experiments.capsule_experiment import CapsuleForward, lag_parameters, stated_parameters
from capsule_id.experiments.forced_run.declaration import SQUARE
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel, ground_parameters
from capsule_id.experiments.misfit import Misfit
from capsule_id.experiments.progression.declaration import (
    AMPLITUDE,
    DISCREPANCY,
    OUTLIER_SHARE,
    SESSION_SD,
    SESSIONS,
    TIMES,
    TRIAL_SCATTER,
    TRIAL_SD,
    sessions_of,
    settings_of,
)
from capsule_id.experiments.progression.density import (
    MIDDLE,
    RunEmulator,
    Sessions,
    TrialGroups,
    TrialMisfit,
    parameters_of,
)
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.batches import array_module
from capsule_id.physics.drives import Pulses
from capsule_id.physics.forces import FrictionLaw, equilibrium, scaled
from capsule_id.physics.model import CapsuleParameters, Drive, Excitation, without_absent
from capsule_id.physics.simulation import displacement, simulate
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable

# tables: Table of the sessions of a fitted progression: which trials belong to a parameter, and its friction.


def session_table(experiments: "Sequence[Progression]", fit: Fitted) -> list[ResultTable]:
    """Name the sessions that have parameters by the file's own numbers; [] where there are none.

    The friction is relative to a session with z = 0: of the point fit, with mean and sd where there are draws.
    """
    rows = []
    for e in experiments:
        theta, draws = e.local(fit.values), [e.local(draw) for draw in fit.draws]
        for session in np.flatnonzero(e.parameter >= 0):
            symbol = e.sessions.symbols[e.parameter[session]]
            factors = np.array([np.exp(one["session_sd"] * one[symbol]) for one in draws or [theta]])
            trials = np.flatnonzero(e.session[:, session])
            rows.append(
                {
                    "parameter": f"{symbol}[{e.label}]",
                    # Without this column each block of rows is a session with one setting, which has no parameter.
                    "session": f"{e.table['session'][trials[0]]:.15g}",
                    "settings": int(np.count_nonzero(e.session[:, session] @ e.setting)),
                    "trials": len(trials),
                    "friction": float(np.mean(factors)),
                    "its sd": float(np.std(factors)) if draws else np.nan,
                }
            )
    return [ResultTable("progression.sessions", pd.DataFrame(rows).set_index("parameter").round(4))] if rows else []


# checks: Check of a fitted progression: how much of the motion the model leaves unexplained.


#: Largest discrepancy of a model that explains the motion, relative to the rms of the measured mean velocities.
LARGEST_DISCREPANCY = 0.3


def check_discrepancy(experiments: "Sequence[Progression]", fit: Fitted) -> list[Finding]:
    """Compare the discrepancy with the scatter of the trials and with the measured velocities."""
    findings = []
    for e in experiments:
        theta = e.local(fit.values)
        sizes = [e.local(draw)["discrepancy"] for draw in fit.draws] or [theta["discrepancy"]]
        size, time = float(np.median(sizes)), e.setting @ e.time
        velocity = e.distance / time
        variance = e.reading_variance + theta["trial_sd"] ** 2 + (theta["trial_scatter"] * e.distance) ** 2
        rms = float(np.sqrt(np.mean(velocity**2)))
        facts = {"size": 1e3 * size, "scatter": 1e3 * float(np.sqrt(np.mean(variance / time**2))), "rms": 1e3 * rms}
        within = "ok" if facts["size"] <= facts["scatter"] else "warn"
        level = "fail" if size > LARGEST_DISCREPANCY * rms else within
        findings.append(Finding("progression.discrepancy", level, facts, e.label))
    return findings


# experiment: Likelihood of progressions: displacement of the capsule after a number of drive periods, from rest.
#
#     distance_i = X2(setting, friction exp(s_j)) (1 + trial scatter) + discrepancy_b v t_b + trial sd + reading error
#
# Session j has friction multiplied by exp(s_j), s_j ~ N(0, session_sd^2); see
# ``capsule_id.experiments.progression.density``. The discrepancy is an error of the model's mean velocity at
# setting b that all trials of the setting share. It enters linearly and is integrated out; see
# ``capsule_id.experiments.progression.density``. With heavy tails some trials have a larger error; see
# ``capsule_id.experiments.progression.declaration``.


#: Scales of the half-normal priors of trial_sd and discrepancy, relative to the largest reading.
TRIAL_PRIOR, DISCREPANCY_PRIOR = 0.05, 0.1
#: Parameters in proportion to the friction force.
FRICTION_FORCES = ("mu", "mu_back", "viscous")
#: Parameters that change no motion.
OF_TRIALS = ("trial_scatter", "trial_sd", "discrepancy")
#: Step of the derivative with respect to ``session_sd``, relative.
SESSION_STEP = 0.1
#: Draws of a band.
BAND_DRAWS = 200
#: Damping ratio and friction coefficient of the centre of the starting points, dimensionless.
DAMPING_RATIO, FRICTION = 0.1, 0.3


class Progression(CapsuleForward):
    """Trials of one table.

    Attributes
    ----------
    distance : (n,) displacement of the capsule, m
    settings : (settings, 4) period, s, number of periods, duty, amplitude, N or A; see ``declaration.settings_of``
    setting : (n, settings) 1 where a row belongs to a setting
    time : (settings,) duration of a trial, s
    session : (n, sessions) 1 where a row belongs to it
    parameter : (sessions,) index of the parameter of a session, see ``parameters_of``
    reading_variance : m^2
    heavy : whether trials have heavy tails, see ``capsule_id.experiments.progression.declaration``
    emulator : of ``runs``; None: they are exact
    """

    distance: np.ndarray
    settings: np.ndarray
    setting: np.ndarray
    time: np.ndarray
    session: np.ndarray
    parameter: np.ndarray
    sessions: Sessions
    groups: TrialGroups
    reading_variance: float
    drive: str = eqx.field(static=True)
    amplitude_from: str = eqx.field(static=True)
    heavy: bool = eqx.field(static=True)

    checks = (check_discrepancy,)
    tables = (session_table,)
    emulator: RunEmulator | None

    # The other scatters enter with the parameters, because they change the design.
    scatters = ("trial_sd",)
    has_joint_scatters = True

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.set_model(table, rig, friction)
        self.emulator, self.drive = None, table.settings.drive
        self.reading_variance = table.columns["distance"].reading_sd ** 2
        rows, self.amplitude_from = settings_of(table.columns, table.settings)
        settings, index = np.unique(rows, axis=0, return_inverse=True)
        setting, session = np.eye(len(settings))[index], sessions_of(table, rows)
        self.heavy = table.settings.tails == "heavy"
        parameter = parameters_of(setting, session)
        for name, value in self._cases(table["distance"], settings, setting, session, parameter).items():
            setattr(self, name, value)
        self.about = About(table, rig, ())
        self.about = replace(self.about, parameters=self._sampled())

    def _cases(
        self,
        distance: np.ndarray,
        settings: np.ndarray,
        setting: np.ndarray,
        session: np.ndarray,
        parameter: np.ndarray,
    ) -> dict[str, Any]:
        """Every field that depends on which trials there are, by name."""
        sessions = Sessions(setting, session, parameter)
        return {
            "distance": distance,
            "settings": settings,
            "setting": setting,
            "time": settings[:, 0] * settings[:, 1],
            "session": session,
            "parameter": parameter,
            "sessions": sessions,
            "groups": TrialGroups(distance, sessions, self.heavy),
        }

    def _sampled(self) -> tuple[Parameter, ...]:
        settings, free = self.table.settings, self.rig.model.free
        name = AMPLITUDE[self.drive]
        largest = float(np.max(np.abs(self.distance)))
        speed = float(np.max(np.abs(self.distance / (self.setting @ self.time))))
        floor = np.sqrt(self.reading_variance) + 1e-9
        return (
            parameter("k1"),
            parameter("c"),
            *self.friction.parameters,
            *ground_parameters(self.table, self.rig),
            *([parameter("k_cubic")] if "k_cubic" in free else []),
            *([parameter("K")] if self.amplitude_from == "current" else []),
            *stated_parameters(name, getattr(settings, name), kind="normal"),
            *lag_parameters(self.table, self.rig),
            SESSION_SD,
            *(row.named(self.label) for row in SESSIONS[: len(self.sessions.symbols)]),
            TRIAL_SCATTER,
            TRIAL_SD.named(self.label, Prior("halfnormal", 0.0, max(TRIAL_PRIOR * largest, floor))),
            DISCREPANCY.named(self.label, Prior("halfnormal", 0.0, max(DISCREPANCY_PRIOR * speed, 1e-9))),
        )

    @property
    def observed(self) -> np.ndarray:
        return self.distance

    def unstated_errors(self, symbol: str) -> set[str]:
        return {"gain", "zero"}

    @property
    def scaled_by(self) -> dict[str, tuple[str, ...]]:
        return {"session_sd": tuple(f"{symbol}[{self.label}]" for symbol in self.sessions.symbols)}

    @property
    def balanced(self) -> tuple[str, ...]:
        return tuple(row.name for row in self.parameters if row.symbol in FRICTION_FORCES)

    @property
    def mirrored(self) -> tuple[str, ...]:
        own = AMPLITUDE[self.drive]
        return (own,) if self.amplitude_from == "setting" and own not in self.exact else ()

    # -- the forward model --------------------------------------------------------------------------------------------

    def capsule(self, theta: ValuesBySymbol, settings: Any) -> tuple[CapsuleParameters, Drive]:
        """Parameters and drive at rows of ``settings`` (rows, 4), leaves () or (rows,)."""
        period, _, duty, amplitude = settings.T
        own = {"lag": 0.0, **self.exact, **theta}
        unit = {"column": 1.0, "current": theta.get("K", 0.0), "setting": own.get(AMPLITUDE[self.drive], 0.0)}
        force = unit[self.amplitude_from] * amplitude
        p = self.parameters_of(theta)
        if self.drive == "harmonic":
            return p, Excitation(force, 2.0 * np.pi / period, 0.0, self.reaction)
        off = -force if self.drive == SQUARE else 0.0
        return p, Pulses(force, period, duty, off, lag=own["lag"], reaction=self.reaction)

    def runs(self, theta: ValuesBySymbol) -> Any:
        """(..., runs) X2 of the runs of ``sessions``, m, by the exact or the smoothed engine; see ``displacements``."""
        return self.displacements(theta, self.sessions.log_friction(theta), self.settings[self.sessions.setting_of_run])

    def responses(self, theta: ValuesBySymbol) -> Any:
        """(cases, nodes) X2, m; see ``Sessions.responses``."""
        return self.sessions.responses(self.runs(theta) if self.emulator is None else self.emulator(theta))

    def displacements(self, theta: ValuesBySymbol, s: Any, settings: Any) -> Any:
        """X2, m, at rows of ``settings`` (rows, 4) with friction multiplied by exp(s).

        Parameters
        ----------
        theta : () each, with s (rows,); or (draws, 1) each, with s (draws, rows)
        """
        p, drive = without_absent(*self.capsule(theta, settings))
        r0, xp = equilibrium(p) if "slope" in self.ground else 0.0, array_module(s)
        given = (p, drive, scaled(self.law(theta), xp.exp(s)), r0, settings[:, 0], settings[:, 1])
        lanes = jax.tree.map(lambda leaf: xp.broadcast_to(xp.asarray(leaf, float), s.shape).ravel(), given)
        p, drive, law, r0, period, count = lanes
        if self.smoothing is None:
            return displacement(p, drive, law, period, count, r0).X2.reshape(s.shape)
        return _smoothed(p, drive, law, r0, period * count, self.smoothing).reshape(s.shape)

    def motions_of_draws(self, draws: Sequence[ValuesBySymbol]) -> np.ndarray:
        """(draws, runs) X2 for which the likelihood runs the capsule; not finite where a run fails."""
        return np.asarray(self.runs(stacked(draws, 1)))

    def with_emulator(self, draws: Sequence[ValuesBySymbol], motions: np.ndarray) -> "Progression":
        """Return the same trials with an emulator of the motions, fitted to ``motions_of_draws`` of ``draws``."""
        without = (*OF_TRIALS, "session_sd", *(row.symbol for row in SESSIONS))
        positive = {row.symbol: row.positive for row in self.parameters if row.symbol not in without}
        varied = {mass: True for mass in self.masses if len({draw[mass] for draw in draws}) > 1}
        emulator = RunEmulator(self.sessions, {**positive, **varied}, draws, motions)
        return eqx.tree_at(lambda e: e.emulator, self, emulator, is_leaf=lambda x: x is None)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        trials = self.trials_of(theta, self.responses(theta), xp)
        return (trials.linear(self.distance, self.sessions, theta["trial_sd"], xp),)

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[TrialMisfit]:
        return (self.trials_of(theta, self.responses(theta), xp),)

    def trials_of(self, theta: ValuesBySymbol, X2: Any, xp: ModuleType = jnp) -> TrialMisfit:
        """Likelihood of the trials at the ``responses``."""
        discrepancy = theta["discrepancy"] * xp.asarray(self.time)
        return TrialMisfit(self.groups, xp.asarray(X2), self.reading_variance, theta["trial_scatter"], discrepancy)

    def profile(self, theta: ValuesBySymbol) -> Any:
        """The log-likelihood as a function of values of the scatters, by symbol; motions linear in ``session_sd``."""
        sd = theta["session_sd"]
        X2, more = (np.asarray(self.responses({**theta, "session_sd": f * sd})) for f in (1.0, 1.0 + SESSION_STEP))
        change = (more - X2) / SESSION_STEP
        # Below, they are bent: at 0, a session that is integrated out has the motion of z = 0.
        bend = (change - (X2 - X2[:, [MIDDLE]])) * self.sessions.alone[:, None]

        def log_likelihood(scatters: ValuesBySymbol) -> float:
            own = {**theta, **scatters}
            h = own["session_sd"] / sd - 1.0
            moved = X2 + h * change + min(h, 0.0) ** 2 * bend
            return float(self.trials_of(own, moved, np).log_density(own["trial_sd"], np))

        return log_likelihood

    # -- starting points and the report -------------------------------------------------------------------------------

    def starts(self) -> dict[str, Start]:
        """Starts of parameters of the motion and the trials, sampled or not."""
        m1, m2 = self.rig.mass("m1"), self.rig.mass("m2")
        k1 = m1 * (2.0 * np.pi / float(np.median(self.settings[:, 0]))) ** 2
        largest = float(np.max(np.abs(self.distance)))
        priors = {row.symbol: cast(Prior, row.prior) for row in self.parameters if row.prior}
        starts = {
            "k1": Start(k1, 0.7),
            "c": Start(2.0 * DAMPING_RATIO * float(np.sqrt(k1 * m1)), 1.0),
            "mu": Start(FRICTION, 0.5),
            "mu_back": Start(FRICTION, 0.5),
            "v_s": Start(0.3, 1.0),
            "ratio": Start(0.7, 0.3),
            **({"lag": Start(0.05 * float(np.median(self.settings[:, 0])), 1.0)} if "lag" in priors else {}),
            "session_sd": Start(0.05, 0.3),
            **{f"{symbol}[{self.label}]": Start(0.0, 1.0) for symbol in self.sessions.symbols},
            "trial_scatter": Start(0.05, 0.3),
            f"trial_sd[{self.label}]": Start(max(0.01 * largest, float(np.sqrt(self.reading_variance))), 0.3),
            f"discrepancy[{self.label}]": Start(0.5 * priors["discrepancy"].spread, 0.3),
        }
        for name in self.mirrored:
            prior = priors[name]
            friction = FRICTION * (m1 + m2) * self.rig.g.value
            starts[name] = Start(prior.location if abs(prior.location) > prior.spread else friction, 0.5 * prior.spread)
        return starts

    def excess_noise(self, theta: ValuesBySymbol) -> float:
        """Total error of a trial relative to its scatter, at the median setting."""
        size = float(np.median(np.abs(self.distance)))
        scatter = np.hypot(theta["trial_sd"], theta["trial_scatter"] * size) + np.sqrt(self.reading_variance)
        return float(np.hypot(scatter, theta["discrepancy"] * np.median(self.time)) / scatter)

    # -- settings left out and new ones -------------------------------------------------------------------------------

    def settings_of(self, columns: Mapping[str, Column]) -> tuple[np.ndarray, np.ndarray]:
        """Settings in the rows of a table, (rows, 4), and the durations of their trials, (rows,) s."""
        rows, _ = settings_of(columns, self.table.settings)
        return rows, rows[:, 0] * rows[:, 1]

    def setting_names(self) -> list[str]:
        """A short name for every setting: period, duty and amplitude where they may differ, number of periods."""
        return [f"{1e3 * row[0]:g} ms{self._duty_and_amplitude(row)}, {row[1]:g} periods" for row in self.settings]

    def _duty_and_amplitude(self, row: np.ndarray) -> str:
        """Duty and amplitude of a row of settings, where they may differ."""
        duty = f", duty {100.0 * row[2]:g} %" if self.drive != "harmonic" else ""
        return duty + {"column": f", {row[3]:g} N", "current": f", {row[3]:g} A"}.get(self.amplitude_from, "")

    def new_trials(self, draws: Sequence[ValuesBySymbol], settings: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(draws, rows) displacement, m, of a new trial in a new session at each row of ``settings`` (rows, 4).

        Each row has a session, a discrepancy and a trial of its own.
        """
        time = settings[:, 0] * settings[:, 1]
        z = rng.standard_normal((3, len(draws), len(settings)))
        own = stacked(draws, 1)
        X2 = np.asarray(self.displacements(own, own["session_sd"] * z[0], settings))
        variance = self.reading_variance + own["trial_sd"] ** 2 + (own["trial_scatter"] * X2) ** 2
        if self.heavy:
            variance = np.where(rng.uniform(size=variance.shape) < OUTLIER_SHARE, TIMES**2, 1.0) * variance
        return X2 + own["discrepancy"] * time * z[1] + np.sqrt(variance) * z[2]

    def speed_panels(
        self,
        settings: np.ndarray,
        centre: np.ndarray,
        limits: tuple[np.ndarray | None, np.ndarray | None],
        label: str,
        residuals: np.ndarray | None = None,
    ) -> tuple[Comparison, ...]:
        """One panel per duty and amplitude of ``settings`` (rows, 4): mean velocity against period, and the trials there.

        Parameters
        ----------
        centre, limits : (rows,) mean velocity and the limits of its band, mm/s
        label : of the curve
        residuals : (n,) of the trials, in units of the noise; None: not shown
        """
        speed, panels = 1e3 / self.time, []
        period = self.setting @ (1e3 * self.settings[:, 0])
        for group in np.unique(settings[:, 2:], axis=0):
            own = np.flatnonzero(np.all(settings[:, 2:] == group, axis=1))
            own = own[np.argsort(settings[own, 0], kind="stable")]
            lower, upper = (None if limit is None else limit[own] for limit in limits)
            rows = np.flatnonzero(self.setting[:, np.all(self.settings[:, 2:] == group, axis=1)].any(axis=1))
            trials = Points(self.label, period[rows], (self.distance * (self.setting @ speed))[rows])
            panels.append(
                Comparison(
                    "progression",
                    self.label,
                    f"{self.label}{self._duty_and_amplitude(settings[own[0]])}: mean velocity",
                    "period, ms",
                    "mean velocity, mm/s",
                    (trials,) if len(rows) else (),
                    (Curve(label, 1e3 * settings[own, 0], centre[own], lower, upper),),
                    None if residuals is None else residuals[rows],
                )
            )
        return tuple(panels)

    def densities_of_settings(self, draws: Sequence[ValuesBySymbol]) -> np.ndarray:
        """(draws, settings) log-density of the readings of each setting given the parameters and all others."""
        X2 = np.asarray(self.sessions.responses(self.motions_of_draws(draws)))
        pairs = zip(draws, X2, strict=True)
        return np.stack([self.trials_of(theta, own, np).of_settings(theta["trial_sd"], np) for theta, own in pairs])

    def without(self, setting: int) -> "Progression":
        """Return the experiment without the trials of one setting."""
        kept = self.setting[:, setting] == 0.0
        some = self.session[kept].any(axis=0)
        settings, setting_of = np.delete(self.settings, setting, axis=0), np.delete(self.setting[kept], setting, axis=1)
        left = self._cases(self.distance[kept], settings, setting_of, self.session[kept][:, some], self.parameter[some])
        fields = (*left, "emulator")
        return eqx.tree_at(
            lambda e: [getattr(e, name) for name in fields], self, [*left.values(), None], is_leaf=lambda x: x is None
        )

    def motions_without(self, motions: np.ndarray, setting: int) -> np.ndarray:
        """Those of ``motions_of_draws`` that the experiment without one setting has."""
        return motions[:, np.asarray(self.sessions.setting_of_run) != setting]

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        """One panel per duty and amplitude: trials, the point fit, and the band of a new trial in a new session."""
        settings = self.settings
        speed = 1e3 / self.time
        centre = np.asarray(self.displacements(theta, np.zeros(len(settings)), settings)) * speed
        chosen = draws[:: max(1, len(draws) // BAND_DRAWS)]
        trials = self.new_trials(chosen, settings, np.random.default_rng(0)) if chosen else np.empty((0, 0))
        limits = band(trials * speed if chosen else trials)
        residuals = np.asarray(self.residuals(theta, np))[: self.n]
        return self.speed_panels(settings, centre, limits, "this fit, 95 % band of a new trial", residuals)


@eqx.filter_jit
def _smoothed(p: CapsuleParameters, drive: Drive, law: FrictionLaw, r0: Any, time: Any, smoothing: Smoothing) -> Any:
    """(lanes,) X2 after ``time`` by the smoothed engine; not finite where a run fails, one without a normal force too."""
    times = jnp.stack([jnp.zeros_like(time), time], axis=1)
    rest = (r0, 0.0, 0.0, 0.0)
    return simulate(p, drive, times, rest, model="smooth", smoothing=smoothing, friction=law).X2[:, 1]
