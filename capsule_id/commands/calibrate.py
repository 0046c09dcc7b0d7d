"""``capsule-id calibrate DIR``: simulation-based calibration of the fit, on synthetic rigs with known truth.

The truth of each rig is a draw from the priors that its rig.toml states. Then the rank of the truth among independent
draws of the posterior is uniform for every parameter, if likelihood, priors and sampler are correct (S. Talts et al.,
*Validating Bayesian inference algorithms with simulation-based calibration*, arXiv:1804.06788). The log-density of the
priors is ranked too: a fit that forgets a prior may leave the ranks of the parameter itself uniform.
"""

import json
import shutil
import time
from argparse import Namespace
from typing import Any

import numpy as np

from capsule_id.commands import NO_CACHE, PATH, QUIET
from capsule_id.commands.bifurcate import client_of
from capsule_id.commands.fit import CLEAN, DEFAULT_ESS, DEFAULT_MAX_STEPS, FAILED, NOT_CLEAN, each_result, fit_by_worker
from capsule_id.commands.synthesize import assignment
from capsule_id.console import Progress, complain, one_line, refusing_damage, say, stop_if_interrupted
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.output import replace_file, replace_files
from capsule_id.parameters import QUANTILE_975, Prior
from capsule_id.views import counted

#: Factor of the log-normal priors about the paper's values, that of some parameters, and that of rigs with forced runs; scales
#: of the half-normal priors of the noise levels that few readings determine, SI. The prior of v_s is narrower than its
#: readings are, so that a forgotten prior shows. With runs no settled motion must change.
FACTOR, FACTORS, FACTOR_WITH_RUNS, SCALES = 1.3, {"v_s": 1.1}, 1.03, {"tilt_sd": np.pi / 360.0, "push_scatter": 0.02}
#: Largest number of draws that the truth is ranked among; smallest p x number of parameters of uniform ranks; name of the
#: log-density of the priors; the file of DIR with the options in its first line, then a line per rig.
DRAWS, LEAST_P, LOG_PRIOR, RIGS = 255, 0.01, "log prior", "rigs.jsonl"

OPTIONS = {
    "": (
        ("directory", "DIR", "new folder, or one that this command began: finished rigs are not fitted again", PATH),
        ("--rigs", "N", "number of rigs (default 60); a larger one continues a study", {"type": int, "default": 60}),
        ("--seed", "N", "random seed of truths, readings and fits (default 0)", {"type": int, "default": 0}),
        ("--runs", "", "add forced runs to the bench tests"),
        ("--set", "NAME=VALUE", "medians of the priors, SI: k1=1500 'k2[soft]=2500'", {"nargs": "+", "default": []}),
        ("--scheduler", "S", "Dask: threads, processes or an address tcp://... (default: one rig after the other)"),
        QUIET,
        NO_CACHE,
    )
}


def run(args: Namespace) -> int:
    """Fit the rigs that are missing, print and write the tables; see ``report``.

    Raises
    ------
    InputError
        If an option is wrong, or DIR holds something else or was begun with other options; then nothing is written.
    """
    if args.rigs < 1:
        raise InputError("--rigs must be positive", str(args.rigs), "give 1 or more")
    from capsule_id.inference.pipeline import PACKAGES, package_versions

    args.priors, file, other = priors_of(args), args.directory / RIGS, "choose another name"
    study = {
        "seed": args.seed,
        "runs": args.runs,
        "priors": {name: prior.describe() for name, prior in args.priors.items()},
        "versions": {**package_versions(PACKAGES), **default_registry().packages},
    }
    with client_of(args.scheduler) as client, Progress(not args.quiet, "rig") as progress:
        with refusing_damage("DIR must be a new folder, or one that calibrate began", other, args.directory):
            args.directory.mkdir(parents=True, exist_ok=True)
            if not any(args.directory.iterdir()):
                replace_file(file, f"{json.dumps(study)}\n")
            before, *lines = map(json.loads, file.read_text(encoding="utf-8").splitlines())
            before, outcomes = dict(before), {line["rig"]: line for line in lines if "ranks" in line}
        if changed := [f"{name} was {before.get(name)}" for name in study if before.get(name) != study[name]]:
            raise InputError(
                "a begun study continues with the same options and versions",
                changed[0],
                f"repeat the first command, or {other}",
                args.directory,
            )
        for (number, _), outcome in each_result(
            client, outcome_of, ((number, args) for number in range(args.rigs) if number not in outcomes)
        ):
            try:
                outcomes[number] = outcome()
            except Exception as error:  # the other rigs are fitted all the same
                outcomes[number] = {"rig": number, "error": one_line(error)}
            stop_if_interrupted()
            replace_file(file, "".join(f"{json.dumps(line)}\n" for line in (study, *outcomes.values())))
            progress(len(outcomes), args.rigs, "rigs")
    return report([outcomes[number] for number in range(args.rigs)], args)


def priors_of(args: Namespace) -> dict[str, Prior]:
    """The priors of a study by parameter name, SI, about the paper's values and those of ``--set``."""
    from capsule_id.synthetic import MASS_SD, PAPER, Truth

    median = (
        Truth({name: value for name, value in PAPER.items() if name != "g"})
        .with_kinds(kind for kind in default_registry().values() if kind.bench or args.runs)
        .with_values(dict(assignment(text) for text in args.set))
    )
    return {
        **{
            name: Prior("lognormal", value, FACTOR_WITH_RUNS if args.runs else FACTORS.get(name, FACTOR))
            for name, value in median.items()
        },
        **{name: Prior("positive_normal", median[name], sd) for name, sd in MASS_SD.items()},
        **{name: Prior("halfnormal", 0.0, scale) for name, scale in SCALES.items()},
    }


