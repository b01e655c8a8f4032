"""The house keeps its rules: no circle of files, nothing loose, no long module, few imports inside functions."""

from __future__ import annotations

import ast
import doctest
import importlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("rig", "drivers", "calibration", "model", "sim_fixtures")
LONGEST = 600  # lines of a module
# Function-level imports of our own modules. Rooms whose modules may have them:
MAY_IMPORT_LATE = {
    "rig.cli": "commands load what they need when they are called",
    "rig.benchmark": "benchmarks are commands; pictures are drawn last",
    "rig.panel": "the panel is a command of its own",
}
# Single ones, from where to where: a scene or a command pays only for what it names.
LATE = {
    ("drivers.discovery", "drivers.links.can_link"): "python-can, where a bus is asked",
    ("drivers.discovery", "drivers.links.serial_link"): "pyserial, where ports are looked for",
    ("drivers.discovery", "drivers.links.device_server"): "pyserial, where a port is asked",
    ("drivers.settings", "drivers.links.can_link"): "python-can, where an instrument is on a bus",
    ("drivers.settings", "drivers.links.device_server"): "pyserial, where an instrument is on a port",
    ("drivers.settings", "drivers.links.tcp_link"): "sockets, where an instrument is on the network",
    ("rig.analysis.film", "calibration.film.branches.estimate"): "histories, where a film looks viscous",
    ("rig.analysis.film", "calibration.film.branches.identify"): "histories, with --branches",
    ("rig.analysis.film", "calibration.film.branches.record"): "histories, with --branches",
    ("rig.analysis.film", "calibration.film.posterior"): "emcee, with --posterior",
    ("rig.analysis.film", "calibration.report.report"): "Jinja and Matplotlib, with --report",
    ("rig.engine.follows", "model.membrane.history"): "histories, where the film has branches",
    ("rig.log.dataset", "calibration.film.curve"): "SciPy, where curves are made of a log",
    ("rig.protocol.predict", "model.membrane.history"): "histories, where the film has branches",
    ("rig.run.backend", "rig.replay.bench"): "a log in place of the bench",
    ("rig.run.backend", "rig.replay.recording"): "a log in place of the bench",
    ("rig.run.backend", "rig.safety.remote"): "processes, where the supply is on a real port",
    ("rig.run.run", "rig.operator.remote"): "sockets, where there is an operator",
    ("rig.safety.start", "rig.safety.process"): "the guard's program, in the guard's process",
    ("rig.sim.electrodes", "model.membrane.solve"): "the model, where a film is charged",
    ("rig.sim.film", "model.membrane.solve"): "the model, where a film is simulated",
    ("rig.sim.film", "model.stability.limits"): "the model, where a film is simulated under voltage",
}


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for package in PACKAGES for path in (ROOT / package).rglob("*.py")}


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Our modules that a file imports, and whether inside a function; what only type checkers read is left out."""

    def walk(node: ast.AST, late: bool) -> Iterator[tuple[str, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
                continue
            if isinstance(child, ast.Import):
                yield from ((alias.name, late) for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module and not child.level:
                for alias in child.names:
                    inner = f"{child.module}.{alias.name}"
                    yield (inner if inner in MODULES else child.module), late
            yield from walk(child, late or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef))

    for name, late in walk(ast.parse(path.read_text(encoding="utf-8")), False):
        if name in MODULES:
            yield name, late


@cache
def all_imports() -> dict[str, list[tuple[str, bool]]]:
    """Of every module; looked for when a test asks, for every worker loads this file."""
    return {name: list(imports(path)) for name, path in MODULES.items()}


def graph() -> dict[str, set[str]]:
    """The other modules that each one imports."""
    return {name: {other for other, _ in found} - {name} for name, found in all_imports().items()}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module."""
    found, number, low, stack, on = [], {}, {}, [], set()

    def visit(name: str) -> None:
        number[name] = low[name] = len(number)
        stack.append(name)
        on.add(name)
        for other in graph[name]:
            if other not in number:
                visit(other)
                low[name] = min(low[name], low[other])
            elif other in on:
                low[name] = min(low[name], number[other])
        if low[name] == number[name]:
            component = []
            while not component or component[-1] != name:
                component.append(stack.pop())
                on.discard(component[-1])
            if len(component) > 1:
                found.append(sorted(component))

    for name in graph:
        if name not in number:
            visit(name)
    return found


def test_circles_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_no_circle_of_files() -> None:
    assert len(graph()) > 200
    assert circles(graph()) == []


def test_nothing_is_loose_at_the_top_of_rig() -> None:
    assert sorted(path.name for path in (ROOT / "rig").glob("*.py")) == ["__init__.py", "__main__.py"]


def test_the_top_level_holds_what_it_should() -> None:
    allowed = {*PACKAGES, "tests", "README.md", "LICENSE", "pyproject.toml", "CONTRIBUTING.md", "CHANGELOG.md"}
    made = {"uv.lock", "build", "dist", "benchmarks", "designs"}  # by use; not part of the project
    found = {path.name for path in ROOT.iterdir() if not path.name.startswith((".", "dea-rig-demo", "__"))}
    assert found - made <= allowed and {"README.md", *PACKAGES} <= found


def test_no_module_is_long() -> None:
    lengths = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}


def test_imports_inside_functions_are_on_the_list() -> None:
    found = {
        (name, other)
        for name, imported in all_imports().items()
        for other, late in imported
        if late and not name.startswith(tuple(MAY_IMPORT_LATE))
    }
    assert sorted(found - LATE.keys()) == []
    assert sorted(LATE.keys() - found) == [], "no longer needed on the list"


def test_examples_in_docstrings_hold() -> None:
    with_examples = [name for name, path in MODULES.items() if ">>> " in path.read_text(encoding="utf-8")]
    results = {name: doctest.testmod(importlib.import_module(name)) for name in with_examples}
    assert {name: result.failed for name, result in results.items() if result.failed} == {}
    assert all(result.attempted for result in results.values()) and len(results) > 5
