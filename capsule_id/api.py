"""What the commands do, as functions, and the finished fit that they return."""

import json
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import MISSING, dataclass, fields
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import ArrayLike

from capsule_id.console import OnProgress, Progress, fit_stages
from capsule_id.errors import InputError
from capsule_id.experiments.friction_model import friction_of
from capsule_id.experiments.kind import Choice, Registry, default_registry, make_experiments
from capsule_id.inference.pipeline import (
    check_fit,
    check_readings,
    make_result,
    provenance,
    sample_posterior,
    second_models,
    stage_seeds,
    unfinished,
)
from capsule_id.inference.planning import Plan, next_tests
from capsule_id.inference.point_stage import fit_points
from capsule_id.inference.prediction import DRAWS, predict, random_draws
from capsule_id.inference.profiles import check_profiled
from capsule_id.inference.result import Result, held_leaves
from capsule_id.inference.sampling import DEFAULT_BUDGET, DEFAULT_ESS
from capsule_id.inference.target import LogPosterior
from capsule_id.inference.tuning import Tuning, tune
from capsule_id.output import check_directory, replace_file
from capsule_id.parameters import by_index, is_stated, refuse_another_law, symbol_of
from capsule_id.physics.forces import Force, FrictionLaw, warn_of_far_gap
from capsule_id.physics.model import CapsuleParameters, Drive, Trajectory
from capsule_id.physics.simulation import simulate
from capsule_id.precision import prepare_xla
from capsule_id.report.columns import (
    differences,
    errors_left_out,
    sampled_parameters,
    table_rows,
    table_text,
    verdict_text,
    wrapped,
)
from capsule_id.report.figures import fits as figures
from capsule_id.report.figures.style import subfigure_at
from capsule_id.report.html import summary_html
from capsule_id.report.messages import caption_of, finding_text, messages_of, title_of
from capsule_id.report.write import data_tree, load_fields, model_json, replace_result, result_files, table_frame
from capsule_id.rig import read
from capsule_id.rig.model import Rig
from capsule_id.views import Finding, Level, ResultTable, Trust, after_number

# fitted: A finished fit as an object: words, tables, plots, simulations, files. ``fit`` and ``load`` return it.


#: Largest number of parameters in ``repr``.
SHOWN_PARAMETERS = 4

Item = TypeVar("Item")


@dataclass(frozen=True)
class ParameterValue:
    """A parameter of a fit: the numbers to quote, SI, as parameters.json has them; what is missing is NaN.

    Attributes
    ----------
    name, unit : such as ``k2[soft]`` and ``N/m``
    value, sd : median and sd of the sample; without a sample the maximum and its standard error
    lower, upper : ends of the 95 % interval; NaN without a sample
    trust : "trusted", "not trusted" or "not judged"
    quoted : value and sd as the printed tables have them, or value and interval of a skewed posterior
    """

    name: str
    unit: str
    value: float
    sd: float
    lower: float
    upper: float
    trust: Trust
    quoted: str

    def __str__(self) -> str:
        return f"{self.name} = {self.quoted}, {self.trust}"


def _warn_of_another_model(drive: Drive, fitted: float, chosen: Collection[str]) -> None:
    """Warn of a drive that reacts otherwise than in the fit, and of fitted damping that the capsule does not have."""
    reaction = getattr(drive, "reaction", None)
    if reaction is not None and np.any(np.asarray(reaction) != fitted):
        warnings.warn(f"the drive has reaction = {reaction}; that of the fit is {fitted:g}", stacklevel=3)
    if lost := [name for name in ("F_dry", "c_q") if name in chosen]:
        warnings.warn(f"the capsule has no {' and no '.join(lost)}: its rod is damped by c alone", stacklevel=3)


