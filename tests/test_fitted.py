"""The object that ``fit`` and ``load`` return: words, tables, plots, draws, files."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import arviz
import h5py
import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

import capsule_id as cid
from capsule_id.api import Fit, compare
from capsule_id.cli import capsule_id
from capsule_id.errors import InputError
from capsule_id.experiments.base import BLOCKS
from capsule_id.inference.result import Pointwise, Posterior
from capsule_id.report.write import _digest, data_tree, netcdf_bytes, parameters_json
from capsule_id.rig.model import ModelChoices, Quantity
from capsule_id.synthetic import truth_beside
from capsule_id.views import Finding, Level
from tests.cli_tools import DATA, ROOT, listing, small_rig

TABLES = ("free_vibration_1", "static_friction", "dynamic_friction", "support_spring_soft")
STATED = ['damping = "viscous"', 'stiffness = "linear"', 'noise = "white"', 'drift = "none"']
TIMES = np.linspace(0.0, 0.3, 40)
DRIVE = cid.Excitation(P_d=4.0, Omega=34.56)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    folder = small_rig(tmp_path_factory.mktemp("rig") / "rig", "lab", ("motor_current", "support_spring_soft"))
    return cid.fit(cid.read_rig(folder), budget=60)


@pytest.fixture(scope="module")
def capsule(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    """A fit of every leaf that a simulation needs; few steps, so it is not converged."""
    folder = tmp_path_factory.mktemp("rig") / "rig"
    folder.mkdir()
    lines = (DATA / "rig.toml").read_text(encoding="utf-8").partition("[[experiment]]")[0].splitlines()
    for table in TABLES:
        kind = re.sub(r"_(1|soft)$", "", table)
        lines += ["[[experiment]]", f'kind = "{kind}"', f'file = "{table}.csv"']
        lines += ['spring = "soft"'] if kind == "support_spring" else []
        # No other model of the decay is fitted.
        lines += STATED if kind == "free_vibration" else []
        shutil.copy(DATA / f"{table}.csv", folder)
    (folder / "rig.toml").write_text("\n".join(lines).replace('"k2[hard]"', '"k2[soft]"'), encoding="utf-8")
    return cid.fit(cid.read_rig(folder), budget=20)


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without pictures, for tests of their numbers and words."""
    monkeypatch.setattr("capsule_id.report.write.pictures", lambda _: ())


@pytest.fixture(autouse=True)
def no_figure_stays_open() -> Iterator[None]:
    yield
    plt.close("all")


def test_a_written_result_is_loaded_to_the_last_bit(capsule: Fit, tmp_path: Path) -> None:
    """Equal objects, and whatever is written from the loaded one has the same bytes."""
    fit = capsule
    fit.write(tmp_path / "one")
    again = cid.load(tmp_path / "one")
    again.write(tmp_path / "two")
    assert listing(tmp_path / "one") == listing(tmp_path / "two")
    assert type(again) is Fit
    pd.testing.assert_frame_equal(again.summary, fit.summary, check_exact=True)
    pd.testing.assert_frame_equal(again.nuisances, fit.nuisances, check_exact=True)
    np.testing.assert_array_equal(cast(Posterior, again.posterior).draws, cast(Posterior, fit.posterior).draws)
    assert [again.text(item) for item in again.findings] == [fit.text(item) for item in fit.findings]
    assert (again.trust, again.provenance, repr(again)) == (fit.trust, fit.provenance, repr(fit))
    assert again.rig.tables[0].settings == fit.rig.tables[0].settings
    assert type(again.rig.tables[0].settings) is type(fit.rig.tables[0].settings)


@pytest.mark.usefixtures("without_pictures")
def test_a_result_without_sample_is_loaded_too(tmp_path: Path) -> None:
    fit = cid.fit(cid.read_rig(small_rig(tmp_path / "rig")), budget=None)
    fit.write(tmp_path / "one")
    cid.load(tmp_path / "one").write(tmp_path / "two")
    assert listing(tmp_path / "one") == listing(tmp_path / "two")
    with pytest.raises(InputError, match="draws need a sample"):
        fit.simulate(DRIVE, TIMES)


