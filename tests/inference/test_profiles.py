"""Profile likelihoods against two-dimensional grids, and words of planted cases."""

from pathlib import Path

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import read_rig
from capsule_id.cli import fit_params
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference.marginal import density_of
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.profiles import DROP, _end, identified, profile, profile_tables
from capsule_id.inference.result import PointFit
from capsule_id.inference.target import LogPosterior
from tests.cli_tools import small_rig

HEAD = (
    '[rig]\nname = "planted"\nm1 = { value = 110, sd = %g, unit = "g" }\nm2 = { value = 530, sd = 0.5, unit = "g" }\n'
)
DECAY = """
[[experiment]]
kind = "free_vibration"
file = "decay.csv"
damping = "viscous"
stiffness = "linear"
noise = "white"
drift = "none"
"""


def _fit(folder: Path) -> tuple[LogPosterior, PointFit]:
    rig = read_rig(folder)
    target = LogPosterior(rig, make_experiments(rig, "bench", default_registry()))
    return target, point_fit(target, 0)


def _decay(folder: Path, c: float, m1_sd: float) -> Path:
    """A rig with one decay of k1 = 1420 N/m, m1 = 110 g and c."""
    folder.mkdir()
    t, m1, k1 = np.arange(600) / 2000.0, 0.11, 1420.0
    g = c / (2.0 * m1)
    w = np.sqrt(k1 / m1 - g**2)
    x = 2.5 * np.exp(-g * t) * (np.cos(w * t) + g / w * np.sin(w * t))
    x = x + 0.02 * np.random.default_rng(1).standard_normal(t.size)
    rows = "".join(f"{a:.4f},{b:.4f}\n" for a, b in zip(t, x, strict=True))
    (folder / "decay.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")
    (folder / "rig.toml").write_text(HEAD % m1_sd + DECAY, encoding="utf-8")
    return folder


def test_an_interval_ends_where_the_profile_first_falls() -> None:
    """Before: some number, where a second hump lies beyond. Against the crossing of a parabola."""
    value = np.linspace(0.0, 8.0, 161)
    height = np.maximum(-0.5 * value**2, -0.5 * (value - 6.0) ** 2 - 0.5)
    height[value > 4.0] = np.maximum(height[value > 4.0], -1.0)
    assert float(_end(value, height)) == pytest.approx(np.sqrt(2.0 * DROP), abs=2e-3)
    assert _end(value[:20], height[:20]) == "open"


def test_a_profile_is_the_ridge_of_a_grid(tmp_path: Path) -> None:
    """mu and the scatter of the tilts: the largest log-posterior of each row of a grid, its own prior left out."""
    target, fit = _fit(small_rig(tmp_path / "rig"))
    assert len(target.names) == 2
    i, other = target.names.index("mu"), 1 - target.names.index("mu")
    found = profile(target, fit, "mu")
    u = np.log(found["value"].to_numpy())
    sd = np.sqrt(np.diag(fit.covariance))
    across = fit.u[other] + sd[other] * np.linspace(-6.0, 8.0, 2001)
    heights = []
    for value in u:
        points = np.empty((len(across), 2))
        points[:, i], points[:, other] = value, across
        own = target.priors.at(slice(None), np).terms(points[0], target.theta(points[0]), np)[i]
        heights.append(density_of(target)(points).max() - own)
    np.testing.assert_allclose(found["profile"], np.array(heights) - max(heights), atol=2e-4)
    # It is no parabola: with few tilts the scatter grows with the distance.
    assert np.abs(found["profile"] - found["curvature"]).max() > 0.1
    assert found["value"].is_monotonic_increasing
    assert abs(found["value"][found["profile"].idxmax()] / fit.values["mu"] - 1.0) < 0.01
    (table,) = profile_tables(target, fit, ["mu", "mu"])
    low, high = float(table.facts["lower"]), float(table.facts["upper"])
    np.testing.assert_allclose(np.interp(np.log([low, high]), u, found["profile"]), -DROP, atol=0.05)
    with pytest.raises(InputError, match="a profile needs a parameter of the fit, k9, choose from mu"):
        profile(target, fit, "k9")