@dataclass(frozen=True, repr=False)
class Fit(Result):
    """A ``Result`` in words, tables, plots and files.

    ``result["k1"]`` has ``value``, ``sd`` and ``trust``; ``trust`` is the word of the whole result; ``summary`` holds
    all columns of every parameter. The methods ``plot_*`` draw into ``ax``, or into a new pyplot figure, and return
    the axes.
    """

    @property
    def parameters(self) -> Mapping[str, ParameterValue]:
        """The physical parameters by name, in the order of ``summary``."""
        numbers = ("value", "sd", "lower", "upper")
        return {
            row.name: ParameterValue(
                name=row.name,
                unit=str(row.values["unit"]),
                trust=row.values["trust"],
                quoted=row.quoted + after_number(row.unit),
                **{number: float(row.values[number]) for number in numbers},
            )
            for row in table_rows(self.summary)
        }

    def __getitem__(self, name: str) -> ParameterValue:
        """The parameter ``name``, such as ``result["k1"]`` or ``result["k2[soft]"]``.

        Raises
        ------
        InputError
            If the fit has no such parameter; the error lists names near it.
        """
        known = self.parameters
        if name in known:
            return known[name]
        raise _unknown("parameter", name, known, [one for one in known if symbol_of(one) == symbol_of(str(name))])

    def __contains__(self, name: object) -> bool:
        return name in self.parameters

    def __iter__(self) -> Iterator[str]:
        return iter(self.parameters)

    def table(self, code: str) -> pd.DataFrame:
        """The table ``code`` of the report, such as ``runs.precision``; ``notes`` holds all of them.

        Tables of one code, as of several records, stand one below the other.

        Raises
        ------
        InputError
            If the fit has no such table; the error lists codes near it.
        """
        frames = [note.frame for note in self.notes if note.code == code]
        if not frames:
            raise _unknown("table", code, dict.fromkeys(note.code for note in self.notes))
        return frames[0].copy() if len(frames) == 1 else pd.concat(frames)

    @property
    def failed(self) -> list[str]:
        """Titles of the failed checks, causes first."""
        return list(dict.fromkeys(title for level, title in self._titles if level == "fail"))

    @property
    def verdict(self) -> str:
        """The verdict in one line: trust, failed checks, number of warnings."""
        return verdict_text(self.trust, self._titles)

    @property
    def _titles(self) -> list[tuple[Level, str]]:
        messages = messages_of(self.registry)
        return [(finding.level, title_of(finding.code, messages)) for finding in self.findings]

    @property
    def remarks(self) -> list[str]:
        """Texts that the console shows under the table: a quoted model that is not the stated one, and unusual magnitudes."""
        messages = messages_of(self.registry)
        found = [f for f in self.findings if f.code in messages and messages[f.code].on_console and f.level != "ok"]
        return list(dict.fromkeys(self.text(f) for f in found))

    def text(self, item: Finding | ResultTable) -> str:
        """What a finding says (what was expected, what was found, what to do), or the caption of a table."""
        messages = messages_of(self.registry)
        return finding_text(item, messages) if isinstance(item, Finding) else caption_of(item, messages)

    def __repr__(self) -> str:
        rows = [row for row in table_rows(self.summary) if not is_stated(row.name)]
        shown = [f"{row.name} = {row.quoted} {row.unit}" for row in rows]
        more = f", and {len(shown) - SHOWN_PARAMETERS} more" if len(shown) > SHOWN_PARAMETERS else ""
        synthetic = ", synthetic" if self.rig.synthetic else ""
        return f"<Fit of {self.rig.name}{synthetic}: {self.trust}; {', '.join(shown[:SHOWN_PARAMETERS])}{more}>"

    @property
    def parameter_table(self) -> str:
        """The parameter table as the console shows it, with the remarks and what no sd contains under it."""
        under = wrapped([*self.remarks, *errors_left_out(self.summary)])
        return "\n".join([table_text(self.summary, synthetic=self.rig.synthetic), *under])

    def __str__(self) -> str:
        return f"{self.parameter_table}\n{self.verdict}"

    def _repr_html_(self) -> str:
        return summary_html(self, self.verdict, [*self.remarks, *errors_left_out(self.summary)])

    def to_dataframe(self) -> pd.DataFrame:
        """The content of parameters.csv: a row per parameter, noise levels included (``role``), SI."""
        return table_frame(self)

    def to_arviz(self) -> Any:
        """The sample for ArviZ: its InferenceData (ArviZ 0.2x), else an ``xarray.DataTree``.

        Raises
        ------
        ValueError
            If nothing was sampled.
        """
        tree = data_tree(self)
        try:
            kind: Any = getattr(import_module("arviz"), "InferenceData", type(tree))  # an optional package
        except ImportError:
            return tree
        if isinstance(tree, kind):  # ArviZ 1
            return tree
        return kind(**{str(name): group.to_dataset() for name, group in tree.children.items()})

    def simulate(
        self,
        drive: Drive,
        times: ArrayLike,
        draws: int = 100,
        spring: str | None = None,
        gap: float = math.inf,
        given: Mapping[str, float] | None = None,
        seed: int = 0,
    ) -> Trajectory:
        """Motion of the capsule from rest for draws of the posterior; every field has the axis (draws,) in front.

        Parameters
        ----------
        drive : such as ``Excitation(P_d=4.0, Omega=34.56)``; another ``reaction`` than that of [model] is a warning, and so is
            damping of the fit (F_dry, c_q) that the capsule does not have
        times : (n,) s, increasing
        draws : number of draws, taken at random without repetition
        spring : name of the support spring, k2[spring]; None: no support spring
        gap : G, m; needed with ``spring``. One far beyond the motion is a warning
        given : leaves of ``CapsuleParameters`` that the fit does not have, SI by name
        seed : of the choice of draws

        Raises
        ------
        InputError
            If nothing was sampled, there are fewer draws, the fit has another friction law than eq. (1) or constant
            friction, the spring was not fitted, or a parameter or the gap is missing.
        """
        chosen = random_draws(self, draws, np.random.default_rng(seed))
        refuse_another_law(self.provenance.friction)
        stated = {name: x for name, x in held_leaves(self.rig).items() if x is not None}
        values = {**stated, **self.fixed, "k2": 0.0, "G": gap, **chosen, **(given or {})}
        _warn_of_another_model(drive, self.rig.model.share_of_reaction, chosen)
        leaves = fields(CapsuleParameters)
        names = [leaf.name for leaf in leaves]
        if unknown := {*(given or {})} - {*names}:
            raise InputError(
                "given must name leaves of CapsuleParameters", repr(min(unknown)), f"choose from {', '.join(names)}"
            )
        values |= {} if spring is None else {"k2": _spring_of(chosen, spring)}
        for k, G in (("k2", "G"), ("k2_back", "G_back")):
            stiff, near = np.any(np.asarray(values.get(k, 0.0)) > 0.0), np.all(np.isfinite(values.get(G, math.inf)))
            if stiff != near:
                raise InputError(
                    "a support spring needs its gap, and a gap its spring",
                    f"{k if stiff else G} alone" + (f" ({spring!r})" if spring else ""),
                    "give both, spring='NAME' and gap=1e-3, in m, or neither",
                )
        if missing := [leaf.name for leaf in leaves if leaf.default is MISSING and leaf.name not in values]:
            raise InputError(
                "simulate needs every parameter of the capsule",
                f"the fit has no {', '.join(missing)}",
                f"state given={{{missing[0]!r}: ...}}, SI",
            )
        p = CapsuleParameters(**{leaf.name: values[leaf.name] for leaf in leaves if leaf.name in values})
        motion = simulate(p, drive, times)
        warn_of_far_gap(p.G, motion.x_rel)
        return motion

    def predict(self, settings: str | Path, draws: int = DRAWS, seed: int = 0) -> pd.DataFrame:
        """Predict a new trial in a new session at each row of a table; see ``capsule_id.inference.prediction``."""
        return predict(self, settings, draws, seed).table

    def prediction_figure(self, settings: str | Path, draws: int = DRAWS, seed: int = 0) -> Figure:
        """Figure of the predictions of ``predict``: mean velocity against period, with the trials of the fit."""
        return figures.side_by_side(predict(self, settings, draws, seed).panels)

    def tune(
        self, bounds: Mapping[str, tuple[float, float]], given: Mapping[str, float] | None = None, **options: Any
    ) -> Tuning:
        """Search the settings of drive and rig that maximise the mean velocity; see ``capsule_id.inference.tuning.tune``.

        ``result.tune({"P_d": (1.0, 6.0), "Omega": (20.0, 50.0)}, {"G": 1e-3}).table``; bounds and given values in SI.
        """
        return tune(self, bounds, given, **options)

    def next_tests(self, targets: Sequence[str] = (), **options: Any) -> Plan:
        """Rank further tests by the expected sd of ``targets``; see ``capsule_id.inference.planning.next_tests``.

        ``result.next_tests(["c", "v_s"], minutes=30).table``.
        """
        return next_tests(self, targets, **options)

    def plot_comparison(self, label: str | None = None, ax: Axes | None = None) -> Axes:
        """Readings with the predicted curve and its 95 % band; ``label`` as in ``comparisons``, by default the first."""
        return _drawn(figures.comparison, _named(self.comparisons, label), ax)

    def plot_residuals(self, label: str | None = None, ax: Axes | None = None) -> Axes:
        """Residuals of the point fit in units of the noise; ``label``: by default the first panel that has some."""
        panels = [panel for panel in self.comparisons if panel.residuals is not None]
        return _drawn(figures.residuals, _named(panels, label), ax, height=2.4)

    def plot_autocorrelation(self, label: str | None = None, ax: Axes | None = None) -> Axes:
        """Autocorrelation of the residuals of a record; ``label``: by default the first record."""
        panels = [panel for panel in self.comparisons if panel.autocorrelation is not None]
        return _drawn(figures.autocorrelation, _named(panels, label), ax, height=2.4)

    def plot_record(self, name: str | None = None, ax: Axes | None = None) -> Figure:
        """Channels of a recorded run and its phase plane, several panels in the place of ``ax``: the figure."""
        return _drawn_in_panels(figures.overview, figures.overview_size, _named(self.records, name, "name").view, ax)

    def plot_force(self, name: str | None = None, ax: Axes | None = None) -> Axes:
        """Force on the rod from the recorded current, and the fitted drive."""
        records = [record for record in self.records if record.view.force is not None]
        return _drawn(figures.force_on_rod, _named(records, name, "name"), ax)

    def plot_corner(self, ax: Axes | None = None) -> Figure:
        """Histogram of every sampled parameter and contours (68 %, 95 %) of every pair, in the place of ``ax``: the figure."""
        return _drawn_in_panels(figures.corner, figures.corner_size, sampled_parameters(self), ax)

    def plot_traces(self, ax: Axes | None = None) -> Figure:
        """A few walkers of each ensemble against the step, several panels in the place of ``ax``: the figure."""
        return _drawn_in_panels(figures.traces, figures.traces_size, sampled_parameters(self), ax)

    def plot_starts(self, ax: Axes | None = None) -> Axes:
        """Where each start of the point fit began and ended, in standard deviations."""
        return _drawn(figures.point_fit_starts, self.point_fit, ax, *figures.starts_size(self.point_fit))

    def export(self, file: str | Path, draws: int = 1000, seed: int = 0) -> None:
        """Write the calibrated model as JSON, for other programs: values, covariance and draws of the parameters, SI.

        ``capsule_id/report/templates/model.schema.json`` describes the file. As in ``posterior.nc``, draws do not contain
        the ``widening`` of the sds, which the covariance contains.

        Raises
        ------
        InputError
            If nothing was sampled, or there are fewer draws.
        """
        chosen = random_draws(self, draws, np.random.default_rng(seed))
        replace_file(Path(file), json.dumps(model_json(self, chosen), allow_nan=False) + "\n")

    def write(self, directory: str | Path) -> None:
        """Write parameters.json, parameters.csv, posterior.nc, report.html and figures/ into ``directory``.

        Raises
        ------
        InputError
            If it exists and is not a result of this package.
        """
        check_directory(Path(directory))
        replace_result(result_files(self), Path(directory), {})


