"""capsule-id: system identification for the vibro-impact capsule.

The pipeline; each stage makes a frozen value for the next one:

    rig folder      rig.toml and its tables
    Rig             what was measured, in SI, checked and hashed               read_rig
    experiments     a value per table: model, residuals, paper's estimate      capsule_id.experiments
    log-posterior   likelihoods of all experiments plus log-prior              capsule_id.inference.target
    point fit       maximum of the posterior, standard errors                  capsule_id.inference.fit
    posterior       draws of emcee, convergence diagnostics                    capsule_id.inference.sampling
    checks          findings of level ok, warn or fail                         capsule_id.inference.checks
    report          parameters.json, posterior.nc, report.html                 Fit.write

    rig = capsule_id.read_rig("data/")
    result = capsule_id.fit(rig, seed=0)
    result.write("results/twin")                             # capsule_id.load("results/twin") gives it back
    result["k1"].value, result["k1"].sd, result["k1"].trust, result.verdict, result.plot_corner()

Glossary:

    capsule, rod          outer mass m2 on the ground; inner mass m1, driven by the motor
    x_rel                 X1 - X2, displacement of the rod relative to the capsule
    gap                   distance G from the rod to the support spring
    contact               interval with x_rel >= G
    stick, slip           the capsule is at rest; the capsule slides
    excitation period     2 pi / Omega, the period of the drive
    initial condition     positions and velocities at the first sample
    sampling rate         samples per second of a record, Hz
    residual              measured value minus predicted value
    noise level           standard deviation of the noise of one channel
    scatter               standard deviation between repeated tests
    standard error        standard deviation of an estimate
    prior, posterior      distribution of the parameters before and after the data
    credible interval     range that holds a parameter with a stated posterior probability
    point fit             the maximum of the posterior
    starting point        parameter values from which a search for the maximum starts
    local maximum         a maximum of the posterior that is not the highest one
    cost                  half the sum of squared standardised residuals
    bench, run            tests of single parts; a record of the capsule under a drive
    truth                 the parameters that computed a synthetic rig folder

The guide, guide/*.md beside this file, describes experiments, results, the capsule model, maps and extensions.
A public name is imported at its first use, so ``import capsule_id`` does not import JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

# ruff: noqa: I001  (an import a module)
if TYPE_CHECKING:
    __version__: str
    from capsule_id.api import (
        Fit as Fit,
        ParameterValue as ParameterValue,
        compare as compare,
        fit as fit,
        load as load,
        read_rig as read_rig,
    )
    from capsule_id.errors import InputError as InputError
    from capsule_id.importing import propose_entry as propose_entry
    from capsule_id.inference.compare import compare_models as compare_models, compare_points as compare_points
    from capsule_id.motions.response import Response as Response, Settling as Settling, response as response
    from capsule_id.motions.sweep import (
        continuation as continuation,
        diagram as diagram,
        draws_diagram as draws_diagram,
        motion_map as motion_map,
    )
    from capsule_id.physics.drives import Pulses as Pulses, RecordedDrive as RecordedDrive, RodMotion as RodMotion
    from capsule_id.physics.model import (
        CapsuleParameters as CapsuleParameters,
        Excitation as Excitation,
        Status as Status,
        Trajectory as Trajectory,
        status_message as status_message,
    )
    from capsule_id.physics.simulation import (
        energy_balance as energy_balance,
        simulate as simulate,
        smoothing_bias as smoothing_bias,
    )
    from capsule_id.physics.smooth.engine import Smoothing as Smoothing
    from capsule_id.synthetic import (
        RobotDesign as RobotDesign,
        synthesize as synthesize,
        synthesize_robot as synthesize_robot,
    )

#: The same names by module, where they are imported at their first use.
_PUBLIC = {
    "api": ("Fit", "ParameterValue", "compare", "fit", "load", "read_rig"),
    "errors": ("InputError",),
    "importing": ("propose_entry",),
    "inference.compare": ("compare_models", "compare_points"),
    "motions.response": ("Response", "Settling", "response"),
    "motions.sweep": ("continuation", "diagram", "draws_diagram", "motion_map"),
    "physics.drives": ("Pulses", "RecordedDrive", "RodMotion"),
    "physics.model": ("CapsuleParameters", "Excitation", "Status", "Trajectory", "status_message"),
    "physics.simulation": ("energy_balance", "simulate", "smoothing_bias"),
    "physics.smooth.engine": ("Smoothing",),
    "synthetic": ("RobotDesign", "synthesize", "synthesize_robot"),
}
_MODULE_OF = {name: f"capsule_id.{module}" for module, names in _PUBLIC.items() for name in names}
__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]  (the imports above declare the names)


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use; the version is that of the installed distribution."""
    if name == "__version__":
        from importlib.metadata import version

        return version("capsule-id")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULE_OF, "__version__"])
