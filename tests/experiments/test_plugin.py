"""A kind of experiment, with a parameter of its own, that comes from another installed package."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Mapping
from pathlib import Path
from site import addsitedir
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from capsule_id import experiments
from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments import kind as registry
from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.kind import GROUP, Registry, default_registry, package_folders
from capsule_id.experiments.point_test import PointTest
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior, scatter
from capsule_id.physics.forces import FrictionLaw
from capsule_id.rig.model import Settings, Table
from tests import cli_tools
from tests.experiments import bench
from tests.experiments.test_foreign_law import TRUTH, Lorentzian

#: The kinds without the package, made before a test installs it.
KINDS = default_registry()
PLUGIN = Path(__file__).with_name("rolling_rig")
#: The kind of the guide.
RECIPE = re.findall(
    r"```python\n(.*?)```", (cli_tools.ROOT / "capsule_id/guide/extending.md").read_text("utf-8"), re.S
)[0]
SPEEDS = (0.1, 0.2, 0.3, 0.4, 0.5)
#: Measured force, N: c_rr (m1 + m2) g = 0.0628 N at c_rr = 0.01, and a scatter of 1 mN.
FORCES = (0.0638, 0.0618, 0.0628, 0.0633, 0.0623)


def install(site: Path, target: str = "rolling_rig:KIND") -> Path:
    """``site`` as ``pip install`` leaves it: the packages, and metadata with an entry point."""
    info = site / "rolling_rig-0.1.dist-info"
    info.mkdir(parents=True)
    shutil.copytree(PLUGIN, site / "rolling_rig", ignore=shutil.ignore_patterns("__pycache__"))
    (site / "towing_rig.py").write_text(RECIPE, encoding="utf-8")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rolling-rig\nVersion: 0.1\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nrolling_resistance = {target}\n", encoding="utf-8")
    return site


def environment_in(folder: Path) -> tuple[Path, Path]:
    """A virtual environment with the packages of this one beside its own: its Python, and its package folder."""
    venv.create(folder, symlinks=os.name == "posix")
    places = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", "venv", places))
    (site / "shared.pth").write_text(f"{cli_tools.ROOT}\n{sysconfig.get_path('purelib')}\n", encoding="utf-8")
    return Path(sysconfig.get_path("scripts", "venv", places)) / Path(sys.executable).name, site


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with the package."""
    python, site = environment_in(tmp_path_factory.mktemp("site") / ".venv")
    install(site)
    return python


def run(python: Path, *words: str, name: str = "capsule_id") -> subprocess.CompletedProcess[str]:
    """A command of an environment, started in the folder that holds the environment."""
    command = [str(python), *cli_tools.argv(*words, name=name)[1:]]
    quiet = {"capture_output": True, "text": True, "check": False, "timeout": 300}
    return subprocess.run(command, cwd=python.parents[2], env=cli_tools.environment(PYTHONPATH=None), **quiet)