def compare(a: Result, b: Result) -> pd.DataFrame:
    """Which parameters of two results differ, and by how many standard deviations.

    The two fits must rest on different readings: shared readings make the differences smaller than their sds say.

    Returns
    -------
    DataFrame with a row per common parameter (index ``name``), SI: unit, value and sd of both, ``difference`` (b - a),
    its ``sd``, ``sds`` (their ratio) and ``differs``: more sds than two equal rigs differ by in any parameter in 1 of 20 cases.

    Raises
    ------
    InputError
        If ``a`` or ``b`` is something else than a result.
    """
    for one in (a, b):
        if not isinstance(one, Result):
            raise InputError(
                "compare takes two results",
                f"{type(one).__name__} {str(one)[:60]!r}",
                "give results of fit, or load(DIR)",
            )
    return differences(a.summary, b.summary)


def _spring_of(chosen: Mapping[str, np.ndarray], spring: str) -> np.ndarray:
    """k2 of a fitted spring, (draws,) N/m."""
    springs = by_index("k2", chosen)
    if spring not in springs:
        known = ", ".join(springs)
        raise InputError("spring must be a fitted one", repr(spring), f"choose from {known or 'none'}")
    return springs[spring]


def _unknown(what: str, word: str, known: Collection[str], near: Sequence[str] = ()) -> InputError:
    """The error of a ``word`` that the result does not know: it lists ``near`` words, else similar ones, else all."""
    close = near or get_close_matches(str(word), known, n=5) or known
    return InputError(f"the result must have this {what}", repr(word), f"choose from {', '.join(close) or 'none'}")