@pytest.mark.full
def test_another_seed_is_another_result(fitted: Fit, tmp_path: Path) -> None:
    """Negative control of the round trip: the bytes depend on the result."""
    fitted.write(tmp_path / "one")
    other = dataclasses.replace(fitted, summary=fitted.summary.assign(value=fitted.summary["value"] * (1 + 1e-15)))
    other.write(tmp_path / "two")
    one, two = listing(tmp_path / "one"), listing(tmp_path / "two")
    assert {name for name in one if one[name] != two[name]} >= {"parameters.json", "figures/data.npz"}


@pytest.mark.usefixtures("without_pictures")
def test_what_is_no_result_is_refused(fitted: Fit, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"it has no data\.npz, run fit-params again"):
        cid.load(tmp_path)
    fitted.write(tmp_path / "one")
    saved = tmp_path / "one" / "figures" / "data.npz"
    with np.load(saved) as file:
        arrays = dict(file)
    digests = arrays.pop("digests")
    changed = arrays["tree"].tobytes().replace(b'"capsule_id.rig.model", "Rig"', b'"subprocess", "Popen"')
    arrays["tree"] = np.frombuffer(changed, np.uint8)
    # By someone who knows the format.
    np.savez_compressed(saved, **arrays, digests=np.array([_digest(arrays), digests[1]]))
    with pytest.raises(InputError, match=re.escape("subprocess.Popen belongs to no package of this result")):
        cid.load(tmp_path / "one")
    (tmp_path / "one" / "posterior.nc").write_bytes(b"damaged")
    with pytest.raises(InputError, match="run fit-params again"):
        cid.load(tmp_path / "one")


def test_it_shows_itself_in_short(fitted: Fit) -> None:
    assert len(repr(fitted)) < 250
    assert len(repr(fitted.posterior)) < 150
    assert repr(fitted.posterior).startswith("<Posterior: 4 ensembles of ")
    assert repr(fitted.rig) == "<Rig lab: 1 motor_current, 1 support_spring>"
    assert repr(fitted.rig.tables[0]).startswith("<motor_current motor_current: 8 rows of ")
    assert repr(fitted).startswith(f"<Fit of lab: {fitted.trust}; K = ")
    html = fitted._repr_html_()
    assert html.count("<tr>") == 1 + len(fitted.summary)
    assert f"verdict: {fitted.trust}" in html
    assert str(fitted).splitlines()[-1].startswith(f"verdict: {fitted.trust}")


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("level", ["ok", "warn", "fail"])
def test_console_report_and_notebook_have_one_verdict(
    fitted: Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str], level: Level
) -> None:
    """(Before: the console said "no check failed" where the report said "2 warnings below".)"""
    findings = tuple(Finding("linearity", "warn" if level != "ok" else "ok", {}, label) for label in ("a", "b"))
    one = dataclasses.replace(fitted, findings=(*findings, Finding("outliers", level, {})))
    warned = {"ok": 0, "warn": 3, "fail": 2}[level]
    said = str(one).splitlines()[-1]
    assert said.endswith(f"; {warned} warnings") == (warned > 0)
    assert ("warning" in said) == (warned > 0)
    one.write(tmp_path / "one")
    assert capsule_id(["report", str(tmp_path / "one")]) == (3 if level == "fail" else 0)
    assert capsys.readouterr().out.splitlines()[-1] == said
    assert f">V{said[1:]}." in (tmp_path / "one" / "report.html").read_text(encoding="utf-8")
    assert said in one._repr_html_()


@pytest.mark.usefixtures("without_pictures")
def test_the_table_is_parameters_csv(fitted: Fit, tmp_path: Path) -> None:
    fitted.write(tmp_path / "one")
    # As text: pandas 2 reads numbers with an error in the last digits.
    read = pd.read_csv(tmp_path / "one" / "parameters.csv", index_col="name", dtype={"value": str})
    table = fitted.to_dataframe()
    assert list(read.columns) == list(table.columns)
    np.testing.assert_array_equal(read["value"].to_numpy(float), table["value"].to_numpy(float))


