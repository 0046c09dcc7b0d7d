"""A valid rig folder for tests, with every kind and every key once."""

from pathlib import Path

RIG_TOML = """\
# A rig with every kind of experiment.
[rig]
name = "twin"
synthetic = true
m1 = { value = 110, sd = 0.5, unit = "g" }
m2 = { value = 0.530, sd = 0.001, unit = "kg" }
g = { value = 9.81, unit = "m/s^2" }

[prior]
k1 = { median = 1.5, factor = 3, unit = "kN/m" }
"k2[L60]" = { median = 20, factor = 10, unit = "kN/m" }
tilt_sd = { scale = 1, unit = "deg" }
push_scatter = { scale = 0.05 }

[[experiment]]
kind = "free_vibration"
file = "free_vibration_1.csv"
start = { value = 0.0, unit = "s" }
stop = { value = 9, unit = "ms" }
capsule = "held"
damping = "dry"
smoothing_window = { value = 5, unit = "ms" }
x_rel_sd = { value = 0.02, unit = "mm" }
x_rel_resolution = { value = 1, unit = "um" }

[[experiment]]
kind = "static_friction"
file = "static_friction.csv"

[[experiment]]
kind = "static_friction"
file = "boards/lifted.csv"
label = "lifted"
length_is = "board"

[[experiment]]
kind = "dynamic_friction"
file = "dynamic_friction.csv"
speed_sd = { value = 5, unit = "mm/s" }

[[experiment]]
kind = "sliding_friction"
file = "sliding_friction.csv"

[[experiment]]
kind = "motor_current"
file = "motor_current.csv"
sd_ratio = { value = 3, unit = "N/A" }

[[experiment]]
kind = "support_spring"
spring = "L60"
length = { value = 60, sd = 0.5, unit = "mm" }
file = "support_spring_L60.csv"

[[experiment]]
kind = "forced_run"
spring = "L60"
gap = { value = 1.0, sd = 0.02, unit = "mm" }
Omega = { value = 34.56, unit = "rad/s" }
P_d = { value = 4.0, sd = 0.1, unit = "N" }
file = "run_01.csv"

[[experiment]]
kind = "transducer"
file = "load_cell.csv"

[[experiment]]
kind = "progression"
file = "progression.csv"
drive = "pulses"
P_on = { value = -1.25, sd = 0.5, unit = "N" }
lag = { value = 5, sd = 2, unit = "ms" }
"""

TABLES = {
    "free_vibration_1.csv": "time [ms],x_rel [mm]\n"
    + "".join(f"{i},{x}\n" for i, x in enumerate((2, 1.5, 0.5, -0.5, -1, -0.8, -0.2, 0.3, 0.5, 0.4))),
    "static_friction.csv": "angle [deg]\n33.1\n33.6\n33.2\n",
    "boards/lifted.csv": "height [mm];length [mm]\n331,5;600\n329;600\n",
    "dynamic_friction.csv": "speed [m/s]\tdistance [mm]\n0.15\t1.9\n0.5\t25\n",
    "sliding_friction.csv": "speed [m/s],coefficient [1]\n0.1,0.56\n0.3,0.45\n",
    "motor_current.csv": "force [N],current [A]\n0.5,0.26\n1,0.51\n1.5,0.74\n",
    "support_spring_L60.csv": "deflection [mm],force [N]\n0,0.01\n0.5,9.4\n1,19\n",
    "load_cell.csv": "reading [1],force [N]\n3,0\n227,1\n452,2\n",
    "progression.csv": "period [ms],duty [%],periods [1],distance [cm]\n60,30,100,4.5\n80,30,50,-2.1\n",
    "run_01.csv": "time [s],x_rel [mm],acceleration_rod [m/s^2]\n"
    + "".join(f"{i / 100},{i % 3},{i % 5}\n" for i in range(9)),
}


def write_folder(folder: Path, rig_toml: str = RIG_TOML, tables: dict[str, str | bytes] | None = None) -> Path:
    """Write ``rig.toml`` and the tables ``TABLES``, replaced by those of ``tables``; return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(rig_toml, encoding="utf-8")
    for name, content in {**TABLES, **(tables or {})}.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    return folder