def outcome_of(item: tuple[int, Namespace]) -> dict[str, Any]:
    """What comes out of one rig, by its number and the options: seed, truth, ranks, 95 % intervals, trust, seconds.

    The truth is drawn from the priors, and the readings of the rig are written into a new folder in DIR.
    """
    from capsule_id.synthetic import Truth, synthesize

    (number, args), begin = item, time.perf_counter()
    random, folder = np.random.default_rng([args.seed, number]), args.directory / "rigs" / f"rig_{number}"
    truth = {name: float(prior.sample(random, 1)[0]) for name, prior in args.priors.items()}
    options = Namespace(
        seed=int(random.integers(2**31)),
        experiments="all" if args.runs else "bench",
        budget=DEFAULT_MAX_STEPS,
        ess=DEFAULT_ESS,
        profile=None,
        no_cache=args.no_cache,
        command=args.program,
    )
    shutil.rmtree(folder, ignore_errors=True)  # of an interrupted study
    synthesize(folder, options.seed, Truth({**Truth(), **truth}), runs=args.runs, priors=args.priors)
    result: Any = fit_by_worker(folder, options)
    columns = [result.posterior.names.index(name) for name in truth]
    sample = np.moveaxis(result.posterior.draws[..., columns], 1, 0).reshape(-1, len(columns))
    # So few draws are nearly independent.
    draws = sample[
        np.linspace(0, len(sample) - 1, min(DRAWS, int(np.min(result.posterior.ess_bulk[columns])))).astype(int)
    ]
    values = dict(zip(truth, np.vstack([[*truth.values()], draws]).T, strict=True))  # the truth comes first
    values[LOG_PRIOR] = -0.5 * sum(
        (QUANTILE_975 * np.log(values[name] / prior.location) / np.log(prior.spread)) ** 2
        if prior.kind == "lognormal"
        else ((values[name] - prior.location) / prior.spread) ** 2
        for name, prior in args.priors.items()
    )
    return {
        "rig": number,
        "seed": options.seed,
        "truth": truth,
        "draws": len(draws),
        "ranks": {name: int(np.sum(own[1:] < own[0])) for name, own in values.items()},
        "inside": {
            name: bool(lower <= truth[name] <= upper)
            for name, lower, upper in result.to_dataframe().loc[[*truth], ["lower", "upper"]].itertuples()
        },
        "trust": result.trust,
        "failed": [finding.code for finding in result.findings if finding.level == "fail"],
        "seconds": round(time.perf_counter() - begin, 1),
    }


def report(outcomes: list[dict[str, Any]], args: Namespace) -> int:
    """Print and write the tables; return 0, 3 where ranks are not uniform, or 1 without a fitted rig.

    z is the normal quantile of a rank, standard normal where the ranks are uniform. p is three times the smallest p-value of
    its mean, of its spread and of the test of Kolmogorov and Smirnov.
    """
    import pandas as pd
    from scipy import stats

    table, fitted = dict[str, dict[str, Any]](), [one for one in outcomes if "ranks" in one]
    for name in fitted[0]["ranks"] if fitted else ():
        z = stats.norm.ppf([(one["ranks"][name] + 0.5) / (one["draws"] + 1.0) for one in fitted])
        tests = (
            2.0 * stats.norm.sf(abs(np.sum(z)) / np.sqrt(len(z))),
            2.0 * stats.chi2.sf(np.sum(z**2), len(z)),
            2.0 * stats.chi2.cdf(np.sum(z**2), len(z)),
            stats.kstest(z, "norm").pvalue,
        )
        table[name] = {
            "rigs": len(fitted),
            "inside 95 %": np.mean([one["inside"].get(name, np.nan) for one in fitted]),
            "mean z": np.mean(z),
            "sd z": np.std(z),
            "p": min(1.0, 3.0 * min(tests)),
            "p x parameters": min(1.0, 3.0 * min(tests)) * len(fitted[0]["ranks"]),
        }
    shown = pd.DataFrame.from_dict(table, orient="index")
    ranks = pd.DataFrame(
        [
            (one["rig"], name, rank, one["draws"], one["inside"].get(name))
            for one in fitted
            for name, rank in one["ranks"].items()
        ],
        columns=["rig", "parameter", "rank", "draws", "inside 95 %"],
    )
    replace_files(
        {
            args.directory / "calibration.csv": shown.to_csv(index_label="parameter", lineterminator="\n"),
            args.directory / "ranks.csv": ranks.to_csv(index=False, lineterminator="\n"),
        }
    )
    say(
        "\n".join(
            [
                shown.to_string(float_format="%.3g", na_rep=""),
                *(f"rig {one['rig']} not fitted: {one['error']}" for one in outcomes if "error" in one),
                f"fitted {len(fitted)} of {counted(len(outcomes), 'rig')}, "
                f"{sum(one['trust'] == 'trusted' for one in fitted)} trusted; "
                f"median {np.median([one['seconds'] for one in fitted] or np.nan):.1f} s a rig",
                *(f"smallest p x number of parameters: {shown['p x parameters'].min():.2g}" for _ in fitted[:1]),
            ]
        )
    )
    uneven = ", ".join(name for name, row in table.items() if row["p x parameters"] < LEAST_P)
    if uneven or not fitted:
        complain(
            f"{args.program}: {'ranks not uniform: ' if fitted else 'no rig fitted'}{uneven}; see {args.directory}"
        )
    return NOT_CLEAN if uneven else CLEAN if fitted else FAILED
