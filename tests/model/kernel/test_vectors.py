"""What is meant to run several numbers at a time does: the compiler's own report, and the instructions it made."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from model.kernel import build
from model.kernel.library import HERE

MARK = "/* vector */"
NAMES = ["-DDEA_KERNEL_SOURCES=0", "-DDEA_KERNEL_COMPILER=cc"]


def compiled(directory: Path, source: str, *more: str) -> str:
    """What GCC says when it compiles a source of ``directory`` as the build does."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("there is no GCC, whose report is read here")
    flags = [flag for flag in build.flags("cc") if flag != "-shared"]
    done = subprocess.run([compiler, *flags, *NAMES, *more, str(directory / source)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if "-fopt-info-vec-optimized" in more and "optimized:" not in done.stderr:
        pytest.skip("gcc is another compiler here: it gives no report")
    return done.stderr


def scalar_loops(directory: Path, out: Path) -> list[str]:
    """The marked loops of the kernel's sources that did not become vectors."""
    report = compiled(directory, "membrane.c", "-c", "-o", str(out), "-fopt-info-vec-optimized")
    made = {(Path(a).name, int(b)) for a, b in re.findall(r"([^\s:]+):(\d+):\d+: optimized: +loop vectorized", report)}
    marked = [
        (path.name, number, line.strip())
        for path in sorted(directory.glob("*.h"))
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if line.endswith(MARK)
    ]
    assert len(marked) > 25
    return [f"{name}:{number}: {line}" for name, number, line in marked if (name, number) not in made]


@pytest.mark.slow
def test_every_marked_loop_becomes_a_vector(tmp_path: Path) -> None:
    assert scalar_loops(HERE, tmp_path / "membrane.o") == []


@pytest.mark.slow
def test_a_loop_that_cannot_is_named(tmp_path: Path) -> None:
    for path in HERE.glob("*.[ch]"):
        shutil.copy(path, tmp_path)
    law = tmp_path / "ogden.h"
    inner = "double term = mu * expm1_of(alpha * log[i]);"
    text = law.read_text(encoding="utf-8").replace("Real term = mu * expm1_of(alpha * log[i]);", inner)
    law.write_text(text.replace(inner, inner.replace("expm1_of(", "expm1(")), encoding="utf-8")
    (found,) = scalar_loops(tmp_path, tmp_path / "membrane.o")
    assert found.startswith("ogden.h:16: ")


@pytest.mark.slow
@pytest.mark.skipif(
    "x86_64" not in "".join(build.flags("cc")).replace("x86-64", "x86_64"), reason="the names are x86's"
)
def test_states_side_by_side_are_computed_four_at_a_time(tmp_path: Path) -> None:
    made = tmp_path / "several.s"
    compiled(HERE, "several_wide.c", "-S", "-o", str(made))
    kinds = re.findall(r"\bv(?:mul|add|sub|div|sqrt)([sp])d\s.*%([xy])mm", made.read_text())
    assert kinds.count(("p", "y")) > 1000
    # Zones are sought lane by lane, what a state is judged by too.
    assert len(kinds) - kinds.count(("p", "y")) < 0.04 * len(kinds)