def _named(items: Sequence[Item], label: str | None, attribute: str = "label") -> Item:
    """The item with this label, which is its ``attribute``; the first one where ``label`` is None."""
    for item in items:
        if label in (None, getattr(item, attribute)):
            return item
    names = ", ".join(getattr(item, attribute) for item in items)
    raise InputError(
        "the result must have this panel",
        "there is none" if label is None else repr(label),
        f"choose from {names}" if names else "fit experiments that have it",
    )


def _new_axes(width: float, height: float, layout: Literal["constrained"] | None) -> Axes:
    """The axes of a new pyplot figure, inches."""
    from matplotlib import pyplot as plt

    return plt.subplots(figsize=(width, height), layout=layout)[1]


def _drawn(
    panel: Callable[[Any, Axes], None], data: object, ax: Axes | None, width: float = 6.4, height: float = 4.4
) -> Axes:
    """The axes with the panel of ``data``: ``ax``, or those of a new pyplot figure."""
    ax = ax or _new_axes(width, height, "constrained")
    panel(data, ax)
    return ax


def _drawn_in_panels(
    draw: Callable[[Any, SubFigure], None], size: Callable[[Any], tuple[float, float]], data: object, ax: Axes | None
) -> Figure:
    """The figure with several panels of ``data`` in the place of ``ax``, or a new pyplot figure of their ``size``."""
    part = subfigure_at(ax or _new_axes(*size(data), None))
    draw(data, part)
    return part.figure


