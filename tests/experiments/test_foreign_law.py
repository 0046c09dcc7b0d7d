"""A friction law and a contact that the package does not know: one class each, simulated, fitted, reported."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.errors import InputError
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.kind import Registry, default_registry, make_experiments
from capsule_id.experiments.static_friction import StaticFriction
from capsule_id.inference.marginal import density_of
from capsule_id.inference.moves import ChainStore
from capsule_id.inference.point_stage import fit_points
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Parameter, Prior
from capsule_id.physics.forces import CoulombStribeck, Force, Spring
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from capsule_id.rig.model import ModelChoices, Quantity, Rig, Table
from tests.experiments import bench
from tests.rig.folder import RIG_TOML, write_folder
from tests.scipy_capsule import simulate_scipy

#: (n,) m/s, and N.
Speed = Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Lorentzian:
    """F_c + (F_s - F_c)/(1 + (v/v_0)^2), both ways: Stribeck's effect with another shape than eq. (1)."""

    F_s: float
    F_c: float
    v_0: float

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("F_s", "N", "break-away force", "F_s", Prior("lognormal", 3.0, 5.0)),
        Parameter("F_c", "N", "friction at high speed", "F_c", Prior("lognormal", 2.0, 5.0)),
        Parameter("v_0", "m/s", "speed of half the weakening", "v_0", Prior("lognormal", 0.1, 10.0)),
    )

    def forward(self, speed: Speed) -> Speed:
        return self.F_c + (self.F_s - self.F_c) / (1.0 + (speed / self.v_0) ** 2)

    backward = forward


TRUTH = Lorentzian(F_s=3.9, F_c=1.4, v_0=0.08)
WEIGHT = (bench.M1 + bench.M2) * bench.G
K2, GAP, OMEGA, P_D = 18960.0, 1e-3, 34.56, 4.0
TILT_SD, DISTANCE_SD, NOISE = np.deg2rad(0.3), 0.3e-3, 2e-5
#: k1, c and k2 are known to 2 %, so that few readings are enough.
KNOWN = {name: Prior("lognormal", value, 1.04) for name, value in (("k1", bench.K1), ("c", bench.C), ("k2[L60]", K2))}


def tilts(rng: np.random.Generator) -> Table:
    angle = np.arctan(TRUTH.F_s / WEIGHT) + TILT_SD * rng.standard_normal(8)
    return bench.table("static_friction", [bench.column("angle", angle)])


def pushes(rng: np.random.Generator) -> Table:
    """Distances by SciPy's quadrature of m u/F(u)."""
    speed = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
    mass = bench.M1 + bench.M2
    distance = np.array([quad(lambda u: mass * u / TRUTH.forward(u), 0.0, v)[0] for v in speed])
    distance += DISTANCE_SD * rng.standard_normal(len(speed))
    return bench.table(
        "dynamic_friction", [bench.column("speed", speed), bench.column("distance", distance, DISTANCE_SD)]
    )


def sliding(rng: np.random.Generator, quantity: str) -> Table:
    speed = np.array([0.03, 0.06, 0.1, 0.2, 0.4, 0.8])
    values = TRUTH.forward(speed) / (1.0 if quantity == "force" else WEIGHT)
    values = values * (1.0 + 0.02 * rng.standard_normal(len(speed)))
    return bench.table("sliding_friction", [bench.column("speed", speed), bench.column(quantity, values)], quantity)


def run(rng: np.random.Generator) -> Table:
    """0.2 s from rest."""
    time = np.arange(200) / 1000.0
    p = CapsuleParameters(bench.M1, bench.M2, bench.K1, K2, bench.C, mu=0.0, v_s=1.0, G=GAP, g=bench.G)
    # A batch of one: the fit shares its compiled program.
    t = simulate(p, Excitation(P_D, OMEGA), time, friction=jax.tree.map(lambda leaf: np.full(1, leaf), TRUTH))
    assert float(np.ptp(t.X2)) > 1e-3, "the capsule slides"
    seen = {"x_rel": np.asarray(t.x_rel)[0], "x_capsule": np.asarray(t.X2)[0]}
    columns = [bench.column(name, values + NOISE * rng.standard_normal(len(time))) for name, values in seen.items()]
    settings = {"spring": "L60", "gap": Quantity(GAP), "Omega": OMEGA, "P_d": Quantity(P_D), "start": "stuck"}
    return bench.table("forced_run", [bench.column("time", time), *columns], "run", **settings)


