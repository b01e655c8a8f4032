"""The kernel under the compiler's sanitizers: hostile states touch no memory that is not theirs, nor what C forbids.

Run as a program it is what a Python with the sanitizers' library executes.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from model.arrays import Array
from model.kernel import library
from model.material.laws import known_laws
from model.material.materials import Material
from model.membrane import compiled
from model.specimen import Specimen

FLAGS = ("-g", "-O0", "-std=c99", "-ffp-contract=off", "-fPIC", "-shared")
SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
NUMBERS = {
    "ogden": ((5e3, 3.5e4, -2e3), (2.5, 5.6, -2.0)),
    "neo_hooke": ((6e4,), ()),
    "mooney_rivlin": ((4e4, 8e3), ()),
    "yeoh": ((3e4, -5e2, 40.0), ()),
    "gent": ((7e4,), (25.0,)),
}


def random_films(count: int, random: np.random.Generator) -> Array:
    """Films of every law as words of 8 bytes, of which half have wrong ones among them: any bits."""
    specimens = [
        Specimen(4e-3, 20e-3, 40e-6, 1.2, Material(name, *NUMBERS[name], 2.0, law=known_laws()[name]))
        for name in NUMBERS
    ]
    good = np.array([np.frombuffer(specimen.record, dtype=np.float64) for specimen in specimens])
    films = good[random.integers(0, len(good), count)]
    films[:, :4] *= 10.0 ** random.uniform(-0.5, 0.4, (count, 4))
    words = films.view(np.int64)
    odd = np.array(
        [0, -1, 1, 4, 9, 2**62, -(2**62), 2**63 - 1, *np.array([np.nan, np.inf, 1e308, -1.0]).view(np.int64)]
    )
    for k in np.flatnonzero(random.random(count) < 0.5):
        places = random.integers(0, words.shape[1], random.integers(1, 4))
        words[k, places] = np.where(
            random.random(len(places)) < 0.5,
            random.choice(odd, len(places)),
            random.integers(-(2**63), 2**63 - 1, len(places)),
        )
    return films


def run(path: str, count: int) -> int:
    """Solve ``count`` states of random films at random places; returns how many were answered."""
    solver = ctypes.CDLL(path).dea_kernel_solve
    solver.restype, solver.argtypes = ctypes.c_int64, compiled.ARGUMENTS
    random = np.random.default_rng(19)
    answered = 0
    for tolerance, lanes in ((1e-12, 1), (1e-8, 2), (1e-8, 4), (1e-3, 4)):
        states = count // 4
        films = random_films(states // 4, random)
        which = random.integers(-2, len(films) + 2, states)
        h = random.choice([-1.0, 1.0], states) * 10.0 ** random.uniform(-4.0, -1.5, states)
        voltage = 10.0 ** random.uniform(0.0, 3.7, states)
        for values in (h, voltage):
            values[random.integers(0, states, states // 20)] = random.choice([0.0, np.nan, np.inf, 1e300, 5e-324])
        answers = np.zeros(states, dtype=np.dtype(compiled._Answer))
        kept = (compiled._Kept * states)() if lanes == 1 else None
        task = compiled._task(tolerance, bool(tolerance < 1e-6), True, compiled.MOST_MODES)
        task = compiled._Task.from_buffer_copy(task)
        task.lanes = lanes
        pointers = [array.ctypes.data for array in (h, voltage, answers)]
        films = np.ascontiguousarray(films)
        solver(ctypes.byref(task), films.ctypes.data, len(films), which.ctypes.data, states, *pointers, kept)
        good = (answers["status"] >= 0) & (answers["status"] <= 1)
        assert np.isfinite(answers["force"][good]).all()
        assert (answers["error_estimate"][good] <= tolerance).all()
        answered += int(good.sum())
    return answered


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("count", [8_000, pytest.param(100_000, marks=pytest.mark.long)])
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler (cc)")
@pytest.mark.skipif(sys.platform != "linux", reason="the sanitizers' library is preloaded as Linux does it")
def test_no_state_does_what_c_forbids(tmp_path: Path, count: int) -> None:
    made = tmp_path / "kernel.so"
    sources = sorted(map(str, Path(library.HERE).glob("*.c")))
    built = subprocess.run(["cc", *FLAGS, *SANITIZE, *sources, "-o", str(made), "-lm"], capture_output=True, text=True)
    asan = subprocess.run(["cc", "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    if built.returncode or not Path(asan).is_absolute():
        pytest.skip(f"this compiler has no sanitizers: {built.stderr[:200]}")
    environment = os.environ | {"LD_PRELOAD": asan, "ASAN_OPTIONS": "detect_leaks=0", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, __file__, str(made), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout) > count / 5


if __name__ == "__main__":
    print(run(sys.argv[1], int(sys.argv[2])))
