"""Reads names and units from headers, as loggers, spreadsheets and students write them."""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from itertools import pairwise

from capsule_id.rig.units import UnitError, factor_to_si

_WORDS = {
    "time": "time t zeit messzeit temps tiempo tempo elapsed timestamp clock value duree instant istante "
    "instante zeitstempel",
    "x_rel": "relative displacement disp deflection position pos x s weg laser distance abstand auslenkung "
    "ausschlag verschiebung elongation desplazamiento deplacement spostamento posicion posizione "
    "elongacion elongazione distancia distanza amplitude amplitudes peak",
    "x_capsule": "capsule kapsel housing capsula gehause boitier carcasa",
    "x_base": "base shaker basis tisch",
    "acceleration": "acceleration acc accel accelerometer beschleunigung aceleracion accelerazione a beschl",
    "velocity": "velocity speed v geschwindigkeit vitesse velocidad velocita vel geschw",
    "current": "current strom stromstarke i courant corriente corrente intensite intensidad amps coil",
    "force": "force kraft f load friction weight pull fs fk fr fmax fstat fkin reibung fuerza forza "
    "frottement friccion rozamiento attrito traction traccion trazione last charge carga carico "
    "thrust tension effort empuje spinta schub",
    "normal_force": "normal normalkraft normale fn load weight last auflast gewicht charge poids carga peso "
    "carico anpresskraft",
    "angle": "angle tilt winkel inclination incline slope neigung steigung theta alpha angulo angolo "
    "inclinaison inclinacion inclinazione pente pendiente pendenza ang phi θ α φ",
    "height": "height hoehe hohe h hauteur altura altezza rise elevation",
    "length": "length laenge lange l board longueur longitud lunghezza brett planche tabla tavola",
    "speed": "speed velocity v v0 geschwindigkeit vitesse velocidad velocita vel geschw",
    "distance": "distance dist travel slide strecke weg x d s displacement disp distanz distancia distanza "
    "recorrido percorso parcours deplacement desplazamiento spostamento path spazio espacio",
    "deflection": "deflection displacement disp compression extension verformung weg x d s federweg auslenkung "
    "deplacement fleche allongement desplazamiento deflexion alargamiento spostamento deflessione "
    "allungamento dehnung stauchung einfederung elongation enfoncement compresion compressione "
    "deformation deformazione deformacion flexion dx δx",
    "coefficient": "coefficient mu μ cof reibwert reibzahl reibungszahl koeffizient coeficiente coefficiente "
    "friction frottement rozamiento friccion attrito beiwert reibbeiwert",
    "period": "period t periode periodendauer periodo",
    "f": "frequency freq frequenz frequence frecuencia frequenza",
    "duty": "duty tau tastgrad tastverhaltnis",
    "periods": "periods n cycles perioden periodes periodos periodi zyklen ciclos cicli pulses impulse "
    "impulses pulsos impulsi",
    "session": "session day",
    "uncertainty": "sd std stdev sigma err error unc uncertainty fehler abweichung unsicherheit ecart "
    "incertitude desviacion incertidumbre errore deviazione incertezza",
    "break-away": "fs fmax fstat max peak static statique statisch estatic maxim massim break_away breakaway "
    "haftre haftkr losbrech losreiss limit adheren arranque distacco demarrage",
    "no pull": "fn normal coefficient koeffizient coeficiente beiwert",
    "sliding": "fk fkin sliding kinetic gleit glissement cinetique cinetic dynamic dynamique dinamic "
    "deslizamiento scorrimento",
    "reading": "reading counts adc raw cell messwert ablesung lecture lectura lettura signal output anzeige "
    "digits",
}  # fmt: skip
#: Words for a column of a kind, without accents, by its name; a column is always known by its own name too. Words for
#: the uncertainty of any, and parts of the names of frictions.
WORDS: Mapping[str, tuple[str, ...]] = {name: tuple(words.split()) for name, words in _WORDS.items()}
#: Names of the same quantity.
SAME = {"acceleration_rod": "acceleration", "slope": "angle"}
#: Fewest letters of a word that can end a compound, and shorter words that can.
SHORTEST_HEAD, SHORT_HEADS = 5, ("weg", "zeit")
#: Units of headers that state none: names that programs give to their columns, and a normal force, or one in N.
UNITS_OF_NAMES: Mapping[str, str | None] = {"X_Value": "s", "F_N": None}
#: Other ways to write a unit.
SPELLINGS: Mapping[str, str] = {
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "sek": "s", "sekunden": "s", "msec": "ms", "usec": "us",
    "millimeter": "mm", "millimetre": "mm", "meter": "m", "metre": "m", "m/s2": "m/s^2", "m/s**2": "m/s^2",
    "newton": "N", "amp": "A", "amps": "A", "ampere": "A", "degree": "deg", "degrees": "deg", "grad": "deg",
    "seconde": "s", "secondes": "s", "segundos": "s", "secondi": "s", "meters": "m", "metres": "m", "metros": "m",
    "metri": "m", "newtons": "N", "grados": "deg", "gradi": "deg", "degrés": "deg", "counts": "1", "count": "1", "-": "1",
}  # fmt: skip
_BRACKETS = re.compile(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*")
_INSIDE = re.compile(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*(\S.*)")
_SEPARATED = re.compile(r"(.*?)(?:\s+/\s*|\s*,\s+|\s+in\s+)([^\s/,]\S*)")


def unit_of(text: str, dimensions: Sequence[str]) -> str | None:
    """The unit that ``text`` writes, if it has one of the ``dimensions`` (SI units); else None."""
    text = text.strip()
    written = SPELLINGS.get(text.lower(), text)
    for si in dimensions:
        # A lone g beside an acceleration is standard gravity.
        candidate = "g_n" if written in ("g", "G") and si == "m/s^2" else written
        try:
            factor_to_si(candidate, si)
        except UnitError:
            continue
        return candidate
    return None


def name_and_unit(header: str, dimensions: Sequence[str]) -> tuple[str, str | None]:
    """Name and text of the unit of a header; None where it states none.

    ``dimensions`` are the SI units that columns may have. A suffix such as ``_mm`` or ``/mm`` counts only if it is such a
    unit, and so do brackets before further words, as in ``Force (N) Run 5``.
    """
    if header in UNITS_OF_NAMES:
        return header, UNITS_OF_NAMES[header]
    for pattern in (_BRACKETS, _SEPARATED):
        found = pattern.fullmatch(header)
        if found:
            return found[1], next(group for group in found.groups()[1:] if group is not None).strip()
    if unit_of(header, dimensions) is not None:
        return header, None
    found = _INSIDE.fullmatch(header)
    if found and unit_of(text := found[2] or found[3] or "", dimensions) is not None:
        return f"{found[1]} {found[4]}", text.strip()
    for mark in ("_", "/"):
        parts = header.split(mark)
        for k in range(1, len(parts)):
            suffix = mark.join(parts[k:])
            if unit_of(suffix, dimensions) is not None:
                return mark.join(parts[:k]), suffix
    return header, None


def _bare(name: str) -> str:
    """Small letters without their accents, ``_`` between words."""
    marks = unicodedata.normalize("NFKD", name.strip().lower())
    return re.sub(r"[\W_]+", "_", "".join(mark for mark in marks if not unicodedata.combining(mark)))


def fits_name(name: str, column: str) -> float:
    """3 for the name of the column itself, 2.5 for words of it alone, 2 with others, 1 for a compound that ends with one.

    0 for another name, -1 for an uncertainty. ``Federkraft`` ends with ``kraft``.
    """
    bare = _bare(name)
    words = [word for word in bare.split("_") if word]
    if any(word in WORDS["uncertainty"] or word[0] in "\u03c3\u00b1" for word in words):
        return -1
    if bare == column.lower():
        return 3
    known = WORDS.get(SAME.get(column, column), ())
    if any(word in (*words, *map("".join, pairwise(words))) for word in known):  # F_N is FN
        return 2.5 if set(words) <= set(known) or "".join(words) in known else 2
    heads = (word for word in known if len(word) >= SHORTEST_HEAD or word in SHORT_HEADS)
    return float(any(word.endswith(tuple(heads)) for word in words))


def meaning(name: str, column: str, meant: Sequence[str]) -> int:
    """1 for the name of the friction that is ``meant`` first, at break-away or while it slides, -1 for another, 0 for any."""
    if column == "normal_force":
        return 0
    bare = _bare(name)
    words = (*bare.split("_"), *map("".join, pairwise(bare.split("_"))))
    told = [
        any(part in (bare if len(part) >= SHORTEST_HEAD else words) for part in WORDS[which])
        for which in meant[: 3 if column == "force" else 2]
    ]
    return told[0] - any(told[1:]) if told else 0


def is_units_row(row: Sequence[str], dimensions: Sequence[str]) -> bool:
    """Whether at least half of the cells of a header row are units; empty cells do not count."""
    cells = [cell for cell in row if cell.strip(" []()")]
    units = [cell for cell in cells if unit_of(cell.strip(" []()"), dimensions) is not None]
    return bool(cells) and 2 * len(units) >= len(cells)