@pytest.fixture(scope="module")
def rig() -> Rig:
    rng = np.random.default_rng(5)
    return bench.rig(tilts(rng), pushes(rng), run(rng), priors=KNOWN)


@pytest.fixture(scope="module")
def fitted(rig: Rig) -> Fit:
    return cid.fit(rig, budget=None, friction=Lorentzian)


@pytest.mark.full
def test_a_fit_recovers_the_law(fitted: Fit) -> None:
    point = fitted.point_fit
    for row in Lorentzian.parameters:
        pull = (point.values[row.name] - getattr(TRUTH, row.name)) / point.standard_errors[row.name]
        assert abs(pull) < 4.0, row.name
        assert point.standard_errors[row.name] < 0.05 * getattr(TRUTH, row.name)
    assert {"mu", "v_s"}.isdisjoint(point.names)
    assert not [finding.text for finding in fitted.findings if finding.level == "fail"]


@pytest.mark.slow
def test_the_papers_law_fits_the_same_readings_worse(rig: Rig, fitted: Fit) -> None:
    """The negative control."""
    other = fit_points(LogPosterior(rig, make_experiments(rig)), default_registry(), 0, sampled=False).fit
    assert {"mu", "v_s"} <= set(other.names)
    assert fitted.point_fit.log_posterior.max() - other.log_posterior.max() > 30.0


@pytest.mark.full
def test_the_report_draws_the_fitted_law(fitted: Fit, tmp_path: Path) -> None:
    (panel,) = (panel for panel in fitted.comparisons if panel.kind == "friction")
    curve = next(curve for curve in panel.curves if curve.role == "ours")
    assert curve.label == "this fit, Lorentzian"
    best = Lorentzian(*(fitted.point_fit.values[row.name] for row in Lorentzian.parameters))
    np.testing.assert_allclose(curve.y, best.forward(curve.x) / WEIGHT, rtol=1e-12)
    fitted.write(tmp_path / "out")
    html = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "break-away force" in html
    assert html.count("this fit, Lorentzian") == 1  # in the alternative text; the label stands in the picture
    assert (tmp_path / "out" / "parameters.json").read_text(encoding="utf-8").count('"F_c"') == 1


@pytest.mark.full
def test_a_bench_without_runs_is_fitted_too() -> None:
    """The negative control: the paper's law fits the same readings worse."""
    rng = np.random.default_rng(2)
    tables = tilts(rng), pushes(rng), sliding(rng, "force"), sliding(rng, "coefficient")
    rig = bench.rig(*tables, m1=Quantity(bench.M1, 1e-4), m2=Quantity(bench.M2, 1e-4))
    point = cid.fit(rig, budget=None, friction=Lorentzian).point_fit
    assert {"m1", "m2", "F_s", "F_c", "v_0"} < set(point.names)
    for row in Lorentzian.parameters:
        assert abs(point.values[row.name] - getattr(TRUTH, row.name)) < 4.0 * point.standard_errors[row.name]
    other = fit_points(LogPosterior(rig, make_experiments(rig)), default_registry(), 0, sampled=False).fit
    assert {"mu", "v_s"} <= set(other.names)
    assert point.log_posterior.max() - other.log_posterior.max() > 30.0


def test_eq_1_named_explicitly_is_the_default() -> None:
    rig = bench.rig(*(make(np.random.default_rng(1)) for make in (tilts, pushes)))
    plain, named = (LogPosterior(rig, make_experiments(rig, friction=law)) for law in (None, CoulombStribeck))
    assert plain.names == named.names == ("mu", "tilt_sd", "v_s", "push_scatter")
    u = np.log([[0.6, 0.01, 0.2, 0.02]])
    assert float(density_of(plain)(u)[0]) == float(density_of(named)(u)[0])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OnWeight(Lorentzian):
    """A law with a leaf N, the weight of capsule and rod."""

    N: float

    parameters: ClassVar[tuple[Parameter, ...]] = (
        *Lorentzian.parameters,
        Parameter("N", "N", "normal force", "N", sampled=False),
    )

    def forward(self, speed: Speed) -> Speed:
        return self.N * super().forward(speed)

    backward = forward


