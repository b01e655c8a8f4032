"""What a heading says: which quantity, in which unit, measured where. English, German and French."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, replace

from rig.importing.units import NOT_A_UNIT_ALONE, Unit, unit_of

# Quantity -> what it is measured in.
DIMENSION = {
    "time": "time",
    "stretch": "ratio",
    "strain": "ratio",
    "true strain": "ratio",
    "stress": "stress",
    "true stress": "stress",
    "force": "force",
    "displacement": "length",
    "length": "length",
    "voltage": "voltage",
}
# The first pattern that is found in the folded name decides; the more special ones stand before the others.
VOCABULARY: tuple[tuple[str, str], ...] = (
    (
        "index",
        r"^$|^(index|idx|no|nr|num|number|n|#|row|zeile|lfd ?nr|unnamed( \d+)?|data ?point|point|messpunkt|scan|record|"
        r"sample (no|number|nr)|satz|ligne)$",
    ),
    (
        "specimen",
        r"^(specimen|sample|probe|proben?(nummer|name|nr|bezeichnung)|eprouvette|echantillon)( ?(id|"
        r"name|no|nr|number|label))?$|^id$",
    ),
    ("cycle", r"\b(cycles?|zyklus|zyklen|zyklusnummer|lastwechsel|loop)\b"),
    (
        "other",
        r"rate\b|geschwindigkeit|vitesse|speed|velocity|energ|\bwork\b|arbeit|power|leistung|modul|width|"
        r"breite|largeur",
    ),
    (
        "other",
        r"\b(area|thickness|dicke|epaisseur|querschnitt|section|temp|temperatur\w*|humidity|feuchte|"
        r"status|remark|comment|kommentar|bemerkung)\b",
    ),
    (
        "other",
        r"\b(current|strom|courant|i|leak\w*|capacit\w*|kapazitat|resist\w*|widerstand|frequency|frequenz|"
        r"i (mon|set|ist|soll))\b",
    ),
    (
        "true strain",
        r"\b(true|log|logarithmic|natural|wahre?|logarithmische|vraie|logarithmique)\b.*(strain|"
        r"dehnung|deformation|elongation)",
    ),
    (
        "true strain",
        r"(strain|dehnung|deformation|elongation|\beps(ilon)?)\b.*\b(true|log|ln|logarithmic|natural|wahr|vraie)\b",
    ),
    ("true strain", r"hencky|umformgrad|\bln (l|lambda)"),
    ("true stress", r"\b(true|cauchy|wahre?|vraie)\b.*(stress|spannung|contrainte|sigma)|cauchy"),
    ("true stress", r"(stress|spannung|contrainte|sigma)\b.*\b(true|wahr|vraie)\b"),
    (
        "stretch",
        r"\bstretch|lambda|(extension|elongation|draw|stretch) ratio|streck(ung|verhaltnis|grad)|verstreckung|"
        r"dehnungsverhaltnis|"
        r"(rapport|taux|ratio) d.?(elongation|allongement|extension|etirement)|etirement",
    ),
    (
        "time",
        r"\b(time|t|zeit|temps|timestamp|datetime|uhrzeit|zeitstempel|prufzeit|versuchszeit|messzeit|"
        r"millis|micros|elapsed|duree|date|datum|clock|seconds|sekunden|x value)\b|zeit$",
    ),
    ("strain", r"strain|dehnung|\beps(ilon)?\b|deformation|elongation|allongement|stauchung|verformung"),
    ("stress", r"stress|spannung|contrainte|\bsigma|\bpk ?1\b|piola"),
    (
        "voltage",
        r"voltage|\bvolts?\b|\bhv|hochspannung|\btension\b|potential|\bu( \w+)?$|^v( \w+)?$|^v(mon|set|"
        r"ist|soll|out)\b|\bkv\b",
    ),
    (
        "force",
        r"force|\bload|kraft|\blast\b|effort|\bcharge\b|^f([xyz]|n)?$|^f \w+$|newton|weight|gewicht|"
        r"lastzelle|kraftmessdose|\bkmd\b|hx711|\bpoids\b|messdose",
    ),
    (
        "displacement",
        r"displacement|\bdisp\b|position|\bpos\b|\bweg\b|weg$|\bway\b|verschiebung|deplacement|\bcourse\b|"
        r"crosshead|stroke|travel|traverse|laser|stage|"
        r"\bhub\b|auslenkung|extension|verlangerung|\bdelta ?(l|h|x|z)\b|^[hzxds]$|height|hohe|\bfleche\b|"
        r"elevation|distance|abstand",
    ),
    ("length", r"^(length|lange|longueur|l|current length|messlange|gauge length|grip separation)$"),
)
GREEK = {"λ": "lambda", "ε": "epsilon", "σ": "sigma", "Δ": "delta ", "δ": "delta ", "ϵ": "epsilon"}
# Sensors on the specimen itself, and values that were only asked for or measured at the drive.
AT_SPECIMEN = (
    r"laser|extensometer|video|\bdic\b|camera|kamera|optical|optisch|feindehnung|\bmon|meas|\bist\b|actual|\breal\b|"
    r"gemessen"
)
AT_DRIVE = (
    r"crosshead|traverse|stroke|stage|motor|\bset|soll|command|\bcmd|target|demand|consigne|setpoint|vset|"
    r"machine|maschine|grip|encoder"
)


AT_VOLTAGE = re.compile(
    r"(?:(?:\bat|@|\bbei|\bà|\bU ?=|\bV ?=)\s*)?(?<![\w.,])(\d+(?:[.,]\d+)?)\s?(kV|V)(?![A-Za-z0-9])"
)


@dataclass(frozen=True)
class Heading:
    """A heading as it was understood.

    ``quantity`` is one of `DIMENSION`, or "index", "specimen", "cycle", "other", "" (not known). ``rank`` is 2 where
    the name says that the specimen itself was measured, 0 where it is a set value or the drive's own, else 1.
    ``direction`` is 1 or 2 for biaxial tests, 0 where the name has no number. ``weak`` is set where only the unit
    tells the quantity. ``at_voltage`` (V) is the voltage in a heading such as "F at 1 kV (mN)".
    """

    text: str
    name: str
    unit: Unit | None
    unit_text: str
    quantity: str
    rank: int = 1
    direction: int = 0
    weak: bool = False
    at_voltage: float | None = None


def fold(text: str) -> str:
    """Lower case, no accents, Greek letters spelled, words apart by single blanks.

    >>> fold("Einspannlänge_L0"), fold("ε_eng"), fold("Équi-Biaxial"), fold("PosUm")
    ('einspannlange l0', 'epsilon eng', 'equi biaxial', 'pos um')
    """
    for letter, name in GREEK.items():
        text = text.replace(letter, name)
    text = re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", " ", text)
    text = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    text = "".join(letter for letter in text if not unicodedata.combining(letter)).casefold()
    text = re.sub(r"(?<=[^aeiou])ae(?=ng)|ae(?=nd)", "a", text)  # Laenge, Aenderung
    text = text.replace("pruef", "pruf").replace("hoehe", "hohe").replace("aequi", "aqui")
    return " ".join(re.sub(r"[^a-z0-9%#]+", " ", text).split())


def split_unit(text: str) -> tuple[str, str, Unit | None]:
    """Name, text of the unit ("" where there is none) and the unit; one that is not known stays None.

    >>> [split_unit(t)[:2] for t in ("Kraft [mN]", "t_s", "Load / kgf", "Strain (in/in)", "Weg in mm", "F")]
    [('Kraft', 'mN'), ('t', 's'), ('Load', 'kgf'), ('Strain', 'in/in'), ('Weg', 'mm'), ('F', '')]
    """
    text = text.strip().strip("'").strip()
    inner = re.search(r"[(\[{<]\s*([^()\[\]{}<>]*?)\s*[)\]}>]\s*$", text)
    if inner:
        unit = unit_of(inner[1])
        if unit is not None or _looks_like_unit(inner[1]):
            return text[: inner.start()].strip(" ,:_"), inner[1], unit
        return text, "", None
    for pattern in (
        r"\s+(?:in|en)\s+(\S+)$",
        r"\s+/\s*(\S+)$",
        r"[_\s:;]+([^\s_:;]+)$",
        r"(?<=\w)/\s*([^\d\s/]\S*)$",
        r"\s*,\s*(\S+)$",
    ):
        found = re.search(pattern, text)
        unit = unit_of(found[1]) if found else None
        if found and unit is not None and text[: found.start()].strip(" ,:_"):
            if unit.name in ("1", "-", "--", "strain", "ustrain"):
                continue  # a number or a word of the name
            return text[: found.start()].strip(" ,:_"), found[1], unit
    camel = re.match(r"^([a-z]+)(mN|N|mm|um|kV|V|MPa|kPa|Pct|Percent)$", text)
    if camel:
        return camel[1], camel[2], unit_of(camel[2])
    if text.casefold() in ("millis", "micros", "seconds", "sekunden"):
        return text, text, unit_of(text)
    return text, "", None


def _looks_like_unit(text: str) -> bool:
    """Whether a text in brackets is meant for a unit, though it is none that is known."""
    return bool(re.fullmatch(r"[a-zA-Zµμ°%²³]{1,4}([/*^·][a-zA-Zµμ²³0-9]{1,4}){0,2}", text)) and not re.fullmatch(
        r"(?i)eng|nom|true|mon|set|ist|soll|avg|raw|x|y|z|l|h|f|u|i|mean", text
    )


def voltage_in(text: str) -> float | None:
    """The voltage (V) that a text names; None where it names none, or several.

    >>> voltage_in("F @ 1,5 kV (mN)"), voltage_in("0 V"), voltage_in("cone 1000V run2"), voltage_in("U (V)")
    (1500.0, 0.0, 1000.0, None)
    """
    found = AT_VOLTAGE.findall(text)
    return float(found[0][0].replace(",", ".")) * (1e3 if found[0][1] == "kV" else 1.0) if len(found) == 1 else None


def understand(text: str, unit_cell: str = "") -> Heading:
    """What a heading, and the cell of the unit row under it, mean."""
    at_voltage = voltage_in(text.replace("_", " "))
    if at_voltage is not None:
        rest = understand(AT_VOLTAGE.sub(" ", text.replace("_", " ")).strip(" ,;:_-/()[]@="), unit_cell)
        if rest.quantity in ("force", "displacement", "time"):
            return replace(rest, text=text, at_voltage=at_voltage)
    name, unit_text, unit = split_unit(text)
    if unit_cell.strip().strip("()[]"):
        unit, unit_text = unit_of(unit_cell), unit_cell.strip().strip("()[]")
    folded = fold(name)
    quantity = next((quantity for quantity, pattern in VOCABULARY if re.search(pattern, folded)), "")
    weak = False
    if unit is not None and (DIMENSION.get(quantity) != unit.dimension):
        changed = _by_unit(quantity, unit)
        weak = changed != quantity and quantity in ("", "index")
        quantity = changed
    direction = re.search(r"(?<![0-9.])([12])$|(?<![0-9])([12]{2})$| ([xy])$", folded)
    along = 0
    if direction and quantity in ("stretch", "strain", "true strain", "stress", "true stress"):
        along = {"1": 1, "11": 1, "x": 1, "2": 2, "22": 2, "y": 2}.get("".join(filter(None, direction.groups())), 0)
    rank = 2 if re.search(AT_SPECIMEN, folded) else 0 if re.search(AT_DRIVE, folded) else 1
    return Heading(text, name, unit, unit_text, quantity, rank, along, weak)


def _by_unit(quantity: str, unit: Unit) -> str:
    """The quantity where name and unit do not belong together: the unit decides, if it leaves one possibility."""
    if quantity in ("cycle", "specimen", "other"):
        return quantity
    strains = ("stretch", "strain", "true strain")
    match unit.dimension:
        case "length" if quantity in (*strains, "", "index"):
            return "displacement"
        case "ratio" if quantity in ("displacement", "length"):
            return "strain"
        case "voltage" if quantity in ("stress", "", "index"):
            return "voltage"
        case "stress" if quantity in ("voltage", "force", ""):
            return "stress"
        case "force" if quantity in ("voltage", "stress", "", "displacement"):
            return "force"
        case "time" if quantity in ("", "index"):
            return "time"
        case "current" | "temperature" | "speed" | "area" | "other":
            return "other"
    return quantity


def is_unit_row(cells: list[str]) -> bool:
    """Whether every cell that is not empty is a unit, and not a name that looks like one."""
    given = [cell.strip() for cell in cells if cell.strip().strip("()[]").strip()]
    if not given:
        return False
    units = [unit_of(cell) for cell in given]
    alone = [cell for cell in given if cell in NOT_A_UNIT_ALONE]
    return all(unit is not None for unit in units) and len(alone) < len(given)