# api: What the commands do, as functions: read a rig folder, fit it, load the result.


def read_rig(
    folder: str | Path,
    registry: Registry | None = None,
    friction: type[FrictionLaw] | None = None,
    contact: type[Force] | None = None,
) -> Rig:
    """Read and check a rig folder.

    Parameters
    ----------
    folder : holds ``rig.toml`` and the tables that it names; or the path of ``rig.toml``
    registry : the kinds of experiments that it may have, by default the built-in ones and those of installed packages
    friction, contact : classes of a friction law and of a contact; ``[prior]`` may then state their parameters

    Raises
    ------
    InputError
        At the first fault: file, line and column, the rule, the value found, the remedy.
    """
    if not isinstance(folder, str | Path):
        raise InputError("the rig must be a path (str or Path)", type(folder).__name__, "name a folder with a rig.toml")
    own = tuple(row for law in (friction, contact) if law is not None for row in law.parameters)
    return read.read_rig(folder, registry or default_registry(), own)


def _check_numbers(seed: int, budget: int | None, ess: float) -> None:
    """Refuse numbers of a fit that are out of range."""
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError("seed must be a whole number, not negative", repr(seed), "give 0 or more")
    if budget is not None and (not isinstance(budget, int | np.integer) or budget < 1):
        raise InputError(
            "budget must be a positive whole number", str(budget), "give 1 or more steps, or None: the point fit alone"
        )
    if not 0 < ess < float("inf"):
        raise InputError("ess must be positive and finite", str(ess), f"give {DEFAULT_ESS:.0f}, the default")