def test_a_leaf_N_is_the_weight() -> None:
    model = FrictionModel(OnWeight)
    assert model.parameters == Lorentzian.parameters
    theta = {"F_s": 3.9, "F_c": 1.4, "v_0": 0.08, "m1": bench.M1, "m2": bench.M2, "g": bench.G}
    assert model.force(theta).forward(np.array(0.1)) == pytest.approx(WEIGHT * TRUTH.forward(np.array(0.1)), rel=1e-14)
    assert model.coefficient(theta).forward(np.array(0.1)) == pytest.approx(TRUTH.forward(np.array(0.1)), rel=1e-14)


class Priorless(Lorentzian):
    parameters: ClassVar[tuple[Parameter, ...]] = (
        replace(Lorentzian.parameters[0], prior=None),
        *Lorentzian.parameters[1:],
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Taken:
    k1: float

    parameters: ClassVar[tuple[Parameter, ...]] = (replace(Lorentzian.parameters[0], symbol="k1"),)

    def forward(self, speed: Speed) -> Speed:
        return self.k1 + 0.0 * speed

    backward = forward


@pytest.mark.parametrize(
    ("law", "m2", "text"),
    [
        (Priorless, bench.CAPSULE, "every parameter of the friction law Priorless must have a default prior, F_s has"),
        (Taken, bench.CAPSULE, "symbol of its own, k1: stiffness between rod and capsule, rename it"),
        (Lorentzian, None, "the friction law Lorentzian is in N, and static_friction needs m2, not stated, add m2"),
    ],
)
def test_a_law_that_cannot_be_fitted_is_refused(law: Any, m2: Quantity | None, text: str) -> None:
    own = replace(bench.rig(tilts(np.random.default_rng(0))), m2=m2)
    with pytest.raises(InputError) as caught:
        cid.fit(own, budget=None, friction=law)
    assert text in str(caught.value)


def test_a_kind_that_reads_mu_is_refused_beside_a_law() -> None:
    """A kind of another package that ignores the law. Before: mu and F_s, two unrelated frictions in one fit."""
    kinds = default_registry()
    own = replace(
        kinds["static_friction"], name="spin", make=lambda table, rig, law: (StaticFriction(table, rig, EQUATION_1),)
    )
    registry = Registry((*kinds.kinds, own))
    spin = replace(tilts(np.random.default_rng(0)), kind="spin", label="spin")
    own_rig = bench.rig(spin, pushes(np.random.default_rng(1)))
    with pytest.raises(InputError, match=r"the kind spin reads mu, which Lorentzian replaces"):
        make_experiments(own_rig, registry=registry, friction=Lorentzian)
    # Negative control: eq. (1) by default, and by name.
    for law in (None, CoulombStribeck):
        assert len(make_experiments(own_rig, registry=registry, friction=law)) == 2


def test_the_prior_of_its_parameters_can_be_stated(tmp_path: Path) -> None:
    text = RIG_TOML.replace("[prior]\n", '[prior]\nF_s = { median = 4, factor = 2, unit = "N" }\n')
    folder = write_folder(tmp_path / "rig", text)
    assert cid.read_rig(folder, friction=Lorentzian).priors["F_s"] == Prior("lognormal", 4.0, 2.0)
    with pytest.raises(InputError, match="F_s"):
        cid.read_rig(folder)


def test_any_kind_of_prior_gives_a_start() -> None:
    rows = tuple(replace(row, prior=Prior("halfnormal", 0.0, 2.0)) for row in Lorentzian.parameters[1:])
    law = type("Halfnormal", (Lorentzian,), {"parameters": (Lorentzian.parameters[0], *rows)})
    jax.tree_util.register_dataclass(law)
    rig = bench.rig(*(make(np.random.default_rng(1)) for make in (tilts, pushes)))
    starts = LogPosterior(rig, make_experiments(rig, friction=law)).starts()
    assert [starts[name].centre for name in ("F_s", "F_c", "v_0")] == pytest.approx([3.0, 1.349, 1.349], rel=1e-3)


def test_tilts_sample_what_acts_at_rest() -> None:
    rig = bench.rig(tilts(np.random.default_rng(0)))
    assert LogPosterior(rig, make_experiments(rig, friction=Lorentzian)).names == ("F_s", "tilt_sd")
    (panel,) = cid.fit(rig, budget=None, friction=Lorentzian).comparisons
    assert len(set(panel.curves[0].y)) == 1


class Unregistered(Lorentzian):
    """A law that is no pytree."""


@pytest.mark.parametrize(
    ("law", "rule"),
    [
        (TRUTH, "friction must be a class"),
        (object, "friction must be a class"),
        (Unregistered, "must be a pytree"),
    ],
)
def test_what_is_no_law_is_refused(law: type, rule: str) -> None:
    with pytest.raises(InputError, match=rule):
        FrictionModel(law)


def test_a_sampled_leaf_that_would_be_the_weight_is_refused() -> None:
    rows = (*Lorentzian.parameters[:2], Parameter("N", "1", "exponent", "N", Prior("lognormal", 2.0, 2.0)))
    with pytest.raises(InputError, match="a leaf N of the friction law Power holds the weight"):
        FrictionModel(type("Power", (Lorentzian,), {"parameters": rows}))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Larger:
    """Its force at rest depends on F_c only where F_c exceeds F_s, which is not so at the prior medians."""

    F_s: float
    F_c: float
    parameters: ClassVar = Lorentzian.parameters[:2]

    def forward(self, speed: Any) -> Any:
        return self.F_c + jnp.maximum(self.F_s - self.F_c, 0.0) / (1.0 + speed)

    backward = forward


def test_tilts_sample_every_parameter_that_can_matter_at_rest() -> None:
    assert [row.symbol for row in FrictionModel(Larger).parameters_at_rest] == ["F_s", "F_c"]
    assert [row.symbol for row in FrictionModel(Lorentzian).parameters_at_rest] == ["F_s"]


def test_draws_of_another_law_are_not_resumed(tmp_path: Path) -> None:
    """The store holds the draws of one density; another one starts anew."""
    store = tmp_path / "chains.h5"
    with ChainStore(store, "one") as chains:
        chains.save()
    with ChainStore(store, "one") as chains:
        assert chains.backend("ensemble_0").name == "ensemble_0"
        chains._file.create_group("kept")
        chains.save()
    with ChainStore(store, "one") as chains:
        assert "kept" in chains._file
    with ChainStore(store, "another") as chains:
        assert "kept" not in chains._file


# A contact of one's own in the place of the support spring.


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Hertz(Force):
    """k_h d^p behind the gap G."""

    k_h: float
    p: float
    G: float

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k_h", "N/m^p", "stiffness of the contact", "k_h", Prior("lognormal", 8e5, 10.0)),
        Parameter("p", "1", "power of the penetration", "p", Prior("lognormal", 1.3, 1.3)),
        Parameter("G", "m", "gap", "G", sampled=False),
    )

    @property
    def gap(self) -> Any:
        return self.G

    def elastic(self, d: Any) -> Any:
        return self.k_h * d**self.p