@pytest.fixture(scope="module")
def folder(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig folder from ``init``, with the entry of the new kind in use."""
    folder = tmp_path_factory.mktemp("rigs") / "rolling"
    done = run(site, "init", str(folder))
    assert (done.returncode, done.stderr) == (0, "")
    text = (folder / "rig.toml").read_text(encoding="utf-8")
    head, entry = text.split("#: Rolling resistance")
    assert "rolling_scatter" in head.split("Half-normal")[1]  # [prior] may override the parameters of the kind
    masses = head.replace("# m1 =", "m1 =").replace("# m2 =", "m2 =")
    (folder / "rig.toml").write_text(masses + "#:" + entry.replace("\n# ", "\n"), encoding="utf-8")
    rows = "\n".join(f"{v},{1e3 * force:.2f}" for v, force in zip(SPEEDS, FORCES, strict=True))
    (folder / "rolling_resistance.csv").write_text(f"speed [m/s],force [mN]\n{rows}\n", encoding="utf-8")
    return folder


@pytest.mark.full
def test_check_reads_and_lints_it(site: Path, folder: Path) -> None:
    done = run(site, "check", str(folder))
    assert (done.returncode, done.stderr) == (0, "")
    assert "rolling_resistance rolling_resistance: 5 rows of speed [m/s], force [mN]" in done.stdout
    assert "warn: rolling_resistance: fewer than 6 speeds. Measure more." in done.stdout


@pytest.mark.full
def test_without_the_package_the_kind_is_unknown(folder: Path, tmp_path: Path) -> None:
    """The negative control."""
    done = cli_tools.run("check", str(folder), name="capsule_id", cwd=tmp_path)
    assert done.returncode == 2
    assert "unknown kind, 'rolling_resistance'" in cli_tools.message(done.stderr)


@pytest.mark.full
def test_it_is_fitted_and_reported(site: Path, folder: Path, tmp_path: Path) -> None:
    """Independent route: the mean force over the weight."""
    done = run(site, str(folder), "--out", str(tmp_path / "out"), "--no-sample", "--quiet", name="fit_params")
    assert (done.returncode, done.stderr) == (0, "")
    saved = json.loads((tmp_path / "out" / "parameters.json").read_text())
    assert saved["provenance"]["versions"]["rolling-rig"] == "0.1"
    fitted = saved["parameters"]
    weight = (0.110 + 0.530) * 9.81
    assert set(fitted) == {"c_rr", "m1", "m2"}
    assert fitted["c_rr"]["map"] == pytest.approx(sum(FORCES) / len(FORCES) / weight, rel=2e-3)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Rolling resistance: the force at each speed" in page
    # Its own check and its own table, in its own words.
    (own,) = [finding for finding in saved["verdict"]["findings"] if finding["code"] == "rolling.speeds"]
    text = "the force is the same at all 5 speeds"
    assert (own["check"], own["level"]) == ("rolling at all speeds", "ok")
    assert own["text"] == f"rolling_resistance: {text}"
    assert text in page
    assert "Speeds of the wheel" in page
    assert "Where c_rr = 0.010 was measured." in page


def load(site: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """The default registry, made anew with the package in ``site`` installed."""
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr(registry.site, "getsitepackages", lambda: [str(site)])
    for name in [name for name in sys.modules if name.split(".")[0] in ("rolling_rig", "towing_rig")]:
        monkeypatch.delitem(sys.modules, name)
    return default_registry.__wrapped__()


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages alone, in a folder."""
    return install(tmp_path_factory.mktemp("packages"))


def test_code_of_the_working_folder_is_not_loaded(packages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: a planted ``*.dist-info`` in the folder of a rig ran there. Negative control: the same, installed."""
    monkeypatch.chdir(packages)
    monkeypatch.syspath_prepend("")
    assert list(default_registry.__wrapped__()) == list(KINDS)
    assert "rolling_rig" not in sys.modules
    monkeypatch.chdir(packages.parent)
    assert "rolling_resistance" in load(packages, monkeypatch)


def test_a_pth_file_names_a_folder_of_packages(packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = f"# a comment\nimport sys; sys.exit(1)\n\n{packages}\n/no/such/folder\n\0\n"
    (tmp_path / "editable.pth").write_text(lines, encoding="utf-8")
    monkeypatch.setattr(registry.site, "getsitepackages", lambda: [str(tmp_path)])
    assert {str(tmp_path), str(packages)} <= set(package_folders())
    monkeypatch.chdir(packages)
    assert str(packages) not in package_folders()


def test_a_folder_added_by_site_holds_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: the kinds of such an overlay vanished without a word. A rig folder and what stands first never count."""
    first, overlay, other, rig = (install(tmp_path / name) for name in ("first", "overlay", "other", "rig"))
    (rig / "rig.toml").write_text("", encoding="utf-8")
    (overlay / "more.pth").write_text(f"{other}\n", encoding="utf-8")
    monkeypatch.setattr(sys, "path", [str(first), *sys.path])
    for folder in (overlay, rig):
        addsitedir(str(folder))
    found = package_folders()
    assert {str(overlay), str(other)} <= set(found)
    assert not {str(first), str(rig)} & set(found)
    # What Python itself leaves out, and a relative folder: none counts, none is an error.
    monkeypatch.chdir(rig)
    found = package_folders()
    monkeypatch.setattr(sys, "path", [*sys.path, None, 3, b"x", "..", "a\0b"])
    assert package_folders() == found
    monkeypatch.chdir(overlay)
    assert str(overlay) not in package_folders()


def test_its_parameters_and_settings_join_those_of_the_package(packages: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = load(packages, monkeypatch)
    assert list(kinds) == [*KINDS, "rolling_resistance"]
    assert set(kinds.parameters) - set(KINDS.parameters) == {"c_rr", "rolling_scatter"}
    assert kinds["rolling_resistance"].required == ("wheel",)
    assert (kinds.packages, KINDS.packages) == ({"rolling-rig": "0.1"}, {})


@pytest.mark.parametrize(
    ("change", "target", "fault"),
    [
        (("import numpy", "import no_such_module\nimport numpy"), "rolling_rig:KIND", "ModuleNotFoundError"),
        (("", ""), "rolling_rig:MISSING", "AttributeError"),
        (("", ""), "rolling_rig:C_RR", "TypeError: rolling_rig:C_RR is no Kind"),
        (('name="rolling_resistance"', 'name="forced_run"'), "rolling_rig:KIND", "kind forced_run is declared"),
        (('"c_rr", "1"', '"mu", "1"'), "rolling_rig:KIND", "parameter mu of kind rolling_resistance is declared"),
        (
            ('"rolling.speeds"', '"lines.straight"'),
            "rolling_rig:KIND",
            "message lines.straight of kind rolling_resistance",
        ),
        (("Annotated[str, NameRule()]", "str"), "rolling_rig:KIND", "the type of setting wheel must be"),
    ],
)
def test_a_faulty_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: tuple[str, str], target: str, fault: str
) -> None:
    site = install(tmp_path / "site", target)
    source = site / "rolling_rig" / "__init__.py"
    text = source.read_text(encoding="utf-8")
    assert change[0] in text
    source.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load(site, monkeypatch)
    assert str(caught.value).startswith("rolling-rig: the experiment kind rolling_resistance of an installed package")
    assert fault in caught.value.value
    assert caught.value.remedy == "update the package rolling-rig, or uninstall it"


@pytest.fixture
def towing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """The registry with the kind of the guide, which ignores what the friction law is."""
    assert len([line for line in RECIPE.splitlines() if line.strip()]) <= 20
    return load(install(tmp_path / "site", "towing_rig:KIND"), monkeypatch)


def towed(folder: Path, n: int = 40) -> Path:
    """A rig folder with pulls of ``TRUTH`` at ``n`` speeds, with a scatter of 1 %."""
    folder.mkdir()
    speed = np.geomspace(0.01, 1.0, n)
    pull = TRUTH.forward(speed) * (1.0 + 0.01 * np.random.default_rng(2).standard_normal(n))
    rows = "\n".join(f"{v},{F}" for v, F in zip(speed, pull, strict=True))
    (folder / "towing.csv").write_text(f"speed [m/s],pull [N]\n{rows}\n", encoding="utf-8")
    masses = "\n".join(f'm{k} = {{ value = {m}, sd = 1e-4, unit = "kg" }}' for k, m in ((1, 0.11), (2, 0.53)))
    errors = 'speed_sd = { value = 2, unit = "mm/s" }\npull_sd = { value = 10, unit = "mN" }'
    entry = f'[[experiment]]\nkind = "towing"\nfile = "towing.csv"\n{errors}'
    (folder / "rig.toml").write_text(f'[rig]\nname = "towed"\n{masses}\n{entry}\n', encoding="utf-8")
    return folder


@pytest.mark.parametrize("law", [None, Lorentzian])
def test_the_kind_of_the_guide_follows_the_friction_law_by_name(
    towing: Registry, tmp_path: Path, law: type[FrictionLaw] | None
) -> None:
    """Before: a kind of another package had to read mu, and a law of the user's own beside it was refused."""
    rig = read_rig(towed(tmp_path / "rig"), towing)
    (e,) = registry.make_experiments(rig, registry=towing, friction=law)
    weight, v = 0.64 * rig.g.value, e.table["speed"]
    if law is None:
        own = {"mu": 0.6, "v_s": 0.1}
        force = 0.3 * weight * (1.0 + np.exp(-v / 0.1))
        slope = -0.3 * weight * np.exp(-v / 0.1) / 0.1
    else:
        own = vars(TRUTH)
        force = TRUTH.forward(v)
        slope = -2.0 * v / TRUTH.v_0**2 * (TRUTH.F_s - TRUTH.F_c) / (1.0 + (v / TRUTH.v_0) ** 2) ** 2
    assert [row.symbol for row in e.parameters] == [*own, "towing_scatter"]
    theta = {**own, "towing_scatter": 0.02, "m1": 0.11, "m2": 0.53, "g": rig.g.value}
    sd = np.sqrt(0.01**2 + (0.002 * slope) ** 2 + (0.02 * force) ** 2)
    expected = np.sum(stats.norm.logpdf(e.observed, force, sd))
    for xp in (np, jnp):
        assert float(e.log_likelihood(theta, xp)) == pytest.approx(expected, rel=1e-10)
    (panel,) = registry.compare([e], theta, [theta, theta], towing)
    assert (panel.kind, len(panel.curves[0].y)) == ("towing", 60)


class Balance(PointTest):
    """A reading that has a table of its own, and a scatter with its unit."""

    reading, reads, relative = "force", ("k1",), False
    scatter = scatter("balance_sd", "N", "scatter of a balance", "s", Prior("halfnormal", 0.0, 0.1))

    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        return theta["k1"] * 1e-3


def test_a_table_with_one_column_is_a_test_too() -> None:
    force = np.array([1.40, 1.45, 1.41])
    columns = {"force": bench.column("force", force, 0.02)}
    table = Table("balance", "balance", "balance.csv", columns, Settings(), np.arange(2, 5), True)
    e = Balance(table, bench.rig(table))
    theta = {"k1": 1420.0, "balance_sd": 0.03}
    expected = np.sum(stats.norm.logpdf(force, 1.42, np.hypot(0.02, 0.03)))
    assert float(e.log_likelihood(theta, np)) == pytest.approx(expected, rel=1e-12)
    (panel,) = e.comparisons(theta, [])
    assert (panel.x_label, panel.y_label) == ("trial", "force, SI")
    assert panel.points[0].x.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.full
def test_the_kind_of_the_guide_recovers_a_law_of_the_users_own(towing: Registry, tmp_path: Path) -> None:
    rig = read_rig(towed(tmp_path / "rig"), towing)
    fit = point_fit(LogPosterior(rig, registry.make_experiments(rig, registry=towing, friction=Lorentzian)), 0)
    for name, truth in vars(TRUTH).items():
        assert abs(fit.values[name] - truth) < 4.0 * fit.standard_errors[name] < 0.4 * truth


@pytest.mark.full
def test_a_built_in_kind_is_one_folder_and_one_line(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same kind as a folder of the package, found through its name in ``BUILT_IN`` alone."""
    home = tmp_path / "rolling_resistance"
    home.mkdir()
    (home / "__init__.py").touch()
    for source, target in (("__init__.py", "declaration.py"), ("experiment.py", "experiment.py")):
        text = (PLUGIN / source).read_text(encoding="utf-8")
        text = text.replace("rolling_rig.experiment:", "capsule_id.experiments.rolling_resistance.experiment:")
        text = text.replace(
            "from rolling_rig import", "from capsule_id.experiments.rolling_resistance.declaration import"
        )
        assert "rolling_rig" not in text
        (home / target).write_text(text, encoding="utf-8")
    monkeypatch.setattr(experiments, "__path__", [*experiments.__path__, str(tmp_path)])
    monkeypatch.setattr(registry, "BUILT_IN", (*registry.BUILT_IN, "rolling_resistance"))
    kinds = default_registry.__wrapped__()
    assert list(kinds) == [*KINDS, "rolling_resistance"]
    rig = read_rig(folder, kinds)
    (experiment,) = registry.make_experiments(rig, registry=kinds)
    fit = point_fit(LogPosterior(rig, [experiment]), 0)
    assert fit.values["c_rr"] == pytest.approx(sum(FORCES) / len(FORCES) / (0.640 * 9.81), rel=2e-3)
    for name in [name for name in sys.modules if "rolling_resistance" in name]:
        sys.modules.pop(name)
