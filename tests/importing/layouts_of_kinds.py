"""Random layouts of exports of every kind: headers of five languages and abbreviations, units in seven ways, other columns.

The true columns are known by their numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

#: Names of each quantity in English, German, French, Spanish and Italian, and abbreviations, separated by ``|``.
NAMES = {
    "time": "Time|Elapsed time|Test time|Zeit|Messzeit|Zeit t|Temps|Temps écoulé|Tiempo|Tiempo transcurrido|Tempo|"
    "Tempo trascorso|t|time|T",
    "x_rel": "Displacement|Relative displacement|Position|Laser displacement|Deflection|Rod displacement|Weg|Auslenkung|"
    "Verschiebung|Wegsensor Weg|Déplacement|Position relative|Élongation|Desplazamiento|Posición|Elongación|"
    "Spostamento|Posizione|Spostamento relativo|x|Disp|Pos|x_rel|s",
    "velocity": "Velocity|Speed|Geschwindigkeit|Vitesse|Velocidad|Velocità|v|velocity",
    "acceleration": "Acceleration|Accel|Acc|Beschleunigung|Accélération|Aceleración|Accelerazione|a|Acceleration of the rod",
    "x_capsule": "Capsule position|Capsule displacement|Housing position|Kapsel Position|Gehäuse Weg|"
    "Position de la capsule|Posición de la cápsula|Posizione della capsula|x_capsule",
    "current": "Current|Coil current|Motor current|Strom|Spulenstrom|Stromstärke|Courant|Courant de la bobine|Intensité|"
    "Corriente|Intensidad de corriente|Corrente|Corrente della bobina|I|I_coil",
    "angle": "Angle|Tilt angle|Inclination|Slope|Critical angle|Winkel|Neigungswinkel|Kippwinkel|Neigung|Haftwinkel|"
    "Angle d'inclinaison|Inclinaison|Ángulo|Ángulo de inclinación|Inclinación|Angolo|Angolo di inclinazione|Pendenza|"
    "theta|alpha",
    "height": "Height|Height of the end|Höhe|Hauteur|Altura|Altezza|h|height",
    "length": "Length|Board length|Länge|Brettlänge|Longueur|Longitud|Lunghezza|L|length",
    "static": "Pull|Pull force|Pulling force|Break-away force|Maximum force|Fmax|F_max|Static friction force|F_s|Peak force|"
    "Friction force|Force|F|Haftreibungskraft|Zugkraft|Losbrechkraft|Haftkraft|Kraft|Maximalkraft|Haftreibung|"
    "Force de traction|Force de frottement statique|Force maximale|Fuerza de tracción|Fuerza de rozamiento estático|"
    "Fuerza|Fuerza máxima|Forza di trazione|Forza di attrito statico|Forza|Forza massima|Attrito statico",
    "normal_force": "Normal force|Normal load|FN|F_N|Normalkraft|Normalkraft FN|Force normale|Fuerza normal|Forza normale|"
    "normal_force",
    "speed": "Speed|Initial speed|Launch speed|v0|Velocity|Geschwindigkeit|Anfangsgeschwindigkeit|Vitesse|"
    "Vitesse initiale|Velocidad|Velocidad inicial|Velocità|Velocità iniziale|v|speed",
    "distance": "Distance|Sliding distance|Stopping distance|Travel|Gleitweg|Bremsweg|Strecke|Weg|Rutschweg|"
    "Distance parcourue|Distance d'arrêt|Distancia|Distancia de frenado|Recorrido|Distanza|Distanza percorsa|d|s|distance",
    "sliding": "Friction force|Sliding force|Kinetic friction force|Fk|F_k|Force|Friction|Gleitreibungskraft|Reibkraft|"
    "Reibungskraft|Kraft|Force de frottement|Force de frottement cinétique|Fuerza de rozamiento|"
    "Fuerza de fricción cinética|Fuerza|Forza di attrito|Forza d'attrito dinamico|F",
    "coefficient": "Friction coefficient|Coefficient of friction|mu|COF|µ|Reibungszahl|Reibwert|Gleitreibungszahl|"
    "Reibungskoeffizient|Coefficient de frottement|Coeficiente de rozamiento|Coefficiente di attrito",
    "motor": "Force|Motor force|F|Load|Kraft|Motorkraft|Force du moteur|Fuerza|Fuerza del motor|Forza|Forza del motore",
    "deflection": "Deflection|Compression|Extension|Spring deflection|Displacement|Federweg|Auslenkung|Verformung|"
    "Déplacement|Flèche|Allongement|Deflexión|Alargamiento|Desplazamiento|Deflessione|Allungamento|Spostamento|x|d",
    "spring": "Force|Spring force|Load|F|Federkraft|Kraft|Force du ressort|Fuerza|Fuerza del muelle|Forza|"
    "Forza della molla",
    "reading": "Reading|Counts|ADC|Raw reading|ADC counts|Messwert|Ablesung|Lecture|Lectura|Lettura|reading",
    "period": "Period|Pulse period|Periode|Periodendauer|Période|Periodo|T|period",
    "f": "Frequency|Drive frequency|Frequenz|Fréquence|Frecuencia|Frequenza|f",
    "periods": "Periods|Number of periods|Cycles|Perioden|Anzahl Perioden|Zyklen|Nombre de périodes|Número de ciclos|"
    "Numero di periodi|n|periods",
}  # fmt: skip
#: How units are written, with their factors to SI.
UNITS: Mapping[str, Mapping[str, float]] = {
    "m": {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "µm": 1e-6},
    "s": {"s": 1.0, "ms": 1e-3, "sec": 1.0},
    "N": {"N": 1.0, "mN": 1e-3, "gf": 9.80665e-3},
    "A": {"A": 1.0, "mA": 1e-3},
    "rad": {"deg": np.pi / 180.0, "°": np.pi / 180.0, "rad": 1.0},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2},
    "m/s^2": {"m/s²": 1.0, "m/s^2": 1.0, "m/s2": 1.0, "g": 9.80665},
    "Hz": {"Hz": 1.0},
    "1": {"1": 1.0, "-": 1.0, "": 1.0},
}
SI = {
    "time": "s", "x_rel": "m", "velocity": "m/s", "acceleration": "m/s^2", "x_capsule": "m", "current": "A", "angle": "rad",
    "height": "m", "length": "m", "static": "N", "normal_force": "N", "speed": "m/s", "distance": "m", "sliding": "N",
    "coefficient": "1", "motor": "N", "deflection": "m", "spring": "N", "reading": "1", "period": "s", "f": "Hz",
    "periods": "1",
}  # fmt: skip
#: Columns of each kind as quantities above; the column of the kind follows ``:`` where it has another name.
SETS: Mapping[str, tuple[str, ...]] = {
    "free_vibration": ("time x_rel", "time velocity", "time acceleration", "time x_rel acceleration"),
    "static_friction": ("angle", "height length", "static:force", "static:force normal_force"),
    "dynamic_friction": ("speed distance",),
    "sliding_friction": ("speed sliding:force", "speed coefficient", "speed sliding:force normal_force"),
    "motor_current": ("current motor:force",),
    "support_spring": ("deflection spring:force",),
    "transducer": ("reading spring:force",),
    "forced_run": ("time x_rel current", "time x_rel x_capsule", "time acceleration:acceleration_rod", "time x_rel"),
    "progression": ("period periods distance", "f periods distance"),
}
#: Ways to write a unit: around or behind the name, in a row of its own, not at all.
WAYS = ("[]", "()", "_", " / ", " in ", "row", "")
TRIALS = ("Trial", "No", "Run", "Versuch", "Nr", "Essai", "Prueba", "Prova", "#")
OTHERS = ("Temperature (°C)", "Temperatur [°C]", "Mass [kg]", "Masse (g)", "Voltage (V)", "Humidity (%)")
#: Second columns of the same quantity, which another guess takes.
RIVALS: Mapping[str, tuple[str, ...]] = {
    "static": ("Fk", "Sliding force", "Gleitreibungskraft", "Force de frottement cinétique"),
    "sliding": ("Fmax", "Static friction force", "Haftreibungskraft", "Fuerza máxima"),
}


@dataclass(frozen=True)
class Layouted:
    """One export: its bytes, its kind, its readings in SI by column, and whether its headers name quantity and unit alone."""

    file: str
    content: bytes
    kind: str
    columns: Mapping[str, np.ndarray]
    named: bool


def _readings(rng: np.random.Generator, kind: str, quantity: str, rows: int) -> np.ndarray:
    """Readings of a quantity, SI, (rows,)."""
    k = np.arange(rows)
    record = kind in ("free_vibration", "forced_run")
    if quantity == "time":
        return 2e-3 * k
    if record:
        size = {"x_rel": 3e-3, "velocity": 0.3, "acceleration": 30.0, "x_capsule": 2e-3, "current": 1.5}[quantity]
        decay = np.exp(-4.0 * k / rows) if kind == "free_vibration" else 1.0
        return size * decay * np.cos(
            2 * np.pi * 20.0 * k / rows + rng.uniform(0, 6)
        ) + 0.002 * size * rng.standard_normal(rows)
    if quantity in ("length", "periods") or (quantity in ("normal_force", "speed", "f") and rng.random() < 0.2):
        return np.full(rows, {"length": 0.6, "periods": 100.0, "normal_force": 9.1, "speed": 0.05, "f": 20.0}[quantity])
    low, high = {
        "angle": (0.5, 0.65), "height": (0.2, 0.3), "static": (2.0, 9.0), "normal_force": (5.0, 25.0), "speed": (0.1, 0.6),
        "distance": (5e-3, 0.1), "sliding": (1.0, 4.0), "coefficient": (0.3, 0.5), "current": (0.2, 2.0),
        "motor": (0.5, 4.0), "deflection": (1e-4, 1e-3), "spring": (1.0, 20.0), "reading": (2e3, 9e5),
        "period": (0.03, 0.08), "f": (10.0, 30.0),
    }[quantity]  # fmt: skip
    return np.sort(rng.uniform(low, high, rows))


def _header(name: str, unit: str, way: str) -> str:
    """The header of a column in one of the ``WAYS``."""
    if way in ("row", "") or not unit:
        return name
    if way in ("[]", "()"):
        return f"{name} {way[0]}{unit}{way[1]}"
    return f"{name}{way}{unit}"


def layout(kind: str, seed: int, unknown: bool = False) -> Layouted:
    """A random layout of a kind; ``unknown``: one of its columns has a name that says nothing."""
    rng = np.random.default_rng([seed, sorted(SETS).index(kind)])
    pick = lambda options: options[int(rng.integers(len(options)))]  # noqa: E731
    rows = 400 if kind in ("free_vibration", "forced_run") else int(rng.integers(5, 13))
    way = pick(WAYS[:-1]) if rng.random() < 0.85 else ""
    columns, headers, units = dict[str, np.ndarray](), list[str](), list[str]()
    written = list[np.ndarray]()
    named = bool(way)
    for number, wanted in enumerate(wanteds := pick(SETS[kind]).split()):
        quantity, _, column = wanted.partition(":")
        values = _readings(rng, kind, quantity, rows)
        unit = pick(sorted(UNITS[SI[quantity]]))
        cells = np.array([float(f"{value:.8g}") for value in values / UNITS[SI[quantity]][unit]])
        names = NAMES[quantity].split("|")
        name = pick([one for one in names if one not in headers])
        name = "Sig7" if unknown and number == seed % len(wanteds) else name
        columns[column or quantity] = cells * UNITS[SI[quantity]][unit]
        headers.append(_header(name, unit, way))
        units.append("-" if way == "row" and unit == "1" else unit)  # a row that begins with a number is a reading
        written.append(cells)
        if quantity in RIVALS and rng.random() < 0.3:
            headers.append(_header(pick(RIVALS[quantity]), unit, way))
            units.append(unit)
            written.append(np.round(cells * rng.uniform(0.4, 0.6), 6))
    if rng.random() < 0.15:  # a second column of the last quantity: the headers do not say which
        named = False
        headers.append(headers[-1].replace(name, f"{name} 2", 1))
        units.append(units[-1])
        written.append(written[-1] * 0.8 + 0.01 * np.max(written[-1]) * rng.random(rows))
    if rng.random() < 0.4:
        headers.append(pick(OTHERS))
        units.append("")
        written.append(np.round(20.0 + rng.random(rows), 2) if rng.random() < 0.5 else np.full(rows, 0.53))
    if "static:force" in SETS[kind] and "angle" not in columns and rng.random() < 0.3:  # a board at one angle
        headers.append(_header(pick(NAMES["angle"].split("|")), "deg", way))
        units.append("deg")
        written.append(np.full(rows, 15.0))
    if rng.random() < 0.4:
        headers.append(pick(TRIALS))
        units.append("")
        written.append(np.arange(1.0, rows + 1))
    order = rng.permutation(len(headers)).tolist()
    texts = bool(rng.random() < 0.2)  # a column of remarks at the end
    separator, decimal = pick((",.", ";.", ";,", "\t.", "\t,"))
    lines = [[*(headers[k] for k in order), *["Remark"] * texts]]
    lines += [[*(units[k] for k in order), *[""] * texts]] if way == "row" else []
    lines += [
        [*(f"{written[k][row]:.10g}".replace(".", decimal) for k in order), *["ok"] * texts] for row in range(rows)
    ]
    content = "\n".join(separator.join(line) for line in [*lines, []])
    return Layouted(f"{kind}_{seed}.csv", content.encode(), kind, columns, named)
