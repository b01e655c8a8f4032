"""Files as accidents and attackers make them, through every reader: an error of the family, soon, with little memory.

The directed ones are of known kinds; a seeded fuzzer changes good files at random (a few hundred here, thousands as a
slow test).
"""

from __future__ import annotations

import json
import random
import time
import tracemalloc
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path

import click
import pytest

from model.material.materials import NAMED
from rig.analysis.cases import CaseError, solve_cases
from rig.analysis.fit_file import read_fit
from rig.base.certificates import load_certificate
from rig.base.errors import RigError
from rig.cli.files import read_json, read_ports
from rig.design.study import load_study
from rig.importing.sheet_table import read_sheet_tests
from rig.log.contents import certificates_in
from rig.log.dataset import load_run
from rig.log.reader import read_log
from rig.log.writer import LogWriter
from rig.protocol.protocol import load_protocol
from rig.scene.scene import load_scene

FIXTURES = Path(str(files("sim_fixtures")))
LOG = (FIXTURES / "logs" / "no-hv" / "log.mcap").read_bytes()
MOST_S, MOST_BYTES = 10.0, 300_000_000
FIT = json.dumps(
    {
        "terms": 1,
        "parameters": ["mu1", "alpha1", "eps_r"],
        "quantities": {"mu1": {"value": 4e4}, "alpha1": {"value": 3.0}, "eps_r": {"value": 2.0}},
        "covariance": [[1e4, 0, 0], [0, 1e-3, 0], [0, 0, 1e-4]],
    }
)
CASES = json.dumps(
    [{"id": 1, "a": 4e-3, "b": 2e-2, "thickness": 4e-5, "prestretch": 1.2, "h": 5e-3, "voltage": 0,
      "wrinkling": "plain", "material": {"mu": [4e4], "alpha": [3.0], "eps_r": 2.0}}]
)  # fmt: skip
SHEET = "# kind: uniaxial\nstretch,nominal_stress_MPa\n" + "".join(f"{1 + k / 20},{0.01 * k}\n" for k in range(30))


def _log(path: Path) -> None:
    log = read_log(path)
    certificates_in(log)
    load_run(path)


def _solve(path: Path) -> None:
    try:
        solve_cases(read_json(path, "cases"))
    except CaseError:
        return


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "scene": (".toml", load_scene),
    "protocol": (".toml", load_protocol),
    "certificate": (".toml", load_certificate),
    "study": (".toml", load_study),
    "ports": (".json", read_ports),
    "cases": (".json", _solve),
    "fit": (".json", lambda path: read_fit(path, NAMED["parker-cao2018"])),
    "sheet": (".csv", lambda path: read_sheet_tests([path])),
    "log": (".mcap", _log),
}

GOOD: dict[str, bytes] = {
    "scene": (FIXTURES / "scenes" / "cone-4mm.toml").read_bytes(),
    "protocol": (FIXTURES / "protocols" / "paper.toml").read_bytes(),
    "certificate": (FIXTURES / "calibrations" / "force.toml").read_bytes(),
    "study": (FIXTURES / "studies" / "figure7.toml").read_bytes(),
    "ports": json.dumps({"stage": {"port": "/dev/pts/1"}, "hv": {"interface": "slcan"}}).encode(),
    "cases": CASES.encode(),
    "fit": FIT.encode(),
    "sheet": SHEET.encode(),
    "log": LOG,
}


def hostile(kind: str, path: Path, data: bytes, *, bytes_too: bool = False) -> RigError | None:
    """Read it; what was said, if anything. Anything but an error of the family fails, as do too much time or memory."""
    path.write_bytes(data)
    said: RigError | None = None
    if bytes_too:
        tracemalloc.start()
    begin = time.process_time()
    try:
        READERS[kind][1](path)
    except click.ClickException:
        pass
    except RigError as error:
        said = error
    finally:
        took = time.process_time() - begin
        if bytes_too:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < MOST_BYTES, (kind, peak)
    assert bytes_too or took < MOST_S, (kind, took)
    if said is not None:
        assert len(str(said)) < 20_000 and said.exit_code in (1, 2, 3)
        for inside in ("function-after", "Unable to extract", "Field required", "nput should"):
            assert inside not in str(said), said
    return said