@pytest.mark.full
@pytest.mark.parametrize(
    "name", ["plot_comparison", "plot_residuals", "plot_autocorrelation", "plot_corner", "plot_traces", "plot_starts"]
)
def test_every_plot_draws_into_given_axes_or_a_pyplot_figure(capsule: Fit, name: str, tmp_path: Path) -> None:
    plot = getattr(capsule, name)
    drawn = plot()
    assert plt.get_fignums() == [1]
    several = name in ("plot_corner", "plot_traces")
    assert drawn is plt.figure(1) if several else drawn in plt.figure(1).axes
    assert drawn.get_figure(root=True) is plt.figure(1)
    drawn.figure.savefig(tmp_path / "x.png")  # of traces, a part of a figure that cannot be saved
    if name == "plot_traces":
        shown = [row for row in capsule.summary.index if row in cast(Posterior, capsule.posterior).names]
        assert [bool(ax.get_ylabel()) for ax in drawn.axes] == [True] * len(shown)
    figure = Figure()
    given = figure.subplots(1, 2)[1]
    assert plot(ax=given).get_figure(root=True) is figure
    assert plt.get_fignums() == [1]
    figure.canvas.draw()  # pyright: ignore[reportAttributeAccessIssue]


def test_plots_of_absent_data_say_what_is_there(fitted: Fit) -> None:
    with pytest.raises(InputError, match="fit experiments that have it"):
        fitted.plot_record()
    with pytest.raises(InputError, match="choose from motor_current, support_spring_soft"):
        fitted.plot_comparison("pushes")