CONTACT = {"k_h": 1e6, "p": 1.5}


def run_on_contact(rng: np.random.Generator, spring: str = "L60") -> Table:
    """0.4 s from rest on the support 1e6 N/m^1.5 d^1.5, by SciPy."""
    time = np.arange(400) / 1000.0
    q = {"m1": bench.M1, "m2": bench.M2, "k1": bench.K1, "c": bench.C, "g": bench.G, "mu": 0.66, "v_s": 0.3}
    q |= {"k2": CONTACT["k_h"], "power": CONTACT["p"], "G": GAP, "P_d": P_D, "Omega": OMEGA}
    states, closings = simulate_scipy(q, time, rtol=1e-9, atol=1e-12, max_step=1e-3)
    assert closings >= 2
    seen = {"x_rel": states[:, 0] - states[:, 2], "x_capsule": states[:, 2]}
    columns = [bench.column(name, values + NOISE * rng.standard_normal(len(time))) for name, values in seen.items()]
    settings = {"spring": spring, "gap": Quantity(GAP), "Omega": OMEGA, "P_d": Quantity(P_D), "start": "stuck"}
    return bench.table("forced_run", [bench.column("time", time), *columns], f"run_{spring}", **settings)


def on_contact(*tables: Table, engine: Literal["exact", "smooth"] = "smooth") -> Rig:
    priors = {"k1": Prior("lognormal", bench.K1, 1.02), "c": Prior("lognormal", bench.C, 1.05)}
    priors |= {"mu": Prior("lognormal", 0.66, 1.02), "v_s": Prior("lognormal", 0.3, 1.1)}
    return replace(bench.rig(*tables, priors=priors), model=ModelChoices(engine=engine))