TOML = {
    "dotted key": b"a" + b".a" * 10_000 + b" = 1",
    "dotted key of quotes": b'"a"' + b'."a"' * 10_000 + b" = 1",
    "dotted key with spaces": b"a" + b" . a" * 20_000 + b" = 1",
    "dotted table": b"[a" + b".a" * 60_000 + b"]\n",
    "dotted keys, many": b"".join(b"a.b%d.c.d = 1\n" % k for k in range(10_000)),
    "inline key": b"x = {a" + b".a" * 10_000 + b" = 1}",
    "lists": b"a = " + b"[" * 100_000,
    "lists, closed": b"a = " + b"[" * 5000 + b"]" * 5000,
    "inline tables": b"a = " + b"{a = " * 5000 + b"1" + b"}" * 5000,
    "quotes": b'a = """' + b'\\"""' * 50_000,
    "quotes of one kind": b"'" * 200_000,
    "quotes of both kinds": b"\"'" * 100_000,
    "digits": b"a = " + b"9" * 100_000,
    "digits with underscores": b"a = " + b"9_" * 50_000 + b"9",
    "hexadecimal": b"a = 0x" + b"f" * 100_000,
    "exponent": b"a = 1e400\nb = -1e400",
    "tiny": b"a = 5e-324",
    "not numbers": b"a = nan\nb = inf",
    "zero bytes": b"a = 1\0",
    "nothing": b"",
    "spaces": b" " * 200_000,
    "newlines": b"\n" * 200_000,
    "large": b"#" * 400_000,
    "large text": b'a = "' + b"x" * 250_000 + b'"',
    "not text": bytes(range(256)) * 100,
    "surrogates": b'a = "\xed\xa0\x80"',
    "escaped surrogate": b'a = "\\ud800"',
    "ESC": b'title = "\\u001b[2J\\u001b[31mred"',
    "ESC in a key": b'"\\u001b[2J" = 1',
    "other direction of writing": b'title = "\\u202egnp.exe"',
    "markup": b'title = "[/red][bold]"',
    "braces": b'title = "{0.__class__} %s %n {}"',
    "duplicate": b"a = 1\na = 2",
    "duplicate table": b"[a]\n[a]",
    "table over value": b"a = 1\n[a.b]",
    "date": b"a = 9999-12-31T23:59:60Z",
    "date out of range": b"a = 0000-13-45",
    "list of everything": b'a = [1, "a", true, 1979-05-27, [1], {a = 1}, nan]',
    "many tables": b'[[step]]\ndo = "home"\n' * 11_000,
    "many keys": b"".join(b"k%d = 1\n" % k for k in range(25_000)),
    "long key": b"k" * 200_000 + b" = 1",
    "open string": b'a = "abc',
    "carriage returns": b"a = 1\rb = 2\r",
}
JSON = {
    "1e400": b'{"a": 1e400}',
    "400 digits": b'{"a": ' + b"9" * 400 + b"}",
    "many digits": b"[" + b"9" * 10_000 + b"]",
    "NaN": b'{"a": NaN, "b": Infinity}',
    "duplicate": b'{"a": 1, "a": 2}',
    "underscore": b'{"a": 1_0}',
    "deep": b"[" * 100_000,
    "deep objects": b'{"a":' * 50_000,
    "closed": b"[" * 5000 + b"]" * 5000,
    "quotes": b'"' * 99_999,
    "backslashes": b'"' + b"\\" * 99_999,
    "nothing": b"",
    "null": b"null",
    "number": b"7",
    "text": b'"abc"',
    "list of null": b"[null, null]",
    "comma": b'{"a": 1,}',
    "not text": bytes(range(256)),
    "surrogate": b'{"\\ud800": "\\udfff"}',
    "ESC": b'{"\\u001b[31m": {"port": "\\u001b[2J"}}',
    "large": b"[" + b"1," * 200_000 + b"1]",
    "booleans": b'{"terms": true, "parameters": [true], "stage": true}',
    "objects for values": b'{"stage": {"port": {"port": {}}}, "id": {}}',
}
FITS = {
    "negative variance": FIT.replace("0.001, 0]", "-0.001, 0]"),
    "covariance of another size": FIT.replace(", [0, 0, 0.0001]", ""),
    "covariance not symmetric": FIT.replace("[[10000.0, 0, 0]", "[[10000.0, 5, 0]"),
    "no terms": FIT.replace('"terms": 1', '"terms": 0'),
    "negative terms": FIT.replace('"terms": 1', '"terms": -3'),
    "terms of a million": FIT.replace('"terms": 1', '"terms": 1000000'),
    "terms as text": FIT.replace('"terms": 1', '"terms": "1"'),
    "value as text": FIT.replace("40000.0", '"4_0"'),
    "value negative": FIT.replace("40000.0", "-40000.0"),
    "value null": FIT.replace("40000.0", "null"),
    "a parameter twice": FIT.replace('"alpha1", "eps_r"]', '"mu1", "eps_r"]'),
    "parameters as text": FIT.replace('["mu1", "alpha1", "eps_r"]', '"mu1"'),
}
SHEETS = {
    "long cell": "stretch,nominal_stress_MPa\n1," + "9" * 200_000 + "\n2,1\n",
    "long quoted cell": 'stretch,nominal_stress_MPa\n1,"' + "x" * 200_000 + '"\n2,1\n',
    "open quote": 'stretch,nominal_stress_MPa\n"1,2\n' * 1000,
    "columns of one name": "stretch,stretch,nominal_stress_MPa\n1,1,1\n2,2,2\n3,3,3\n",
    "underscores": "stretch,nominal_stress_MPa\n1_0,1\n2_0,2\n3_0,3\n",
    "infinite": "stretch,nominal_stress_MPa\n1,inf\n2,1e400\n3,nan\n",
    "many columns": "stretch,nominal_stress_MPa" + ",x" * 50_000 + "\n" + "1," * 50_001 + "1\n",
    "zero bytes": "stretch,nominal_stress_MPa\n1,\0\n",
    "nothing": "",
    "remarks": "# a\n" * 50_000,
    "formulas": '=cmd|"/c calc"!A1,nominal_stress_MPa\n=1+1,2\n',
    "ESC": "\x1b[31mstretch,nominal_stress_MPa\n1,1\n2,2\n3,3\n",
}


