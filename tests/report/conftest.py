"""A plausible result, made of random numbers: the report has to render it, not to believe it."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from capsule_id.experiments.kind import default_registry
from capsule_id.inference.result import PointFit, Pointwise, Posterior, Provenance, Result
from capsule_id.report.figures.style import own_style
from capsule_id.report.html import Picture, pictures
from capsule_id.report.write import result_files
from capsule_id.rig.model import Quantity, Rig
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable

PHYSICAL = {
    # name: (unit, meaning, value, sd, paper)
    "m1": ("kg", "mass of the rod", 0.11, 2e-4, np.nan),
    "m2": ("kg", "mass of the capsule", 0.53, 5e-4, np.nan),
    "k1": ("N/m", "stiffness between rod and capsule", 1421.3, 3.1, 1386.0),
    "c": ("N s/m", "viscous damping between rod and capsule", 3.89, 0.021, 3.52),
    "mu": ("1", "static friction coefficient, eq. (1)", 0.66, 0.0061, 0.662),
    "v_s": ("m/s", "Stribeck velocity, eq. (1)", 0.302, 0.034, 0.465),
    "K": ("N/A", "force per motor current", 2.003, 0.0147, 2.011),
    "k2[soft]": ("N/m", "stiffness of the support spring", 2420.0, 1.9, 2421.2),
    "k2[medium]": ("N/m", "stiffness of the support spring", 18960.0, 14.0, 18950.0),
    "k2[stiff]": ("N/m", "stiffness of the support spring", 56410.0, 46.0, 56430.0),
}
NUISANCES = {
    "tilt_sd": ("rad", "scatter of the tilt angle", 0.0088, 0.003, np.nan),
    "push_scatter": ("1", "relative scatter of mu from push to push", 0.017, 0.006, np.nan),
    "noise_sd[free_vibration_1]": ("m", "noise of a record", 2.02e-5, 4.6e-7, np.nan),
    "noise_sd[free_vibration_2]": ("m", "noise of a record", 2.97e-5, 6.6e-7, np.nan),
    "noise_sd[free_vibration_3]": ("m", "noise of a record", 1.01e-5, 2.3e-7, np.nan),
    "scatter[motor_current]": ("N", "scatter about a calibration line", 0.035, 0.011, np.nan),
    "scatter[support_spring_soft]": ("N", "scatter about a calibration line", 0.005, 0.0013, np.nan),
    "scatter[support_spring_medium]": ("N", "scatter about a calibration line", 0.038, 0.0093, np.nan),
    "scatter[support_spring_stiff]": ("N", "scatter about a calibration line", 0.113, 0.029, np.nan),
}
#: Columns of a parameter without model error.
NOT_WIDENED = dict.fromkeys(("widening", "sd_unwidened", "lower_unwidened", "upper_unwidened"), np.nan)
SAMPLED = {**PHYSICAL, **NUISANCES}


def _frame(rows: dict[str, tuple[str, str, float, float, float]], rng: np.random.Generator) -> pd.DataFrame:
    table = {}
    for name, (unit, meaning, value, sd, paper) in rows.items():
        mean = value + 0.1 * sd * rng.normal()
        table[name] = {
            "unit": unit, "meaning": meaning, "value": mean, "quote": "sd", "basis": "sample", "trust": "trusted",
            "paper": paper, "map": value, "standard_error": 0.97 * sd, "mean": mean,
            "sd": sd, "median": mean, "lower": mean - 1.96 * sd, "upper": mean + 1.96 * sd,
            "ess": 4100.0 + 100 * rng.normal(), "ess_bulk": 4050.0, "ess_tail": 4010.0, "rhat": 1.002, **NOT_WIDENED,
            "informed": name not in ("m1", "m2"), "not_in_sd": "" if name in ("m1", "m2") else "gain",
            "largest_error": "9.3 %: gain of speed" if name == "v_s" else "",
        }  # fmt: skip
    frame = pd.DataFrame.from_dict(table, orient="index")
    frame.index.name = "name"
    return frame


def _friction(rng: np.random.Generator) -> Comparison:
    v = np.linspace(0.0, 1.1, 120)
    ours = 0.33 * (1 + np.exp(-v / 0.302))
    paper = 0.33 * (1 + np.exp(-v / 0.465))
    speeds = np.array([0.15, 0.3, 0.5, 0.75, 1.0])
    return Comparison(
        "friction", "friction", "Friction coefficient against velocity", "velocity, m/s", "friction coefficient",
        points=(
            Points("static tests (tilt)", np.zeros(4), 0.66 + 0.01 * rng.normal(size=4), role="static"),
            Points("pushes, read as mu at v", speeds, np.interp(speeds, v, paper), np.full(5, 0.01), role="dynamic"),
        ),
        curves=(
            Curve("paper's fit of eq. (1)", v, paper, role="paper"),
            Curve("this fit", v, ours, ours - 0.01 - 0.01 * v, ours + 0.01 + 0.01 * v, role="ours"),
        ),
        predictive_p=0.41,
    )  # fmt: skip


def _line(kind: str, label: str, slope: float, rng: np.random.Generator) -> Comparison:
    current = kind == "motor_current"
    n, top = (8, 2.0) if current else (11, 1.0)
    x = np.linspace(0.1 if current else 0.0, top, n)
    noise = 0.002 * slope * top * rng.normal(size=n)
    flagged = np.zeros(n, dtype=bool)
    flagged[4] = label == "support_spring_stiff"
    return Comparison(
        kind, label, "Current against force" if current else f"Support spring {label.removeprefix('support_spring_')}",
        "motor current, A" if current else "deflection, mm", "force, N",
        points=(Points("measured", x, slope * x + noise, flagged=flagged),),
        curves=(Curve("this fit", x, slope * x, 0.998 * slope * x, 1.002 * slope * x),),
        residuals=noise / np.std(noise), predictive_p=0.62,
    )  # fmt: skip


def _decay(number: int, rng: np.random.Generator, n: int = 1000) -> Comparison:
    t = np.arange(n) / 2000.0
    clean = (1.0 + number) * np.exp(-17.7 * t) * np.cos(112.2 * t)
    residuals = rng.normal(size=n)
    lags = np.arange(1, 61)
    white = residuals - residuals.mean()
    autocorrelation = np.array([np.dot(white[:-lag], white[lag:]) for lag in lags]) / np.dot(white, white)
    return Comparison(
        "free_vibration", f"free_vibration_{number}", f"Free vibration free_vibration_{number}", "time, s",
        "relative displacement, mm",
        points=(Points("measured", t, clean + 0.01 * (1 + number) * residuals),),
        curves=(Curve("this fit", t, clean, clean - 0.02, clean + 0.02),),
        residuals=residuals, autocorrelation=autocorrelation,
        predictive_p=0.55,
    )  # fmt: skip


def _point_fit(rng: np.random.Generator) -> PointFit:
    names = tuple(SAMPLED)
    d = len(names)
    sd = np.array([row[3] / row[2] for row in SAMPLED.values()])
    u = np.log([row[2] for row in SAMPLED.values()])
    starts = u + rng.normal(size=(6, d))
    return PointFit(
        names, u, {n: r[2] for n, r in SAMPLED.items()}, np.diag(sd**2), {n: 0.97 * r[3] for n, r in SAMPLED.items()},
        starts, u + 1e-4 * sd * rng.normal(size=(6, d)), 1234.5 - 1e-7 * rng.random(6), *np.zeros((2, 6), dtype=bool),
    )  # fmt: skip


def _posterior(rng: np.random.Generator, ensembles: int, draws: int, walkers: int) -> Posterior:
    names = tuple(SAMPLED)
    centre = np.array([row[2] for row in SAMPLED.values()])
    sd = np.array([row[3] for row in SAMPLED.values()])
    mixing = np.eye(len(names)) + 0.4 * np.eye(len(names), k=1)
    z = rng.normal(size=(ensembles, draws, walkers, len(names))) @ mixing
    d = len(names)
    return Posterior(
        names, centre + sd * z, 1234.5 - 0.5 * (z**2).sum(-1), np.full((ensembles, walkers), 0.28),
        np.full(d, 3.0), np.full(d, 1.002), *np.full((3, d), 4100.0), 4000.0, True, {"DE + snooker": 61.0, "stretch": 142.0},
        steps=10000, thin=20,
    )  # fmt: skip


def _pointwise(rng: np.random.Generator, comparisons: tuple[Comparison, ...]) -> Pointwise:
    chains, draws = np.arange(0, 8, 2), np.arange(0, 20, 4)
    sizes = {item.label: item.points[0].y.size for item in comparisons}
    density, replicates = (
        {label: rng.normal(size=(*grid, n)) for label, n in sizes.items()} for grid in ((4, 5), (2, 3))
    )
    return Pointwise(density, {label: np.arange(n) for label, n in sizes.items()}, replicates, chains, draws, 2)


#: What a check of an outlier has found, and the same of coloured residuals.
OUTLIER = {
    "file": "stiff.csv", "lines": [5], "score": 4.1, "p": 1e-4, "most": 3,
    "estimates": [("k2[stiff]", "N/m", 56410.0, 56350.0)],
}  # fmt: skip
COLOURED = {
    "record": "free_vibration_2",
    "Q": 250.0,
    "lags": 20,
    "p": 1e-30,
    "model": "decay",
    "present": (),
    "second": False,
}
CHAINS = {
    "draws": 1000, "length": 12.0, "slowest": "v_s", "rhat": 1.2, "worst": "mu", "length_wanted": 20.0,
    "rhat_wanted": 1.01, "size": 900.0, "smallest": "v_s", "size_wanted": 4000.0,
}  # fmt: skip


def _findings() -> tuple[Finding, ...]:
    return (
        Finding("starts.agree", "ok", {"starts": 6}),
        Finding("chains.converged", "ok", {**CHAINS, "length": 61.0, "rhat": 1.002}),
        Finding("residuals.white", "ok", {"records": 3, "lags": 20}),
        Finding("outliers", "warn", OUTLIER, "support_spring_stiff"),
        Finding("lines.straight", "ok", {"number": 4}, "motor_current"),
        Finding("parameters.informed", "warn", {"names": "v_s"}),
    )


def _notes() -> tuple[ResultTable, ...]:
    rows = {"k2 [N/m]": [56410.123, 56350.2], "sd [N/m]": [46.0, 31.0]}
    priors = {
        "parameter": ["k1", "mu"],
        "prior": ["log-normal"] * 2,
        "median": [1000.0, 0.4],
        "factor": [100.0, np.nan],
    }
    return (
        ResultTable("lines.slopes", pd.DataFrame(rows, index=["all rows", "without row 5"])),
        ResultTable("parameters.priors", pd.DataFrame(priors)),
    )


def make_result(seed: int = 0, ensembles: int = 4, draws: int = 60, walkers: int = 8) -> Result:
    """The whole fake; the same seed gives the same result."""
    rng = np.random.default_rng(seed)
    files = {f"free_vibration_{i}.csv": f"{i:x}" * 64 for i in (1, 2, 3)}
    rig = Rig("twin", True, Quantity(0.11, 2e-4), Quantity(0.53, 5e-4), Quantity(9.81), {}, (), files, Path("data"))
    springs = (("soft", 2.42), ("medium", 18.96), ("stiff", 56.41))
    comparisons = (
        _friction(rng),
        _line("motor_current", "motor_current", 2.0, rng),
        *(_line("support_spring", f"support_spring_{name}", slope, rng) for name, slope in springs),
        *(_decay(i, rng) for i in (1, 2, 3)),
    )
    versions = {"capsule_id": "0.1.0", "jax": "0.10.2", "emcee": "3.1.6"}
    return Result(
        rig=rig,
        registry=default_registry(),
        summary=_frame(PHYSICAL, rng),
        nuisances=_frame(NUISANCES, rng),
        point_fit=_point_fit(rng),
        posterior=_posterior(rng, ensembles, draws, walkers),
        findings=_findings(),
        comparisons=comparisons,
        notes=_notes(),
        records=(),
        fixed={"g": 9.81},
        observed={item.label: item.points[0].y for item in comparisons},
        prior={name: np.exp(rng.normal(size=500)) for name in SAMPLED},
        pointwise=_pointwise(rng, comparisons),
        provenance=Provenance(seed, "bench", "eq. (1)", versions, files),
    )


@pytest.fixture(scope="session")
def result() -> Result:
    """Synthetic rig, sampled, clean with two warnings."""
    return make_result()


@pytest.fixture(scope="session")
def drawn(result: Result) -> tuple[Picture, ...]:
    """Its pictures."""
    with own_style():
        return pictures(result)


@pytest.fixture(scope="session")
def files(result: Result, drawn: tuple[Picture, ...]) -> dict[str, bytes]:
    """Its files, without drawing the pictures once more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("capsule_id.report.write.pictures", lambda _: drawn)
        return result_files(result)