@pytest.mark.slow
def test_a_fit_recovers_a_contact_of_ones_own(tmp_path: Path) -> None:
    """k_h and p of k_h d^p, with the smoothed engine. The negative control: the linear spring fits worse."""
    rig = on_contact(run_on_contact(np.random.default_rng(3)))
    fitted = cid.fit(rig, budget=None, contact=Hertz)
    point = fitted.point_fit
    assert not [name for name in point.names if name.startswith("k2")]
    for name, truth in CONTACT.items():
        assert abs(point.values[name] - truth) < 4.0 * point.standard_errors[name] < truth, name
    assert [f.level for f in fitted.findings if f.code == "model.engine"] == ["ok"]
    fitted.write(tmp_path / "out")
    assert "a quarter of the widths" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert cid.load(tmp_path / "out").provenance.friction == f"{Hertz.__module__}.Hertz"
    linear = cid.fit(rig, budget=None).point_fit
    assert point.log_posterior.max() - linear.log_posterior.max() > 30.0


def test_the_residuals_of_a_contact_of_ones_own_are_those_of_the_noise() -> None:
    """With the smoothed engine at the truth; not with another power. The parameters are those of the class, without k2."""
    rig = on_contact(run_on_contact(np.random.default_rng(3)))
    (run,) = make_experiments(rig, contact=Hertz)
    assert {"k_h", "p"} < {row.symbol for row in run.parameters}
    assert not {"k2", "G"} & {row.symbol for row in run.parameters}
    truth = {"m1": bench.M1, "m2": bench.M2, "g": bench.G, "k1": bench.K1, "c": bench.C, "mu": 0.66, "v_s": 0.3}
    truth |= {"phase": 0.0, "x_start": 0.0, **CONTACT}
    for power, low, high in ((1.5, 0.9, 1.2), (1.4, 2.0, np.inf)):
        motion = run.motion({**truth, "p": power}, np)  # type: ignore[attr-defined]  # pyright: ignore
        left = np.asarray(motion.x_rel).ravel() - rig.tables[0]["x_rel"]
        assert low < np.std(left) / NOISE < high


def test_a_contact_that_cannot_be_fitted_is_refused() -> None:
    rng = np.random.default_rng(3)
    run = run_on_contact(rng)
    pressed = [bench.column("deflection", np.array([1e-3, 2e-3])), bench.column("force", np.array([2.0, 4.0]))]
    spring = bench.table("support_spring", pressed, spring="L60")
    row = Hertz.parameters[0]
    taken = type("Taken", (Hertz,), {"parameters": (replace(row, symbol="k2"), *Hertz.parameters[1:])})
    for rig, contact, words in (
        (on_contact(run, engine="exact"), Hertz, 'whole powers .* use simulate with model="smooth"'),
        (on_contact(run, replace(run_on_contact(rng, "soft"))), Hertz, "describes one spring"),
        (on_contact(run, spring), Hertz, "support_spring reads k2, which .*contact Hertz replaces"),
        (on_contact(run), Hertz(1e6, 1.5, 1e-3), "contact must be a class of forces"),
        (on_contact(run), Spring, "a row of parameters for its gap"),
        (on_contact(run), taken, "one row of parameters per field"),
    ):
        with pytest.raises(InputError, match=words):
            cid.fit(rig, budget=None, contact=contact)  # type: ignore[arg-type]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Constant(Force):
    """A contact whose force has the symbol of a parameter of ``Lorentzian``."""

    F_s: float
    G: float

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("F_s", "N", "force of the contact", "F_s", Prior("lognormal", 3.0, 5.0)),
        Hertz.parameters[-1],
    )


def test_a_contact_and_a_law_have_symbols_of_their_own() -> None:
    """Before: one value served two unrelated parameters."""
    with pytest.raises(
        InputError, match="a parameter of Constant must have a symbol of its own, F_s: break-away force"
    ):
        FrictionModel(Lorentzian, contact=Constant).check({})
    FrictionModel(Lorentzian, contact=Hertz).check({})


def test_a_contact_takes_batches_of_its_leaves() -> None:
    """The draws of a posterior, an array for each leaf."""
    draws = {"k_h": np.array([1e6, 2e6]), "p": np.array([1.5, 1.4])}
    (force,) = FrictionModel(contact=Hertz).support_at(draws, 1e-3)["forces"]
    np.testing.assert_allclose(force.elastic(1e-4), draws["k_h"] * 1e-4 ** draws["p"], rtol=1e-14)
    assert FrictionModel(contact=Hertz).support_at({}, np.inf) == {"k2": 0.0, "G": np.inf}
