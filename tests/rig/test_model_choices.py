"""``[model]`` of rig.toml: words, places of errors, remedies that work, masses that a free parameter needs."""

from pathlib import Path

import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.kind import make_experiments
from capsule_id.parameters import TABLE
from capsule_id.rig.model import ModelChoices
from capsule_id.rig.schema import OPTIONAL
from tests.rig.faults import assert_fault, fault_of

HEAD = '[rig]\nname = "slide"\n'
TABLE_OF_POINTS = '\n[[experiment]]\nkind = "sliding_friction"\nfile = "slide.csv"\n'
MASSES = 'm1 = { value = 0.11, unit = "kg" }\nm2 = { value = 0.53, unit = "kg" }\n'


def write(folder: Path, model: str, head: str = HEAD) -> Path:
    """A folder with one table of sliding points; ``model`` are the lines of ``[model]``."""
    (folder / "slide.csv").write_text("speed [m/s],coefficient [1]\n0.01,0.7\n0.1,0.6\n0.3,0.5\n0.6,0.45\n0.9,0.4\n")
    (folder / "rig.toml").write_text(f"{head}\n[model]\n{model}\n{TABLE_OF_POINTS}")
    return folder


@pytest.mark.parametrize(
    ("model", "rule", "instead"),
    [
        ("‸fre = []", "unknown key, 'fre', write free", "free = []"),
        ('free = ‸"ratio"', "free must be a list of words", 'free = ["ratio"]'),
        ('free = ‸["ratoi"]', "free must name optional parameters, 'ratoi', write ratio", 'free = ["ratio"]'),
        ('free = ‸["ratio", "ratio"]', "must name each parameter once", 'free = ["ratio"]'),
        (
            "free = ‸[7]",
            "free must name optional parameters, 7, write some of mu_back ratio viscous k_cubic",
            "free = []",
        ),
        ('reaction = ‸"floor"', "reaction must be", 'reaction = "capsule"'),
        ('friction = ‸"coulomb"', "friction must be", 'friction = "constant"'),
        ('engine = ‸"smoothed"', "engine must be", 'engine = "exact"'),
        ('engine = ‸"smooth"', "needs an experiment that integrates eqs. (1) and (2): a run, or forward", ""),
        ('friction = "constant"\nfree = ‸["ratio"]', "constant friction has no ratio", 'friction = "constant"'),
        ('free = ‸["viscous"]', "free viscous needs m1, because slide", "free = []"),
    ],
)
def test_a_fault_has_its_place_and_its_remedy_works(tmp_path: Path, model: str, rule: str, instead: str) -> None:
    place = (4 + model[: model.index("‸")].count("\n") + 1, model[: model.index("‸")].split("\n")[-1])
    folder = write(tmp_path, model.replace("‸", ""))
    assert_fault(fault_of(folder), folder / "rig.toml", (place[0], len(place[1]) + 1), rule)
    read_rig(write(tmp_path, instead))


def test_choices_select_the_sampled_parameters(tmp_path: Path) -> None:
    assert OPTIONAL == ("mu_back", "ratio", "viscous", "k_cubic", "c2", "lag")
    assert all(TABLE[symbol].prior_can_be_stated for symbol in OPTIONAL)
    expected = {
        "": ["mu", "v_s"],
        'friction = "constant"': ["mu"],
        'free = ["viscous", "ratio"]': ["mu", "v_s", "ratio", "viscous"],
    }
    for model, symbols in expected.items():
        rig = read_rig(write(tmp_path, model, HEAD + MASSES))
        (experiment,) = make_experiments(rig)
        assert [row.symbol for row in experiment.parameters if row.physical] == symbols
    assert rig.model == ModelChoices("stribeck", ("ratio", "viscous"))


def test_a_free_parameter_that_nothing_measures_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path, 'free = ["ratio"]')
    toml = folder / "rig.toml"
    toml.write_text(toml.read_text().replace(TABLE_OF_POINTS, TABLE_OF_POINTS.replace("sliding", "static")))
    (folder / "slide.csv").write_text("angle [deg]\n33\n34\n33.5\n")
    with pytest.raises(InputError, match="an experiment must measure ratio"):
        make_experiments(read_rig(folder))
    toml.write_text(toml.read_text().replace('free = ["ratio"]', "free = []"))
    make_experiments(read_rig(folder))