@pytest.mark.full
def test_a_profile_of_pushes_is_the_largest_value_of_grids(tmp_path: Path) -> None:
    """v_s of pushes at 0.2 to 0.8 v_s, one-sided: at each v_s the largest value over a grid of mu and the scatter."""
    v = np.linspace(0.06, 0.24, 12)
    rows = "".join(
        f"{a:.5f},{1e3 * d:.6f}\n"
        for a, d in zip(
            v, (0.5 * v**2 + v**4 / (4.0 * 0.09)) / (0.6 * 9.81) * (1.0 + 0.02 * np.cos(9.0 * v)), strict=True
        )
    )
    (tmp_path / "pushes.csv").write_text(f"speed [m/s],distance [mm]\n{rows}", encoding="utf-8")
    (tmp_path / "rig.toml").write_text(
        (HEAD % 0.0).replace("sd = 0.5, ", "").replace("sd = 0, ", "")
        + '[[experiment]]\nkind = "dynamic_friction"\nfile = "pushes.csv"\n',
        encoding="utf-8",
    )
    target, fit = _fit(tmp_path)
    assert len(target.names) == 3
    i = target.names.index("v_s")
    others = [j for j in range(3) if j != i]
    found = profile(target, fit, "v_s")
    u, sd = np.log(found["value"].to_numpy()), np.sqrt(np.diag(fit.covariance))
    heights = []
    for value in u:
        at, width = fit.u[others], 10.0 * sd[others]
        for _ in range(5):  # each grid within the steps of the one before
            axes = [x + w * np.linspace(-1.0, 1.0, 41) for x, w in zip(at, width, strict=True)]
            points = np.full((41**2, 3), value)
            points[:, others] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            density = density_of(target)(points)
            at, width = points[np.argmax(density)][others], width / 8.0
        own = target.priors.at(slice(None), np).terms(points[0], target.theta(points[0]), np)[i]
        heights.append(density.max() - own)
    np.testing.assert_allclose(found["profile"], np.array(heights) - max(heights), atol=2e-4)
    assert np.abs(found["profile"] - found["curvature"]).max() > 0.1


@pytest.mark.parametrize(
    ("c", "m1_sd", "damping"), [(3.9, 0.5, "bounded"), (3.9, 20.0, "bounded, tied to m1"), (1e-4, 0.5, "upper limit")]
)
def test_words_of_a_decay(tmp_path: Path, c: float, m1_sd: float, damping: str) -> None:
    """The frequency gives k1/m1, whatever the weighing; a light damping has no lower limit."""
    (table,) = identified(*_fit(_decay(tmp_path / "rig", c, m1_sd)))
    assert table.frame["known"].to_dict() == {"k1": "bounded, tied to m1", "c": damping}
    assert table.frame.loc["k1", "with"] == "m1"


@pytest.mark.parametrize(
    ("prior", "word"),
    [("", "lower limit"), ('[prior]\nv_s = { median = 0.3, factor = 1.2, unit = "m/s" }\n', "flat")],
)
def test_words_of_slow_pushes(tmp_path: Path, prior: str, word: str) -> None:
    """Pushes far below v_s show static friction: v_s is not small. Within a narrow prior they tell nothing."""
    folder = tmp_path / "rig"
    folder.mkdir()
    v = np.linspace(0.02, 0.06, 12)
    noise = 1.0 + 0.1 * (-1.0) ** np.arange(v.size)
    rows = "".join(f"{a:.5f},{1e3 * a**2 / (2.0 * 0.6 * 9.81) * n:.6f}\n" for a, n in zip(v, noise, strict=True))
    (folder / "pushes.csv").write_text(f"speed [m/s],distance [mm]\n{rows}", encoding="utf-8")
    tilts = "".join(f"{angle}\n" for angle in (30.8, 31.1, 30.9, 31.0, 31.2, 30.7))
    (folder / "tilts.csv").write_text(f"angle [deg]\n{tilts}", encoding="utf-8")
    entries = [f'[[experiment]]\nkind = "{kind}"\nfile = "{file}.csv"\n' for kind, file in
               (("static_friction", "tilts"), ("dynamic_friction", "pushes"))]  # fmt: skip
    (folder / "rig.toml").write_text(HEAD % 0.5 + prior + "".join(entries), encoding="utf-8")
    (table,) = identified(*_fit(folder))
    assert table.frame["known"].to_dict() == {"mu": "bounded", "v_s": word}


INSTRUMENT = '[[instrument]]\nname = "cell"\n%s\n[[experiment]]\nkind = "%s"\nfile = "readings.csv"\n%s'
STEPS = np.linspace(1.0, 8.0, 8)
SCATTER = 1.0 + 0.002 * (-1.0) ** np.arange(8)


