"""Guesses the layout of an export, the quantities and units of its columns, and a column map of one kind."""

import json
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import chain, groupby, pairwise, product, takewhile
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from capsule_id.errors import InputError, collecting, printable
from capsule_id.parameters import ROUNDING
from capsule_id.rig.filters import FEWEST_SAMPLES, clock_starts
from capsule_id.rig.formats import EXPORTS, TEXTS, suffix_of
from capsule_id.rig.formats.layouts import delimiter_of, is_number, is_wanted, split_bare
from capsule_id.rig.formats.raw import (
    COMPRESSED,
    NO_READING,
    RATE_NAMES,
    STEP_NAMES,
    Export,
    Layout,
    TextFile,
    lines_of,
)
from capsule_id.rig.formats.text import is_row, is_stamp, number_in, seconds_of_stamps
from capsule_id.rig.schema import KindRule
from capsule_id.rig.times import evened
from capsule_id.rig.toml import LARGEST, shown
from capsule_id.rig.units import STAMP, UNKNOWN, UnitError, factor_to_si, scale, symbol_named
from capsule_id.views import counted

# headers: Reads names and units from headers, as loggers, spreadsheets and students write them.


#: Words for a column of a kind, without accents, by its name; a column is always known by its own name too. Words for
#: the uncertainty of any, and parts of the names of frictions.
WORDS: Mapping[str, tuple[str, ...]] = {name: tuple(words.split()) for name, words in {
    "time": "time t zeit messzeit temps tiempo tempo elapsed timestamp clock millis micros value duree instant istante "
    "instante zeitstempel datetime datumzeit uhrzeit heure hora ora",
    "x_rel": "relative displacement disp deflection position pos x s weg laser distance abstand auslenkung "
    "ausschlag verschiebung elongation desplazamiento deplacement spostamento posicion posizione "
    "elongacion elongazione distancia distanza amplitude amplitudes peak",
    "x_capsule": "capsule kapsel housing capsula gehause boitier carcasa",
    "x_base": "base shaker basis tisch",
    "acceleration": "acceleration acc accel accelerometer beschleunigung aceleracion accelerazione a beschl gfx gfy gfz",
    "velocity": "velocity speed v v0 geschwindigkeit vitesse velocidad velocita vel geschw",
    "current": "current strom stromstarke i courant corriente corrente intensite intensidad amps coil",
    "force": "force kraft f load friction weight pull fs fk fr fmax fstat fkin reibung fuerza forza "
    "frottement friccion rozamiento attrito traction traccion trazione last charge carga carico "
    "thrust tension effort empuje spinta schub",
    "normal_force": "normal normalkraft normale fn load weight last auflast gewicht charge poids carga peso "
    "carico anpresskraft",
    "mass": "mass masse masa massa",
    "angle": "angle tilt winkel inclination incline slope neigung steigung theta alpha angulo angolo "
    "inclinaison inclinacion inclinazione pente pendiente pendenza ang phi θ α φ",
    "height": "height hoehe hohe h hauteur altura altezza rise elevation",
    "length": "length laenge lange l board longueur longitud lunghezza brett planche tabla tavola",
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
    "direction": "direction dir richtung sens sentido verso direzione direccion",
    "backward": "backward backwards back reverse ruckwarts zuruck ruck arriere retour atras vuelta indietro ritorno",
    "surface": "surface surfaces track material oberflache untergrund bahn belag revetement superficie piste pista "
    "superficies materiale matiere materiau werkstoff",
    "uncertainty": "sd std stdev sigma err error unc uncertainty fehler abweichung unsicherheit ecart "
    "incertitude desviacion incertidumbre errore deviazione incertezza",
    "break-away": "fs fmax fstat max peak static statique statisch estatic maxim massim break_away breakaway "
    "haftre haftkr losbrech losreiss limit adheren arranque distacco demarrage",
    "no pull": "fn normal coefficient koeffizient coeficiente beiwert",
    "sliding": "fk fkin sliding kinetic gleit glissement cinetique cinetic dynamic dynamique dinamic "
    "deslizamiento scorrimento",
    "reading": "reading counts adc raw cell messwert ablesung lecture lectura lettura signal output anzeige "
    "digits",
}.items()}  # fmt: skip
#: Columns of texts that tell the rows of a friction table apart.
LABELS = ("surface", "direction")
#: What makes a mass a force.
HANGS = "the weight, if this mass hangs there"
#: Names of the same quantity.
SAME = {"acceleration_rod": "acceleration", "slope": "angle", "speed": "velocity"}
#: Fewest letters of a word that can end a compound, and shorter words that can.
SHORTEST_HEAD, SHORT_HEADS = 5, ("weg", "zeit")
#: How well a name with a number fits, such as x1: it is one of several.
NUMBERED = 1.5
#: Units of headers that state none: names that programs give to their columns, and a normal force, or one in N.
UNITS_OF_NAMES: Mapping[str, str | None] = {"X_Value": "s", "F_N": None, "gFx": "g_n", "gFy": "g_n", "gFz": "g_n"}
_BRACKETS = re.compile(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*")
_INSIDE = re.compile(r"(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))\s*(\S.*)")
_SEPARATED = re.compile(r"(.*?)(?:\s+/\s*|\s*,\s+|\s+in\s+)([^\s/,]\S*)")


def unit_of(text: str, dimensions: Sequence[str]) -> str | None:
    """The unit that ``text`` writes, if it has one of the ``dimensions`` (SI units); else None."""
    written = symbol_named(text.strip())
    for si in dimensions:
        # A lone g beside an acceleration is standard gravity.
        candidate = {"g": "g_n", "G": "g_n", "mg": "mg_n"}.get(written, written) if si == "m/s^2" else written
        with suppress(UnitError):
            factor_to_si(candidate, si)
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
        for place in re.finditer(mark, header):
            above, _, below = (unit := header[place.end() :]).partition("/")
            if above != below and unit_of(unit, dimensions) is not None:  # F_N/N is F_N in N
                return header[: place.start()], unit
    return header, None


def _bare(name: str) -> str:
    """Small letters without their accents, ``_`` between words."""
    marks = unicodedata.normalize("NFKD", name.strip().lower())
    return re.sub(r"[\W_]+", "_", "".join(mark for mark in marks if not unicodedata.combining(mark)))


def fits_name(name: str, column: str) -> float:
    """3 for the name of the column itself, 2.5 for words of it alone, 2 with others, less for x1 and for compounds.

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
    if any(word.rstrip("0123456789") in known for word in words):
        return NUMBERED
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


# layout: Finds the layout of an export: the first row of readings, missing markers, headers, units, a stated sampling
# rate.


#: Largest share of missing readings in a column of readings.
MOST_MISSING = 0.5
_BEGINNING, _MOST_LINES = 100_000, 3_000  # bytes and lines in which the first row of readings is searched
_MOST_TITLES = 100  # lines
_FACTOR = re.compile(r"[*×]\s*[0-9][0-9.,]*|[0-9]\s*[*×]|\sx\s*(?:10+|0[.,][0-9]+)\b")
_MOST_RUNS = 500_000  # of lines with equal cells, in which blocks of readings are searched
_DIGITS = re.compile(rb"[0-9]+")
#: Separator and number of cells of a line whose first cell is a number; None for any other line.
Cells = tuple[str | None, int] | None
#: Cells of successive rows, their number, and the lines of the first and the last one, counted from 1.
Run = tuple[Cells, int, int, int]
#: Columns of readings and of single numbers, and the errors of all others, by index.
Readings = tuple[dict[int, np.ndarray], dict[int, float], dict[int, InputError]]
#: Largest relative difference of a rate from the inverse of a stored step.
SAME_RATE = 1e-3
#: A number of samples a second, and words of the lines that state one.
_RATE = re.compile(r"([0-9][0-9.,'\u2019 \u00a0\u202f]*(?:e[+-]?[0-9]+)?)\s*(k?)(?:Hz|S/s)\b", re.IGNORECASE)
_SAMPLING = re.compile(
    r"sampl|\brate\b|abtast|mess(?:rate|freq)|acqui|[eé]chantillon|muestreo|campion|S/s|\bf_?s\b", re.IGNORECASE
)


@dataclass(frozen=True)
class FoundLayout:
    """An export with its layout.

    Attributes
    ----------
    export : the file as read with ``layout``
    layout : what ``rig.toml`` must state
    names, units : of every column, "" where the file has none
    columns : index of a column of readings -> (rows,) numbers, NaN where missing
    unread : index of any other column -> the error at its first cell that is no number
    rate : sampling rate that the file states, Hz
    stamps : indices of the columns of time stamps, in seconds since the first one
    blocks : first and last line of each block of readings, counted from 1, of a text with other lines between or below
        them, of which ``export`` holds one; else ()
    labels : index of a column of ``unread`` that tells directions or surfaces apart -> its texts
    """

    export: Export
    layout: Layout
    names: tuple[str, ...]
    units: tuple[str, ...]
    columns: dict[int, np.ndarray]
    unread: dict[int, InputError]
    rate: float | None
    stamps: frozenset[int]
    blocks: tuple[tuple[int, int], ...]
    labels: Mapping[int, tuple[str, ...]]

    def header(self, index: int, dimensions: Sequence[str]) -> tuple[str, str]:
        """Name of a column, and the text of its unit: that of its header, else that of the row of units, or ""."""
        name, text = name_and_unit(self.names[index], dimensions)
        if index in self.stamps:
            return name if fits_name(name, TIME) > 0 else TIME, STAMP
        # What multiplies the readings is no part of a unit that may be taken as it is.
        factor = _FACTOR.search(self.names[index])
        return name, factor[0] if factor else (text or self.units[index]).strip()


def find_layout(
    content: bytes,
    path: Path,
    dimensions: Sequence[str],
    sheet: str | None = None,
    block: tuple[int, int] | None = None,
) -> FoundLayout:
    """The layout of a file of a known format.

    Parameters
    ----------
    content, path : bytes and name of the file
    dimensions : SI units of all columns of all kinds
    sheet : of a workbook (None: the first with numbers); block: first and last line of an interrupted text (None: the longest)

    Raises
    ------
    InputError
        If the format is unknown, the file is damaged, or it holds no rows of numbers.
    """
    suffix = suffix_of(path)
    if suffix not in EXPORTS:
        raise InputError(f"a file must have a known format ({' '.join(EXPORTS)})", path.name, "export it as CSV", path)
    text = suffix.removesuffix(COMPRESSED) in TEXTS and not suffix.startswith(".lvm")
    beginning = _beginning(TextFile(content, path)) if text else b""
    blocks, layout = tuple[tuple[int, int], ...](), Layout(*(block or (None, None)), missing=NO_READING, sheet=sheet)

    def read(layout: Layout) -> tuple[Export, Readings]:
        """The export, and what ``_readings`` finds in it: a column of readings at least."""
        export = EXPORTS[suffix](content, path, layout)
        found = _readings(export)
        if not found[0]:
            nothing = InputError("a file must have a column of numbers", "none", "export the readings as numbers", path)
            raise next(iter(found[2].values()), nothing)
        return export, found

    try:
        if text and block is None:
            layout = _text_layout(beginning, path.with_suffix("") if suffix.endswith(COMPRESSED) else path)
        export, (columns, singles, unread) = read(layout)
    except InputError:
        blocks = _blocks(TextFile(content, path), layout) if text and block is None else ()
        if not blocks:
            raise
    if blocks:  # what was read before is free by now
        first, last = max(blocks, key=lambda lines: lines[1] - lines[0])
        layout = replace(layout, data_from_line=first, data_to_line=last)
        export, (columns, singles, unread) = read(layout)
    if (other := no_readings(export, layout, [*columns.values()])[1]) != layout:
        layout = other
        export, (columns, singles, unread) = read(layout)
    # Entries quote them as comments of rig.toml, which hold no control characters.
    names, units = (tuple(map(printable, texts)) for texts in _headers(export, dimensions))
    texts = {index: [row[index] for row in export.cells()] for index in unread} if export.cells else {}
    stamps = {index: values for index in texts if (values := _stamps(texts[index], export, layout, index)) is not None}
    read_too = {index: error for index, error in unread.items() if index not in stamps}
    rate, every = _rate(beginning, names, units, singles), {**columns, **stamps}
    labelled = [index for index in texts if any(fits_name(names[index], word) > 0 for word in LABELS)]
    labels = {index: tuple(sorted({*texts[index]})) for index in labelled}
    return FoundLayout(export, layout, names, units, every, read_too, rate, frozenset(stamps), blocks, labels)


def _stamps(texts: list[str], export: Export, layout: Layout, index: int) -> np.ndarray | None:
    """A column of time stamps that increase, (n,) s since the first one; None for another column."""
    with suppress(InputError):
        values = seconds_of_stamps(texts, layout.missing, lambda row: export.place(row, index))
        return values if np.nanmax(values) > 0.0 and increases(values) else None
    return None


def _blocks(file: TextFile, layout: Layout) -> tuple[tuple[int, int], ...]:
    """First and last lines of the blocks of readings of a text.

    () where a single line with numbers interrupts or ends them, which is a damaged row, and where the cells change too often.
    """
    runs, longest = _runs((text for _, text in file.blocks()), layout)
    after_block = [run for before, run in pairwise(runs) if before[0] == longest]
    if len(runs) > _MOST_RUNS or any(cells is not None and rows == 1 for cells, rows, *_ in after_block):
        return ()
    return tuple((first, last) for cells, _, first, last in runs if longest is not None and cells == longest)


def _runs(blocks: Iterable[bytes], layout: Layout) -> tuple[list[Run], Cells]:
    """Runs of lines with equal cells, and the cells of the longest run of two rows or more.

    Blank lines and comments are left out. What a line is depends on where its digits stand, not on which ones they are.
    After ``_MOST_RUNS`` no more are searched; [] and None for a text with more lines than that which differ in this.
    """

    known = dict[str, Cells | Literal[False]]()  # False: no row

    def kinds(lines: Sequence[str]) -> Iterable[Cells | Literal[False]]:
        known.update((line, _cells_of_row(line, layout) if is_row(line) else False) for line in {*lines} - known.keys())
        return map(known.__getitem__, lines)

    runs, number = list[Run](), 0
    few = takewhile(lambda _: len(known) <= _MOST_RUNS, blocks)
    for cells, equal in groupby(chain.from_iterable(kinds(lines_of(_DIGITS.sub(b"0", text))) for text in few)):
        rows = len([*equal])
        number += rows
        if not isinstance(cells, bool) and len(runs) <= _MOST_RUNS:
            _, before, first, _ = runs.pop() if runs and runs[-1][0] == cells else (cells, 0, number - rows + 1, 0)
            runs.append((cells, before + rows, first, number))
    if len(known) > _MOST_RUNS:
        return [], None
    tables = [run for run in runs if run[0] is not None and run[1] > 1]
    return runs, max(tables, key=lambda run: run[1])[0] if tables else None


def _cells_of_row(line: str, layout: Layout) -> Cells:
    """Separator and number of cells of a line that begins with a number, or a missing one before others; else None."""
    delimiter = delimiter_of(line, layout)
    texts = split_bare(line, delimiter)
    begins = is_number(texts[0]) or is_stamp(texts[0]) or (texts[0] in layout.missing and any(map(is_number, texts)))
    return (delimiter, len(texts)) if begins else None


def _beginning(file: TextFile) -> bytes:
    """The first ``_MOST_LINES`` lines of a text in UTF-8, about ``_BEGINNING`` bytes of them."""
    text = next(file.blocks(), (0, b""))[1]
    lines = text[: text.rfind(b"\n", 0, _BEGINNING) + 1 or text.find(b"\n") + 1].splitlines(keepends=True)
    return b"".join(lines[:_MOST_LINES])


def _text_layout(beginning: bytes, path: Path) -> Layout:
    """The layout under which the beginning of a text file has rows of numbers.

    Raises
    ------
    InputError
        The error of the default layout, where no line begins rows of numbers.
    """
    faults = list[InputError]()
    lines = [None, *range(1, min(_MOST_TITLES, beginning.count(b"\n") + 1) + 1)]
    for line in lines:
        for decimal in (None, ".", ","):
            layout = Layout(line, missing=NO_READING, decimal=decimal)
            with collecting(faults):
                export = EXPORTS[suffix_of(path)](beginning, path, layout)
                names = [name for row in export.headers[:1] for name in row if name.strip() and not is_number(name)]
                if decimal == "." and not 1 < export.width == len(names):
                    continue  # whole numbers between commas are no decimals where the header names each of several columns
                columns, _, unread = _readings(export)
                if not columns and unread:
                    raise unread[min(unread)]
                if any(np.isfinite(values[0]) for values in columns.values()):
                    runs, longest = _runs([beginning], layout) if line is not None else ([], None)
                    if any(run[2] < (line or 0) for run in runs if longest is not None and run[0] == longest):
                        break  # rows like those of the longest block lie above the line
                    return layout
    raise faults[0]


def _readings(export: Export) -> Readings:
    """The columns of readings, all of the most frequent length; the columns of one number; errors of all others.

    Raises
    ------
    InputError
        If the file has one row.
    """
    columns: dict[int, np.ndarray] = {}
    singles: dict[int, float] = {}
    unread: dict[int, InputError] = {}
    for column in range(export.width):
        try:
            values = export.values(column)
        except InputError as error:
            unread[column] = error
            continue
        if values.size == 1:
            singles[column] = float(values[0])
        if values.size and np.mean(np.isnan(values)) <= MOST_MISSING:
            columns[column] = values
    if columns and len(export.lines) == 1:
        rule, remedy = "an export must have two rows of numbers or more", "export all readings into one file"
        raise InputError(rule, "one row", remedy, *export.place(0, 0)[:2])
    sizes = [values.size for values in columns.values()]
    common = max(sizes, key=lambda size: (sizes.count(size), size), default=0)
    common = max(sizes) if common == 1 else common
    return {column: values for column, values in columns.items() if values.size == common}, singles, unread


def _headers(export: Export, dimensions: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns, from the rows of headers nearest to the readings."""
    empty = ("",) * export.width
    rows = list(export.headers[:3])
    units = next((row for row in rows if is_units_row(row, dimensions)), None)
    names = next((row for row in rows if row is not units), None)
    if units is not None and rows[-1] is not units:  # comments may stand below the units, names stand above them
        names = rows[rows.index(units) + 1]
    if names is None and units is not None:  # the only row of headers is a row of units, or of short names
        known = {word for words in WORDS.values() for word in words}
        return units, tuple("" if _bare(cell) in known else cell.strip(" []()") for cell in units)
    return names or empty, tuple(cell.strip(" []()") for cell in units) if units is not None else empty


def _rate(beginning: bytes, names: Sequence[str], units: Sequence[str], singles: dict[int, float]) -> float | None:
    """The sampling rate that the titles of a text state, or a number with the name of a rate, Hz; None where several differ."""
    rates = list[float | None]()
    for column, value in singles.items():
        name = re.split(r"[./]", names[column].lower())[-1]  # a field of a struct, an attribute of a group
        for known, si in ((RATE_NAMES, "Hz"), (STEP_NAMES, "s")):
            if name in known and value > 0.0:
                unit = unit_of(units[column] or si, [si])
                size = value * factor_to_si(unit, si) if unit else None
                rates.append(size if si == "Hz" or size is None else 1.0 / size)
    for line in beginning.decode("utf-8", "replace").splitlines()[:_MOST_TITLES] if not rates else ():
        for found in _RATE.finditer(line) if _SAMPLING.search(line) else ():
            # 10,000 Hz may be 10 Hz.
            number = next((x for mark in ".," if (x := number_in(found[1].strip(), mark)) is not None), None)
            unsure = not found[2] and re.fullmatch("[1-9][0-9]{0,2}[.,][0-9]{3}", found[1].strip())
            # In "channel 4 100 Hz" the blank separates no thousands.
            unsure = unsure or (" " in found[1].strip() and not re.search(r"[:=]\s*$", line[: found.start()]))
            rates.append(None if number is None or unsure else number * (1e3 if found[2] else 1.0))
    known = rates[0] if rates else None
    return known if known and all(one and abs(one / known - 1.0) < SAME_RATE for one in rates) else None


# rows: Finds what stands among readings and is none: rows of statistics, and values that stand for a missing reading.


#: Words of the labels of rows of statistics, without accents; those that may be a remark on a reading too, unless they
#: stand below all readings or beside others; and words that may stand beside them.
STATISTICS, EXTREMES, BESIDE = (
    frozenset(words.split())
    for words in (
        "mean average avg sd std stdev stddev sum total variance median mittelwert mittel durchschnitt summe gesamt "
        "standardabweichung stabw stdabw varianz moyenne somme ecart ecarttype media promedio suma desviacion desvest "
        "somma deviation deviazione scarto mediana mediane",
        "min max minimum maximum minimo massimo maximo",
        "value values of the der aller de des di la standard dev estandar tipica type error fehler sem n s x",
    )
)
#: Most rows and cells of a table in which rows of statistics are looked for: a longer one is a record.
MOST_TRIALS, MOST_CELLS = 1000, 20_000
#: Largest probability that readings agree by chance with statistics of the rows above them; ratio for a number outside
#: twice the range of those; most rows of statistics without a label, and fewest rows above them.
CHANCE, OUTSIDE, MOST_BELOW, FEWEST_ABOVE = 2e-5, 1e-2, 4, 3
#: Largest difference of a rounded number from the exact one, in units of its last digit, with a margin.
HALF_DIGIT = 0.51
#: Numbers that programs write for no reading.
_NO_READING = re.compile(r"-?(?:9{3,}(?:\.(?:9+|25))?|9{2,}\.9+)|32767|-32768|65535|2147483647|-2147483648")
#: The number of a trial, and the label of a row.
_NUMBER, _NAME = re.compile(r"[0-9]+\.?"), re.compile(r"[^\W\d_]{2}")
#: Distance of such a number from all others, in ranges of those: of one alone, and of one that is repeated.
FAR_ALONE, FAR = 10.0, 1.0


def code_in(values: np.ndarray) -> float | None:
    """The number in a column, (n,), that stands for no reading, far from all others; None without one."""
    finite = values[np.isfinite(values)]
    for end in (float(finite.min()), float(finite.max())) if finite.size > 2 else ():
        rest = finite[finite != end]
        apart = FAR_ALONE if finite.size - rest.size == 1 else FAR
        known = rest.size > 1 and _NO_READING.fullmatch(f"{end:.7g}")
        if abs(end) >= LARGEST or (known and min(np.abs([rest.min() - end, rest.max() - end])) > apart * np.ptp(rest)):
            return end
    return None


def is_statistic(cell: str) -> bool:
    """Whether a cell is the label of a row of statistics, such as ``Mean`` or ``Standard deviation:``."""
    words = {*_bare(cell).split("_")} - {""} if cell[:1].isalpha() else set[str]()
    return bool(words & (STATISTICS | EXTREMES)) and words <= STATISTICS | EXTREMES | BESIDE


def statistics_below(columns: Sequence[np.ndarray]) -> int:
    """Number of last rows that are statistics of all rows above them in every column, (n,) each; 0 without such rows.

    In each row one statistic agrees in all columns, to the digits written, where that is no chance.
    """
    table = np.column_stack(columns)
    for rows in range(min(MOST_BELOW, len(table) - FEWEST_ABOVE), 0, -1):
        here = table[:, np.isfinite(table[-rows:]).all(axis=0)]
        above = here[:-rows][np.isfinite(here[:-rows]).all(axis=1)]
        if len(above) >= FEWEST_ABOVE and here.size and _by_chance(above, here[-rows:]) < CHANCE:
            return rows
    return 0


def _by_chance(above: np.ndarray, below: np.ndarray) -> float:
    """Probability that rows, (k, c), agree as they do with statistics of the rows above them, (n, c); 1 where they do not."""
    mean, sds = np.mean(above, axis=0), [np.std(above, axis=0, ddof=k) for k in (1, 0)]
    spread, known = sds[0], np.array([mean, np.median(above, axis=0), np.min(above, axis=0), np.max(above, axis=0), *sds,
                                      sds[0] / np.sqrt(len(above)), np.sum(above, axis=0)])  # fmt: skip
    steps = np.reshape(
        [10.0 ** float(Decimal(repr(one)).as_tuple().exponent) for one in below.ravel().tolist()], below.shape
    )
    near = np.maximum(HALF_DIGIT * steps, ROUNDING * np.abs(below))
    agree = np.all(np.abs(below[:, None] - known) <= near[:, None], axis=2).any(axis=1).all()
    # By the density of a normal distribution. A number that stands above too, or in all rows, was set.
    chance = np.minimum(near / np.maximum(spread, np.finfo(float).tiny), 1.0)
    chance *= np.where(np.abs(below - 0.5 * (known[2] + known[3])) > 1.5 * np.ptp(above, axis=0), OUTSIDE, 1.0)
    chance[(spread == 0.0) | np.any(below[:, None] == above, axis=1)] = 1.0
    return float(np.prod(chance)) if agree else 1.0


def no_readings(export: Export, layout: Layout, columns: Sequence[np.ndarray]) -> tuple[dict[int, str], Layout]:
    """Rows of statistics -> their labels, and the layout that leaves them out and states codes of missing readings.

    ``columns`` are those that are read. Rows below all others are known by their numbers too, "", unless ``data_to_line``
    is stated. Labels of all rows are none, nor are those that ``where`` selects.
    """
    labels, codes = dict[int, str](), {repr(one).removesuffix(".0") for one in map(code_in, columns) if one is not None}
    count = len(export.lines)
    if export.cells is not None and count <= MOST_TRIALS and count * export.width <= MOST_CELLS:
        kept = {k for k in range(export.width) if is_wanted(k, export.headers, layout.words)}
        lines = [list(each) for each in export.cells()]
        cells = ((row, cell) for row, each in enumerate(lines) for k, cell in enumerate(each) if k not in kept)
        labels = {row: cell for row, cell in cells if is_statistic(cell)}
        if not any(STATISTICS & {*_bare(label).split("_")} for label in labels.values()):
            labels = {row: label for row, label in labels.items() if labels.keys() >= {*range(row, count)}}
        for column in ([each[k] for each in lines if k < len(each)] for k in range(export.width) if k not in kept):
            # Words below the numbers of the trials: what they name is no trial, whatever the word.
            numbered = next((row for row, cell in enumerate(column) if not _NUMBER.fullmatch(cell)), count)
            if FEWEST_ABOVE <= numbered < len(column) == count and all(map(_NAME.match, column[numbered:])):
                labels |= dict(enumerate(column[numbered:], numbered))
        if len(labels) in (0, count):
            below = statistics_below(columns) if columns and layout.data_to_line is None else 0
            labels = dict.fromkeys(range(count - below, count), "")
    first = min(labels, default=0)
    at_end = first > 0 and len(labels) == count - first
    last = int(export.lines[first - 1]) if at_end else layout.data_to_line
    return labels, replace(layout, data_to_line=last, missing=(*layout.missing, *sorted(codes)))


def refuse_no_readings(export: Export, layout: Layout) -> None:
    """Refuse rows of statistics among those of a table, and codes of missing readings in the columns that ``layout`` names.

    Raises
    ------
    InputError
        At the first one.
    """
    named = [k for k in range(export.width) if is_wanted(k, export.headers, layout.columns or ())]
    numbers = {k: export.values(k) for k in named if not is_wanted(k, export.headers, layout.words)}
    labels, other = no_readings(export, layout, [*numbers.values()])
    for marker in other.missing[len(layout.missing) :]:
        k, rows = next((k, rows) for k, one in numbers.items() if len(rows := np.flatnonzero(one == float(marker))))
        rule = "a number far from all others, which programs write for no reading, must be stated as missing"
        remedy = f'add "{marker}" to missing = [...] to drop its rows, or correct the cells'
        raise InputError(rule, f"{marker} in {counted(len(rows), 'row')}", remedy, *export.place(int(rows[0]), k))
    for row, label in labels.items():
        ends = f"state data_to_line = {other.data_to_line}"
        either = f"{ends}, or data_to_line = {export.lines[-1]} if these are readings"
        remedy = either if not label else ends if other != layout else "delete the row"
        value = shown(label) if label else "numbers that are statistics of the rows above"
        raise InputError("a row of statistics must not be read as a trial", value, remedy, *export.place(row, 0))


# columns: Guesses which columns of a file are those of one kind, and their units; proposes a column map for error
# lines.


Confidence = Literal["sure", "likely", "unsure"]
TIME = "time"
#: Score of a unit that fits a column, of the word for the friction that a kind takes, of a column that is left out, and of
#: one that is the same in every row.
UNIT_SCORE, MEANT_SCORE, LEFT_OUT, CONSTANT = 1.0, 0.5, -0.25, -2.0
#: Weight of the range of a column, relative to the largest one, which decides between equal scores only; score of a column
#: whose name does not fit.
TIE = 1e-3
_NO_NAME = -1.0 / TIE
_LONGEST_HEADER = 40  # characters; a column with a longer header is named by its number
#: Columns that may be the same in every row, beside those that a kind calls optional.
SETTINGS = ("length", "speed", "period", "f", "periods")


@dataclass(frozen=True)
class ColumnGuess:
    """A column of the kind: index in the file, unit, what the guess rests on, and the factor to write beside it.

    ``rivals`` fit too and hold other numbers. ``asked``: which of them is meant, the user must say.
    """

    index: int
    unit: str
    confidence: Confidence
    reason: str
    scale: float | None = None
    rivals: tuple["ColumnGuess", ...] = ()
    asked: bool = False


@dataclass(frozen=True)
class Assignment:
    """Columns of a file as those of a kind.

    Attributes
    ----------
    columns : by name of the kind's column
    score : how well all fit
    wanted : the set of columns of the kind
    missing : columns that the kind needs and the file does not have; a time may be stated as a rate
    """

    kind: KindRule
    columns: Mapping[str, ColumnGuess]
    score: float = 0.0
    wanted: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()


def assignments(found: FoundLayout, kind: KindRule) -> Iterable[Assignment]:
    """The best assignment of file columns to each set of columns of a kind."""
    for columns in kind.sets:
        optional = [name for name in kind.optional if name != "normal_force" or "force" in columns]
        wanted = [*columns, *kind.channels, *optional]
        scores = np.full((len(wanted), len(found.columns)), _NO_NAME)
        ranges = np.zeros_like(scores)
        guesses = {}
        for (i, name), (j, index) in product(enumerate(wanted), enumerate(found.columns)):
            scored = score_of(found, index, name, kind)
            if scored is not None:
                scores[i, j], guesses[i, j] = scored
                ranges[i, j] = np.ptp(readings_of(found, scored[1], kind.columns[name].si, finite=True))
        # Of columns that fit as well, such as the axes of an accelerometer, the one with the largest motion.
        largest = np.maximum(np.max(ranges, axis=1, keepdims=True, initial=0.0), np.finfo(float).tiny)
        rows, places = linear_sum_assignment(scores + TIE * ranges / largest, maximize=True)
        pairs = [(i, j) for i, j in zip(rows.tolist(), places.tolist(), strict=True) if scores[i, j] > _NO_NAME]
        unused = [j for j in range(len(found.columns)) if j not in {j for _, j in pairs}]
        chosen = {
            wanted[i]: _with_rivals(
                found,
                guesses[i, j],
                float(scores[i, j]),
                [(guesses[i, k], float(scores[i, k])) for k in unused if (i, k) in guesses],
                kind.columns[wanted[i]].si,
            )
            for i, j in pairs
        }
        for (i, k), other in guesses.items():
            named = (
                wanted[i] not in optional
                or wanted[i] in chosen
                or meaning(found.names[other.index], "force", kind.meant)
            )
            if k in unused and not named:  # a normal force under another name would change the number
                reason = f"{other.reason}; remove the # if it is the {wanted[i]}"
                chosen[wanted[i]] = replace(other, confidence="unsure", reason=reason, asked=True)
        channel = () if not kind.channels or set(kind.channels) & set(chosen) else kind.channels[:1]
        missing = (*(name for name in columns if name not in chosen and name != TIME), *channel)
        score = sum(float(scores[pair]) for pair in pairs) + LEFT_OUT * len(set(columns) - set(chosen))
        yield Assignment(kind, chosen, score, columns, missing)


def readings_of(found: FoundLayout, column: ColumnGuess, si: str, *, finite: bool = False) -> np.ndarray:
    """The readings of a column in SI, (n,); as they are where their unit is unknown."""
    values = found.columns[column.index]
    values = values[np.isfinite(values)] if finite else values
    return values if column.unit == UNKNOWN else scale(values, factor_to_si(column.unit, si))


def increases(values: np.ndarray) -> bool:
    """Whether times increase; a clock may start anew."""
    values = values[np.isfinite(values)]
    parts = np.split(values, clock_starts(values))
    return all(np.all(np.diff(part) > 0.0) or evened(part) is not None for part in parts)


def times_of(found: FoundLayout) -> list[int]:
    """Columns that are named as times and increase from row to row."""
    named = (index for index in found.columns if fits_name(found.header(index, ["s"])[0], TIME) > 0)
    return [index for index in named if increases(found.columns[index])]


def times_of_trace(found: FoundLayout, kind: KindRule) -> list[int]:
    """Columns of times of a file that is a record in time, where a row of ``kind`` is a trial, which is read off a record.

    A reading of a calibration is a row of a record.
    """
    rules = kind.columns.values()
    long = [index for index in times_of(found) if len(found.columns[index]) >= FEWEST_SAMPLES]
    return [] if TIME in kind.columns or any(rule.varies for rule in rules) else long


def is_constant(found: FoundLayout, index: int) -> bool:
    """Whether a column of several rows is the same in all of them."""
    return len(values := found.columns[index]) > 1 and bool(np.nanmax(values) == np.nanmin(values))


def _with_rivals(
    found: FoundLayout, column: ColumnGuess, score: float, others: Sequence[tuple[ColumnGuess, float]], si: str
) -> ColumnGuess:
    """The guess with its score beside the ``others`` that may be meant, with theirs; equal numbers are no rivals."""
    own = readings_of(found, column, si)
    rivals = [
        each
        for each in others
        if not np.allclose(readings_of(found, each[0], si), own, rtol=1e-9, atol=0, equal_nan=True)
    ]
    if not rivals:
        return column
    # The end of a word says no more than another name.
    least = _NO_NAME if score <= 1.0 + UNIT_SCORE else score
    alike = tuple(other for other, its in rivals if its + UNIT_SCORE * (other.unit == UNKNOWN) >= least)
    columns = [f"column {other.index + 1}, {found.names[other.index]!r}," for other, _ in rivals]
    reason = f"{column.reason}; {' '.join(columns)} fits {'as well' if alike else 'less well'}"
    confidence = "unsure" if alike else "likely" if column.confidence == "sure" else column.confidence
    return replace(column, confidence=confidence, reason=reason, rivals=alike, asked=column.asked or bool(alike))


def score_of(found: FoundLayout, index: int, name: str, kind: KindRule) -> tuple[float, ColumnGuess] | None:
    """How well a column of the file fits the column ``name`` of a kind; None where it cannot be."""
    rule = kind.columns[name]
    stem, text = found.header(index, sorted({each.si for each in kind.columns.values()}))
    unit = unit_of(text, [rule.si]) if text else None
    constant = is_constant(found, index)
    named, meant = fits_name(stem, name), meaning(stem, name, kind.meant)
    said, missing = f"the file says {found.names[index]!r}", "the file states no unit"
    if named < 0 or (constant and rule.varies):
        return None
    mass = unit_of(text, ["kg"]) if name == "force" and "normal_force" not in kind.columns else None
    if mass in ("kg", "g", "lb") and (named or fits_name(stem, "mass") > 0):
        return named or 1.0, ColumnGuess(index, f"{mass}f", "unsure", f"{said}: {HANGS}")
    if text and unit is None:
        return None
    below = unit_of(found.units[index], [rule.si])
    if unit and below and factor_to_si(unit, rule.si) != factor_to_si(below, rule.si):  # um is µm
        unit, missing = None, f"the header says {unit}, the row of units {below}"
    by_name = named + MEANT_SCORE * meant if named or name == "force" else 0.0
    if by_name <= 0.0 or meant < 0:
        other = (constant and name not in kind.optional) or not (unit or named) or rule.si == "1"
        return None if other else (_NO_NAME, ColumnGuess(index, unit or UNKNOWN, "unsure", said))
    if constant and name not in (*SETTINGS, *kind.optional):
        reason = f"{said}, the same in every row: a setting, or a coarse reading"
        return by_name + CONSTANT, ColumnGuess(index, unit or UNKNOWN, "unsure", reason, asked=True)
    if unit is None and rule.si == "1":
        return by_name, ColumnGuess(index, "1", "likely", "a number without unit")
    if unit is None:
        return by_name, ColumnGuess(index, UNKNOWN, "unsure", missing)
    reason = said if unit == text else f"{said}, read as {unit}"
    return by_name + UNIT_SCORE, ColumnGuess(
        index, unit, "likely" if unit in ("g_n", "mg_n") or named == NUMBERED else "sure", reason
    )


def lines_of_labels(found: FoundLayout, kind: KindRule) -> Iterable[tuple[str, str]]:
    """Settings that part the rows of a friction table by the texts of a column, and why."""
    for index, texts in found.labels.items() if "direction" in kind.setting_rules else ():
        source, held = source_of(found, index), " ".join(map(shown, texts))
        if len(texts) > 1 and fits_name(found.names[index], "surface") > 0:
            key = source if source.startswith('"') else f'"{source}"'
            yield f'where = {{ {key} = "{UNKNOWN}" }}', f"one capsule has one surface in a fit: write one of {held}"
        elif len(texts) > 1:
            yield f"split_by = {source}", f"an experiment for each of {held}; remove this line to use all rows as one"


def source_of(found: FoundLayout, index: int) -> str:
    """The header of a column, or its number where the header is not unique, long or absent."""
    header = found.names[index]
    everything = [name for row in found.export.headers for name in row]
    usable = header and header.isprintable() and len(header) <= _LONGEST_HEADER and everything.count(header) == 1
    return json.dumps(header, ensure_ascii=False) if usable else str(index + 1)


def proposal(kind: KindRule, found: FoundLayout | None) -> str:
    """The text ``columns = { ... }`` that reads a file as a table of ``kind``; ``?`` is what the file does not say.

    ``found`` is the file (None: unknown).
    """
    best, record = Assignment(kind, {}, 0.0, kind.sets[0], kind.channels[:1]), False
    if found is not None:
        best = max(assignments(found, kind), key=lambda one: (-len(one.missing), one.score))
        record = bool(times_of_trace(found, kind))
    texts, words = [], []
    for name in dict.fromkeys((*best.wanted, *best.columns, *best.missing)):
        column = best.columns.get(name)
        source = f'from = "{UNKNOWN}", unit = "{UNKNOWN if column is None else column.unit}"'
        if found is not None and column is None and name == TIME:
            source = f'rate = {{ value = "{UNKNOWN}", unit = "Hz" }}'
        elif found is not None and column is not None:
            if record or column.asked:
                words.append(f"{name}: {'the file is a record in time' if record else column.reason}")
            else:
                source = source.replace(f'"{UNKNOWN}"', source_of(found, column.index), 1)
        if column is None or not column.asked or name not in kind.optional:
            texts.append(f"{name} = {{ {source} }}")
    more = "".join(f" and {line}" for line, _ in (lines_of_labels(found, kind) if found is not None else ()))
    return f"columns = {{ {', '.join(texts)} }}{more}" + (f" ({'; '.join(words)})" if words else "")