def fit(
    rig: Rig | str | Path,
    seed: int = 0,
    experiments: Choice = "all",
    budget: int | None = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: OnProgress | bool | None = None,
    registry: Registry | None = None,
    friction: type[FrictionLaw] | None = None,
    ess: float = DEFAULT_ESS,
    preliminary: Callable[[Fit], None] | None = None,
    contact: type[Force] | None = None,
    profile: Sequence[str] = (),
) -> Fit:
    """Fit a rig: point estimate, posterior, checks. The command ``fit-params`` chooses every one of the parameters.

    Parameters
    ----------
    rig : from ``read_rig``, or what ``read_rig`` reads
    seed : the same seed gives the same numbers
    experiments : "bench", "runs" or "all"
    budget : emcee steps of an ensemble after burn-in; None for the point fit alone
    store : file for a copy of the chains every few seconds; a later call goes on from the draws in it
    progress : called with (draws done, draws until the next check, the stage); True or False: shown or not, by default
        on a terminal and in a notebook
    registry : the kinds that read ``rig``, by default the built-in ones and those of installed packages
    friction, contact : class of a friction law in place of eq. (1), and of a force in place of the support spring; their
        parameters are fitted instead of mu and v_s, or of k2
    ess : sampling stops at this bulk and tail effective sample size of every parameter
    preliminary : called before the sampling with the point fit: a result without intervals, panels, notes and records
    profile : names of parameters whose profile likelihoods are computed: ``result.table("parameters.profile")``

    Raises
    ------
    InputError
        If ``rig`` cannot be read or holds nothing to fit, ``experiments`` is another word, ``seed``, ``budget`` or
        ``ess`` is out of range, ``friction`` or ``contact`` cannot be fitted, or a parameter to ``profile`` is not sampled.
    """
    prepare_xla()
    rig = rig if isinstance(rig, Rig) else read_rig(rig, registry, friction, contact)
    _check_numbers(seed, budget, ess)
    kinds, seeds = registry or default_registry(), stage_seeds(seed)
    made_from = provenance(rig, seed, experiments, friction_of(rig, friction, contact).source)
    stages = fit_stages(budget is not None)
    with Progress(progress, stages=stages) if isinstance(progress, bool | None) else nullcontext(progress) as show:
        show(0, 1, "readings")
        readings = check_readings(rig, experiments, kinds)
        made, second = second_models(make_experiments(rig, experiments, kinds, friction, contact), readings)
        target = LogPosterior(rig, made)
        check_profiled(target, profile)
        show(0, 1, "point fit")
        point = fit_points(target, kinds, seeds.starts, sampled=budget is not None)
        before = (*readings, *second)
        if preliminary is not None and budget is not None:
            preliminary(make_result(unfinished(point, before), kinds, seeds.report, made_from, Fit, panels=False))
        sampled = sample_posterior(point, seeds.walkers, budget, store, show, ess)
        show(0, 1, "report")
        checked = check_fit(sampled, before)
        return make_result(checked, kinds, seeds.report, made_from, Fit, profiled=profile)


def load(directory: str | Path, registry: Registry | None = None) -> Fit:
    """The result that ``fit-params`` or ``Fit.write`` wrote into ``directory``, equal to the one that ``fit`` returned.

    Parameters
    ----------
    registry : the kinds of the fit, by default the built-in ones and those of installed packages

    Raises
    ------
    InputError
        If ``directory`` holds no result, or one that another version wrote.
    """
    return Fit(**load_fields(Path(directory), registry or default_registry()))