@pytest.mark.parametrize(
    ("text", "columns", "word"),
    [
        (
            INSTRUMENT
            % ('gain = { sd = 5, unit = "%" }', "support_spring", 'spring = "a"\nforce_instrument = "cell"\n'),
            {"deflection [mm]": STEPS, "force [N]": 5.0 * STEPS * SCATTER},
            {"k2[a]": "bounded, tied to gain[cell]"},
        ),
        (
            INSTRUMENT % ('gain = { sd = 5, unit = "%" }', "motor_current", 'force_instrument = "cell"\n'),
            {"current [A]": 0.2 * STEPS, "force [N]": 0.4 * STEPS * SCATTER},
            {"K": "bounded, tied to gain[cell]"},
        ),
        (
            INSTRUMENT % ('offset = { sd = 2, unit = "deg" }', "static_friction", 'angle_instrument = "cell"\n'),
            {"angle [deg]": 31.0 * SCATTER},
            {"mu": "bounded, tied to offset[cell]"},
        ),
    ],
)
def test_words_of_what_an_instrument_scales(
    tmp_path: Path, text: str, columns: dict[str, np.ndarray], word: dict[str, str]
) -> None:
    """An unknown gain or zero of the one instrument moves the parameter as its own change does."""
    rows = "".join(",".join(f"{x:.6g}" for x in row) + "\n" for row in np.column_stack(list(columns.values())))
    (tmp_path / "readings.csv").write_text(",".join(columns) + "\n" + rows, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(HEAD % 0.5 + text, encoding="utf-8")
    (table,) = identified(*_fit(tmp_path))
    assert table.frame["known"].to_dict() == word


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"viscous"', '["viscous", "dry"]', {"k1": "bounded, tied to m1", "c": "bounded", "F_dry": "upper limit"}),
        (
            'noise = "white"',
            'noise = "white"\nclock = { value = 0, sd = 3, unit = "%" }',
            {"k1": "bounded, tied to clock_drift[decay]", "c": "bounded, tied to k1"},
        ),
    ],
)
def test_words_of_a_force_that_is_not_there_and_of_an_unknown_clock(
    tmp_path: Path, old: str, new: str, words: dict[str, str]
) -> None:
    folder = _decay(tmp_path / "rig", 3.9, 0.5)
    text = (folder / "rig.toml").read_text(encoding="utf-8")
    (folder / "rig.toml").write_text(text.replace(old, new), encoding="utf-8")
    (table,) = identified(*_fit(folder))
    assert table.frame["known"].to_dict() == words


def test_the_command_draws_profiles_into_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, out = str(_decay(tmp_path / "rig", 3.9, 0.5)), tmp_path / "result"
    assert fit_params([rig, "--no-sample", "--quiet", "--profile", "k1,k9", "--out", str(out)]) == 2
    assert "a profile needs a parameter of the fit, k9, choose from m1, m2, k1, c" in capsys.readouterr().err
    assert not out.exists()
    assert fit_params([rig, "--no-sample", "--quiet", "--profile", "k1, c", "--out", str(out)]) in (0, 3)
    assert {"profile_k1.png", "profile_c.png"} <= {path.name for path in (out / "figures").iterdir()}
    result = cid.load(out)
    drawn = [note for note in result.notes if note.code == "parameters.profile"]
    assert [note.facts["name"] for note in drawn] == ["k1", "c"]
    assert "k1, N/m: log-likelihood maximised over all other parameters" in result.text(drawn[0])
    frame = drawn[0].frame
    # k1 moves with m1 along the ridge.
    np.testing.assert_allclose(frame["m1"] / frame.index, frame["m1"].iloc[0] / frame.index[0], rtol=2e-3)
    assert result.table("parameters.identified").loc["k1", "known"] == "bounded, tied to m1"


def test_with_runs_the_curvature_stands_for_profiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, fit = _fit(_decay(tmp_path / "rig", 1e-4, 0.5))
    monkeypatch.setattr("capsule_id.inference.profiles.polish", lambda *_: pytest.fail("a profile was computed"))
    monkeypatch.setattr(LogPosterior, "kinked", property(lambda _: True))
    (table,) = identified(target, fit)
    assert table.frame["known"].to_dict() == {"k1": "bounded, tied to m1", "c": "bounded"}