def test_the_calibrated_model_as_json(capsule: Fit, tmp_path: Path) -> None:
    """It keeps to its schema; values, covariance and draws are those of the result, widened sds too."""
    summary = capsule.summary.copy()
    summary.loc["k1", ["sd", "widening"]] = [2.0 * float(summary.at["k1", "sd"]), 2.0]
    wide = dataclasses.replace(capsule, summary=summary)
    wide.export(tmp_path / "model.json", draws=50, seed=3)
    saved = json.loads((tmp_path / "model.json").read_text(encoding="utf-8"))
    schema = json.loads((ROOT / "capsule_id/report/templates/model.schema.json").read_text(encoding="utf-8"))
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.validate(saved, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**saved, "parameters": [{**saved["parameters"][0], "sd": "3"}]}, schema)
    names, draws = [one["name"] for one in saved["parameters"]], np.array(saved["draws"])
    posterior = cast(Posterior, capsule.posterior)
    assert draws.shape == (50, len(names))
    flat = posterior.draws[..., [posterior.names.index(name) for name in names]].reshape(-1, len(names))
    assert {tuple(row) for row in draws} <= {tuple(row) for row in flat.tolist()}
    covariance = np.array(saved["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [wide[name].sd for name in names], rtol=1e-12)
    assert [one["value"] for one in saved["parameters"]] == [wide[name].value for name in names]
    factors = np.where(np.array(names) == "k1", 2.0, 1.0)
    np.testing.assert_allclose(covariance / np.outer(factors, factors), np.cov(flat.T), rtol=1e-9)
    assert saved["fixed"]["g"] == 9.81
    assert not saved["fixed"].keys() & set(names)
    written = cast(dict[str, dict[str, object]], parameters_json(wide))
    assert not written["fixed"].keys() & written["parameters"].keys()
    assert written["fixed"]["reaction"] == 0.0
    sloping = dataclasses.replace(wide, rig=dataclasses.replace(capsule.rig, slope=Quantity(0.05)))
    sloping.export(tmp_path / "slope.json", draws=5)
    # Before: level ground.
    assert json.loads((tmp_path / "slope.json").read_text(encoding="utf-8"))["fixed"]["slope"] == 0.05
    drawn, level = (data_tree(fit)["posterior"] for fit in (sloping, wide))
    assert np.all(drawn["slope"] == 0.05)
    assert "slope" not in level


def test_the_stored_sample_is_small(capsule: Fit, tmp_path: Path) -> None:
    """Densities and replicates are rounded to steps far below what they vary by; arrays are packed."""
    pointwise = cast(Pointwise, capsule.pointwise)
    for label, density in pointwise.log_likelihood.items():
        finite = density[np.isfinite(density)]
        np.testing.assert_array_equal(finite * 2.0**16, np.round(finite * 2.0**16))
        made = pointwise.replicates[label]
        sd = np.std(made, axis=(0, 1))
        made, sd = made[..., sd > 0.0], sd[sd > 0.0]
        step = np.exp2(np.floor(np.log2(sd)) - 5.0)  # rounding may have moved the sd over a power of two
        np.testing.assert_array_equal(made / step * 4.0, np.round(made / step * 4.0))
        assert not np.array_equal(made / step * 0.25, np.round(made / step * 0.25))
    (tmp_path / "x.nc").write_bytes(netcdf_bytes(data_tree(capsule)))
    with h5py.File(tmp_path / "x.nc") as file:
        for place in ("posterior/k1", "log_likelihood/readings", "posterior_predictive/y1_free_vibration_1"):
            assert cast(h5py.Dataset, file[place]).compression == "gzip", place


def test_a_parameter_by_its_name_has_the_numbers_of_the_files(capsule: Fit) -> None:
    saved: Any = parameters_json(capsule)["parameters"]
    assert list(capsule.parameters) == list(saved) == list(capsule)
    for name, stated in saved.items():
        own = capsule[name]
        assert (own.name, own.unit, own.value, own.sd) == (name, stated["unit"], stated["value"], stated["sd"])
        assert (own.trust, [own.lower, own.upper]) == (stated["trust"], stated["ci95"])
    k1 = capsule["k1"]
    assert re.fullmatch(r"k1 = \d+(\.\d+)? ± \d+(\.\d+)? N/m, (not )?(trusted|judged)", str(k1))
    assert str(k1).split(" ± ")[0].removeprefix("k1 = ") in capsule.parameter_table
    assert ("k1" in capsule, "k9" in capsule, 0 in capsule) == (True, False, False)


@pytest.mark.parametrize(
    ("word", "near"),
    [
        ("k2", "choose from k2[soft]"),
        ("K1", "choose from "),
        ("v", "choose from "),
        ("vs", "v_s"),
        ("zzz", "m1, m2, k1"),
    ],
)
def test_an_unknown_name_lists_those_near_it(capsule: Fit, word: str, near: str) -> None:
    with pytest.raises(InputError, match="the result must have this parameter") as error:
        capsule[word]
    assert near in str(error.value)


def test_a_table_by_its_code(capsule: Fit) -> None:
    (note,) = (note for note in capsule.notes if note.code == "parameters.priors")
    pd.testing.assert_frame_equal(capsule.table("parameters.priors"), note.frame)
    twice = dataclasses.replace(capsule, notes=(note, *capsule.notes))
    assert len(twice.table("parameters.priors")) == 2 * len(note.frame)
    with pytest.raises(InputError, match=r"this table, 'parameter\.prior', choose from parameters\.priors"):
        capsule.table("parameter.prior")


def test_simulate_runs_the_capsule_for_draws(capsule: Fit) -> None:
    motion = capsule.simulate(DRIVE, TIMES, draws=5, spring="soft", gap=1e-3, seed=3)
    assert motion.X1.shape == (5, len(TIMES))
    posterior = cast(Posterior, capsule.posterior)
    flat = posterior.draws.reshape(-1, len(posterior.names))
    chosen = flat[np.random.default_rng(3).choice(len(flat), 5, replace=False)]
    one = dict(zip(posterior.names, chosen.T, strict=True))
    leaves = {name: one[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s")}
    p = cid.CapsuleParameters(**leaves, k2=one["k2[soft]"], G=1e-3)
    np.testing.assert_allclose(motion.X1, cid.simulate(p, DRIVE, TIMES).X1, rtol=1e-9, atol=1e-15)
    assert np.all(np.std(motion.X1[:, -1]) > 0.0)


def test_simulate_takes_the_law_of_the_fit_and_says_what_it_leaves_out(capsule: Fit) -> None:
    """Before: eq. (1) after a fit of constant friction, and any drive, any damping without a word."""
    flat = dataclasses.replace(capsule, rig=dataclasses.replace(capsule.rig, model=ModelChoices(friction="constant")))
    one, other = flat.simulate(DRIVE, TIMES, draws=5), capsule.simulate(DRIVE, TIMES, draws=5, given={"ratio": 1.0})
    np.testing.assert_allclose(one.X2, other.X2, rtol=1e-9, atol=1e-15)
    assert not np.allclose(one.X2, capsule.simulate(DRIVE, TIMES, draws=5).X2)
    reacting = dataclasses.replace(capsule.rig, model=ModelChoices(reaction="capsule"))
    with pytest.warns(UserWarning, match=r"the drive has reaction = 0.*; that of the fit is 1"):
        dataclasses.replace(capsule, rig=reacting).simulate(DRIVE, TIMES, draws=5)
    law = dataclasses.replace(capsule, provenance=dataclasses.replace(capsule.provenance, friction="mine.Law"))
    with pytest.raises(InputError, match=r"computes with eq. \(1\)"):
        law.simulate(DRIVE, TIMES, draws=5)
    posterior = cast(Posterior, capsule.posterior)
    renamed = dataclasses.replace(posterior, names=tuple("F_dry" if n == "k2[soft]" else n for n in posterior.names))
    with pytest.warns(UserWarning, match="the capsule has no F_dry: its rod is damped by c alone"):
        dataclasses.replace(capsule, posterior=renamed).simulate(DRIVE, TIMES, draws=5)


def test_simulate_names_what_it_lacks(fitted: Fit, capsule: Fit) -> None:
    with pytest.raises(InputError, match="the fit has no m1, m2, k1, c, mu, v_s") as error:
        fitted.simulate(DRIVE, TIMES, draws=5)
    given: dict[str, float] = {}
    while "the fit has no" in str(error.value):  # the remedy, until nothing is missing
        (name,) = re.findall(r"given=\{'(\w+)'", str(error.value))
        given[name] = {"m1": 0.11, "m2": 0.53, "k1": 1420.0}.get(name, 0.5)
        try:
            fitted.simulate(DRIVE, TIMES, draws=5, given=given)
            break
        except InputError as again:
            error.value.args = (str(again),)
            error = pytest.ExceptionInfo.from_exception(again)
    assert len(given) == 6
    with pytest.raises(InputError, match="choose from soft"):
        capsule.simulate(DRIVE, TIMES, draws=5, spring="stiff")
    # Before: no contact, and not a word.
    with pytest.raises(InputError, match=r"spring needs its gap, and a gap its spring, k2 alone \('soft'\)"):
        capsule.simulate(DRIVE, TIMES, draws=5, spring="soft")
    for wrong in ({"k2": 5e3}, {"G": 1e-3}, {"k2_back": 5e3}):
        with pytest.raises(InputError, match=r"alone.*, give both, spring='NAME' and gap=1e-3, in m, or neither"):
            capsule.simulate(DRIVE, TIMES, draws=5, given=wrong)
    with pytest.raises(InputError, match=r"given must name leaves of CapsuleParameters, 'k2\[soft\]', choose from m1"):
        capsule.simulate(DRIVE, TIMES, draws=5, given={"k2[soft]": 9e4})
    with pytest.warns(UserWarning, match=r"the gap is 1000 mm and the largest \|x_rel\| .* mm: no contact"):
        capsule.simulate(DRIVE, TIMES, draws=5, spring="soft", gap=1.0)
    assert np.all(np.asarray(capsule.simulate(DRIVE, TIMES, draws=5).contacts) == 0)
    with pytest.raises(InputError, match="give at most"):
        capsule.simulate(DRIVE, TIMES, draws=10**9)


def test_compare_counts_sds_and_names_what_differs(fitted: Fit) -> None:
    same = cid.compare(fitted, fitted)
    assert list(same.index) == ["K", "k2[soft]"]
    assert not same["differs"].any()
    assert (same["sds"] == 0.0).all()
    summary = fitted.summary.copy()
    sd = float(summary.at["K", "sd"])
    summary.loc["K", "value"] += 5.0 * sd
    moved = compare(fitted, dataclasses.replace(fitted, summary=summary))
    assert moved.at["K", "sds"] == pytest.approx(5.0 / np.sqrt(2.0))
    assert dict(moved["differs"]) == {"K": True, "k2[soft]": False}
    assert moved.at["K", "sd"] == pytest.approx(np.sqrt(2.0) * sd)


def test_compare_names_what_it_takes(fitted: Fit) -> None:
    with pytest.raises(InputError, match=r"compare takes two results, str 'results/a', give results of fit, or load"):
        compare(fitted, "results/a")  # type: ignore[arg-type]


@pytest.mark.full
def test_compare_finds_two_equal_rigs_equal(fitted: Fit) -> None:
    """1 pair in 20 of results of equal rigs shows a difference; with sds half as large, far more do."""
    rng = np.random.default_rng(0)
    found = {1.0: 0, 0.5: 0}
    centre, sd = fitted.summary["value"].to_numpy(float), fitted.summary["sd"].to_numpy(float)
    for stated in found:
        for _ in range(200):
            pair = [
                dataclasses.replace(
                    fitted, summary=fitted.summary.assign(value=centre + sd * rng.normal(size=2), sd=stated * sd)
                )
                for _ in range(2)
            ]
            found[stated] += bool(cid.compare(*pair)["differs"].any())
    assert 2 <= found[1.0] <= 20
    assert found[0.5] > 50


@pytest.mark.full
def test_arviz_needs_no_arguments(capsule: Fit, tmp_path: Path) -> None:
    """ArviZ 0.2x and 1: ``loo`` of a fit, with 1,000 draws where it has them; only rows of a small table decide a parameter."""
    capsule.write(tmp_path / "out")
    pointwise = cast(Pointwise, capsule.pointwise)
    ensembles, draws, walkers, _ = cast(Posterior, capsule.posterior).draws.shape
    assert len(pointwise.chain) * len(pointwise.draw) >= min(1000, ensembles * draws * walkers)
    terms = {label: values.shape[-1] for label, values in pointwise.log_likelihood.items()}
    assert all(
        terms[label] == min(len(y), BLOCKS if "vib" in label else len(y)) for label, y in capsule.observed.items()
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of ArviZ about matplotlib, and about this short chain
        for data in (arviz.from_netcdf(str(tmp_path / "out" / "posterior.nc")), capsule.to_arviz()):
            loo: Any = arviz.loo(data, pointwise=True)
            assert (loo.n_data_points, np.isfinite(getattr(loo, "elpd_loo", None) or loo.elpd)) == (
                sum(terms.values()),
                True,
            )
            shapes = np.asarray(loo.pareto_k)
        (found,) = [finding for finding in capsule.findings if finding.code == "readings.decisive"]
        named = found.facts["rows"]
        each = [(label, int(row) + 1) for label, rows in pointwise.rows.items() for row in rows]
        decisive = [one for one, shape in zip(each, shapes, strict=True) if shape > found.facts["limit"]]
        assert decisive
        assert all(f"{label} reading {row} (" in named for label, row in decisive), (decisive, named)
        data = capsule.to_arviz()
        plot = getattr(arviz, "plot_ppc", None) or arviz.plot_ppc_dist  # pyright: ignore
        plot(data)
        assert len(data.posterior_predictive.data_vars) == len(capsule.observed)
        arviz.plot_trace(data)


@pytest.mark.slow
def test_arviz_1_reads_a_result(tmp_path: Path) -> None:
    """The tests of ArviZ on Python 3.12 or later, where such an interpreter is at hand: ArviZ 1 needs it."""
    known = [path for path in map(shutil.which, ("python3.14", "python3.13", "python3.12")) if path]
    running = [path for path in known if subprocess.run([path, "--version"], capture_output=True).returncode == 0]
    if not running:
        pytest.skip("no Python 3.12 or later")
    python, root = tmp_path / "venv" / "bin" / "python", Path(__file__).parents[1]
    subprocess.run([running[0], "-m", "venv", str(tmp_path / "venv")], check=True)
    subprocess.run([str(python), "-m", "pip", "install", "-q", f"{root}[test]", "arviz>=1,<2"], check=True)
    words = ["tests/test_fitted.py", "tests/report/test_write.py", "tests/inference", "-k", "arviz", "-n", "0"]
    own = ("JAX", "XLA", "PYTEST")  # of this session, which the other one sets for itself
    env = {name: value for name, value in os.environ.items() if not name.startswith(own)}
    done = subprocess.run(
        [str(python), "-m", "pytest", "-q", *words], cwd=root, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]


def test_replicates_scatter_as_the_readings(capsule: Fit) -> None:
    """Replicates of a decay that the model fits: the readings lie in the 95 % band of their replicates."""
    low, high = np.quantile(
        cast(Pointwise, capsule.pointwise).replicates["free_vibration_1"], [0.025, 0.975], axis=(0, 1)
    )
    y = capsule.observed["free_vibration_1"]
    assert np.mean((low <= y) & (y <= high)) == pytest.approx(0.95, abs=0.025)


def test_the_truth_lies_beside_a_synthetic_rig(tmp_path: Path) -> None:
    truth = cid.synthesize(tmp_path / "rig", seed=1)
    rig = cid.read_rig(tmp_path / "rig")
    assert truth_beside(rig)["k1"] == truth["k1"]
    assert truth_beside(dataclasses.replace(rig, synthetic=False)) == {}
    (tmp_path / "rig.truth.json").write_text("[]", encoding="utf-8")
    assert truth_beside(rig) == {}


def test_help_lists_the_public_names() -> None:
    import pydoc

    text = pydoc.plain(pydoc.render_doc(cid))
    for word in ("rig folder", "Glossary", "capsule_id.load", "class Fit", "fit(", "load(", "compare("):
        assert word in text, word