@pytest.fixture(scope="session")
def unclean(result: Result) -> Result:
    """The same from a real rig, with two failures."""
    bad = (
        Finding("errors.stated", "fail", {"freedom": 3, "chi_square": 40.0, "p": 1e-8}),
        Finding("residuals.white", "fail", COLOURED, "free_vibration_2"),
    )
    return dataclasses.replace(
        result, findings=result.findings + bad, rig=dataclasses.replace(result.rig, synthetic=False)
    )


@pytest.fixture(scope="session")
def unsampled(result: Result) -> Result:
    """What ``--no-sample`` gives: sampled columns are NaN."""
    columns = ["mean", "median", "lower", "upper", "ess", "rhat", "informed"]
    summary, nuisances = result.summary.copy(), result.nuisances.copy()
    for frame in (summary, nuisances):
        frame["informed"] = frame["informed"].astype(object)
        frame[columns] = np.nan
        frame["value"], frame["sd"], frame["basis"] = frame["map"], frame["standard_error"], "point"
        frame["trust"] = "not judged"
    return dataclasses.replace(result, summary=summary, nuisances=nuisances, posterior=None, pointwise=None)


@pytest.fixture
def maker() -> Callable[..., Result]:
    """``make_result`` for the tests that need a size or a seed of their own."""
    return make_result
