"""Several releases in one record of a free vibration: ``releases`` of ``rig.toml``. Records by SciPy."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import capsule_id
from capsule_id import cli
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.records.release import find_releases

T, RATE, M1 = 0.08, 1000.0, 0.5
OMEGA = 2.0 * np.pi / T


def swing(x: float, zeta: float, seconds: float) -> np.ndarray:
    """Free motion (n,) from rest at x."""
    time = np.arange(int(seconds * RATE)) / RATE
    return solve_ivp(
        lambda _, y: [y[1], -(OMEGA**2) * y[0] - 2.0 * zeta * OMEGA * y[1]], (0.0, time[-1]), [x, 0.0],
        t_eval=time, rtol=1e-9, atol=1e-12,
    ).y[0]  # fmt: skip


def pulled(zeta: float, sizes: tuple[float, ...], noise: float = 0.004) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Times, displacements in mm, and times of the releases: rest, then pull, hold and release of each size."""
    parts, releases = [np.zeros(300)], list[float]()
    for k, size in enumerate(sizes):
        pull = 0.5 - 0.5 * np.cos(np.pi * np.arange(250 + 70 * k) / (250 + 70 * k))
        last = parts[-1][-1]
        parts += [last + (size - last) * pull, np.full(200 + 60 * k, size)]
        releases.append(sum(map(len, parts)) / RATE)
        parts.append(swing(size, zeta, 0.4 + 0.1 * k + 2.5 / (zeta * OMEGA)))
    values = np.concatenate(parts)
    return (
        np.arange(len(values)) / RATE,
        values + noise * np.random.default_rng(8).standard_normal(len(values)),
        releases,
    )


def rig_of(folder: Path, time: np.ndarray, values: np.ndarray, lines: str = "") -> Path:
    rows = "".join(f"{t:.6g},{x:.5f}\n" for t, x in zip(time, values, strict=True))
    (folder / "d.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")
    head = f'[rig]\nname = "r"\nm1 = {{ value = {M1}, sd = 0.001, unit = "kg" }}\n'
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n{lines}\n'
    (folder / "rig.toml").write_text(head + entry, encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("zeta", "sizes"),
    [
        (0.02, (2.0, -1.0, 1.5)),
        pytest.param(0.1, (1.0, 3.0), marks=pytest.mark.full),
        pytest.param(0.3, (2.0, -2.0, 1.2), marks=pytest.mark.full),
    ],
)
def test_each_release_begins_a_decay(tmp_path: Path, zeta: float, sizes: tuple[float, ...]) -> None:
    time, values, releases = pulled(zeta, sizes)
    rig = capsule_id.read_rig(rig_of(tmp_path, time, values, 'releases = "all"'))
    assert [table.label for table in rig.tables] == [f"d_{k + 1}" for k in range(len(sizes))]
    for table, release, size in zip(rig.tables, releases, sizes, strict=True):
        assert -0.03 * T <= table["time"][0] - release < 0.15 * T
        np.testing.assert_allclose(table["time"], time[table.rows - 2], atol=1e-9)
        free = 1e-3 * swing(size, zeta, time[-1])[np.rint((table["time"] - release) * RATE).astype(int).clip(0)]
        assert np.max(np.abs(table["x_rel"] - free)) < 0.04e-3  # no part of the next pull
    (found,) = [one for one in rig.tables[0].findings if one.code == "times.parts"]
    assert found.facts["records"] == len(sizes)
    assert found.facts["used"].startswith(f"{rig.tables[0]['time'][0]:.6g} to ")
    assert found.facts["left"].startswith("0 to ")
    codes = {one.code for one in lint(rig, default_registry(), rig.tables)}
    assert not codes & {"decays.release", "decays.second"}


@pytest.mark.full
def test_values_and_chosen_releases(tmp_path: Path) -> None:
    time, values, _ = pulled(0.05, (2.0, -1.0, 1.5))
    folder = rig_of(tmp_path, time, values, "releases = [1, 3]")
    first, third = capsule_id.read_rig(folder).tables
    assert (first.label, third.label, round(float(np.max(third["x_rel"])), 4)) == ("d_1", "d_2", 0.0015)
    fit = capsule_id.fit(folder, budget=None)
    for name, true in (("k1", M1 * OMEGA**2), ("c", 2.0 * 0.05 * OMEGA * M1)):
        assert fit[name].value == pytest.approx(true, abs=3.0 * fit[name].sd + 0.003 * true)


def test_check_and_init_offer_the_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time, values, _ = pulled(0.05, (2.0, 1.5))
    cli.capsule_id(["check", str(rig_of(tmp_path, time, values))])
    assert 'fit all of its 2 releases: add releases = "all" instead' in " ".join(capsys.readouterr().out.split())
    assert cli.capsule_id(["init", str(tmp_path / "new"), "--from", str(tmp_path / "d.csv")]) == 0
    assert 'releases = "all"  # likely: 2 releases' in (tmp_path / "new" / "rig.toml").read_text(encoding="utf-8")


def test_one_decay_is_not_divided() -> None:
    """A clean decay, one with a blow, and one that bounces and loses energy."""
    time, one = np.arange(2000) / RATE, swing(2.0, 0.02, 2.0)
    blow, bounce = one.copy(), one.copy()
    blow[600:] += -swing(0.8, 0.02, 2.0)[20:1420]
    bounce[500:] = 0.6 * swing(2.0, 0.02, 2.0)[500:2000]
    for values in (one, blow, bounce):
        assert find_releases(time, values + 0.004 * np.random.default_rng(1).standard_normal(2000), True) == []


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ("releases = [4]", "releases must name some of the 2 releases found"),
        ("releases = 2", 'releases must be "all" or a list of numbers'),
        ('releases = "all"\nstart = { value = 0.1, unit = "s" }', "takes no start"),
    ],
)
def test_faults_of_releases(tmp_path: Path, lines: str, text: str) -> None:
    time, values, _ = pulled(0.05, (2.0, 1.5))
    with pytest.raises(InputError, match=text):
        capsule_id.read_rig(rig_of(tmp_path, time, values, lines))


def test_a_single_decay_has_no_releases(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="remove releases"):
        capsule_id.read_rig(rig_of(tmp_path, np.arange(1000) / RATE, swing(2.0, 0.05, 1.0), 'releases = "all"'))