def directed() -> Iterator[tuple[str, str, bytes]]:
    for kind in ("scene", "protocol", "certificate", "study"):
        yield from ((kind, name, data) for name, data in TOML.items())
    for kind in ("ports", "cases", "fit"):
        yield from ((kind, name, data) for name, data in JSON.items())
    yield from (("fit", name, text.encode()) for name, text in FITS.items())
    yield from (("sheet", name, text.encode()) for name, text in SHEETS.items())


@pytest.mark.parametrize(
    ("kind", "name", "data"), list(directed()), ids=lambda one: one if isinstance(one, str) else ""
)
def test_directed_files(tmp_path: Path, kind: str, name: str, data: bytes) -> None:
    said = hostile(kind, tmp_path / f"{kind}{READERS[kind][0]}", data)
    # Cases are answered one by one, sheets may be understood all the same, and of ports any table will do.
    assert said is not None or kind in ("cases", "sheet", "ports")


@pytest.mark.slow  # counting memory multiplies the time
@pytest.mark.parametrize(
    ("kind", "name", "data"),
    [one for one in directed() if one[0] in ("scene", "fit", "sheet")],
    ids=lambda one: one if isinstance(one, str) else "",
)
def test_directed_files_take_no_more_memory_than_allowed(tmp_path: Path, kind: str, name: str, data: bytes) -> None:
    hostile(kind, tmp_path / f"{kind}{READERS[kind][0]}", data, bytes_too=True)


def test_there_are_two_hundred_and_good_files_pass(tmp_path: Path) -> None:
    assert len(list(directed())) >= 200
    assert all(text != FIT for text in FITS.values())
    for kind, data in GOOD.items():
        assert hostile(kind, tmp_path / f"good{READERS[kind][0]}", data) is None, kind


@pytest.mark.parametrize(
    ("name", "bytes_too"),
    [
        *((name, False) for name in TOML),
        *(pytest.param(name, True, marks=pytest.mark.slow) for name in TOML if "dotted" in name),
    ],
)
def test_toml_inside_a_log(tmp_path: Path, name: str, bytes_too: bool) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        log.attach("scene.toml", "application/toml", TOML[name])
        log.attach("certificate.force.toml", "application/toml", TOML[name])
        log.write("/event", {"t_s": 0.0, "severity": "info", "source": "x", "message": "\x1b[31m"}, 1, 1)
        log.finish({"status": "complete"})
    said = hostile("log", path, path.read_bytes(), bytes_too=bytes_too)
    assert said is not None and "\x1b" not in str(said)


def mutated(data: bytes, random_: random.Random) -> bytes:
    """One to four changes: a byte, a cut, a doubling, a swap, or a piece that is known to be bad."""
    pieces = [
        b"\0",
        b"\xff",
        b"nan",
        b"1e400",
        b"-",
        b"[",
        b"]",
        b"{",
        b'"',
        b"'''",
        b"\\",
        b"#",
        b"=",
        b",",
        b".",
        b"\n",
    ]
    pieces += [b"9" * 50, b"true", b"null", b"[[step]]\n", b"\x1b[31m", b"1_0", b"5e-324", "é".encode()]
    for _ in range(random_.randint(1, 4)):
        at = random_.randrange(len(data) + 1)
        to = min(len(data), at + random_.randint(1, 20))
        data = random_.choice(
            (
                data[:at] + bytes([random_.randrange(256)]) + data[at + 1 :],
                data[:at] + data[to:],
                data[:at] + data[at:to] * 3 + data[to:],
                data[:at],
                data[:at] + random_.choice(pieces) + data[at:],
                data[:at] + random_.choice(pieces) + data[to:],
            )
        )
    return data


def fuzz(folder: Path, kind: str, count: int, seed: int) -> None:
    random_ = random.Random(seed)
    path = folder / f"fuzz{READERS[kind][0]}"
    for number in range(count):
        data = mutated(GOOD[kind], random_)
        try:
            hostile(kind, path, data)
        except Exception as error:
            kept = folder / f"{kind}-{seed}-{number}{READERS[kind][0]}"
            kept.write_bytes(data)
            raise AssertionError(f"{kind}, seed {seed}, number {number}: {error!r}; the file is {kept}") from error


@pytest.mark.parametrize("kind", list(READERS))
def test_files_changed_at_random(tmp_path: Path, kind: str) -> None:
    fuzz(tmp_path, kind, 12 if kind in ("log", "cases") else 60, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(READERS))
def test_many_files_changed_at_random(tmp_path: Path, kind: str) -> None:
    fuzz(tmp_path, kind, 30 if kind in ("log", "cases") else 300, seed=2)
