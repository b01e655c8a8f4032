"""Compile the kernel: with the system's C compiler, else with the one in the ``ziglang`` wheel.

Standard library only: it runs before anything else is installed. What it cannot build costs speed, not the
installation: every failure is a `Failed` with one sentence, which then stands in a file beside the sources and is told
by ``dea-rig info --system``.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

ZIGLANG = "ziglang==0.17.1"
SECONDS = 600.0  # for one step; a download of 100 MB on a slow line is the longest

# No digit may depend on the machine or on what the compiler would like to reorder: no -ffast-math, no contraction to
# fused operations, one fixed level of the processor in place of -march=native. Without -fno-trapping-math a loop that
# chooses between two numbers does not become a vector.
COMMON = ("-O3", "-std=c99", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-shared")
LEVEL = {"x86_64": "x86-64-v2", "amd64": "x86-64-v2"}  # elsewhere the compiler's own, which is plain
TRIAL = "#include <math.h>\n#include <stdint.h>\nint64_t trial(double x) { return (int64_t)expm1(x); }\n"


class Failed(Exception):
    """The kernel cannot be compiled here; the text is one sentence."""


def flags(compiler: str) -> list[str]:
    """What the compiler is told on this system; ``compiler`` is "cc" or "ziglang"."""
    machine = platform.machine().lower()
    level = LEVEL.get(machine)
    if level and compiler == "ziglang":
        level = level.replace("-", "_")  # Zig's own spelling
    found = [*COMMON, *([f"-march={level}"] if level else [])]
    if sys.platform != "win32":
        found.append("-fPIC")  # Windows has no other code, and clang calls the flag an error there
    if compiler == "ziglang":  # named in full: without it Zig compiles for the processor of this very machine
        systems = {"darwin": "macos", "win32": "windows-gnu"}
        machines = {"amd64": "x86_64", "arm64": "aarch64"}
        found += ["-target", f"{machines.get(machine, machine)}-{systems.get(sys.platform, f'linux-{_libc()}')}"]
    elif sys.platform == "darwin":
        found += ["-arch", machine]  # a Python translated by Rosetta needs what it is itself, not what the processor is
    return found


def _libc() -> str:
    return "gnu" if platform.libc_ver()[0] == "glibc" else "musl"


def system_compiler() -> tuple[list[str] | None, str]:
    """The command of a C compiler that works, CC before cc, gcc and clang; or None, and why there is none."""
    named = os.environ.get("CC", "").strip()
    reasons = []
    for command in [shlex.split(named)] if named else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]) is None:
            reasons.append(f"{command[0]} is not there")
        elif reason := _does_not_work(command):
            reasons.append(f"{command[0]} does not work ({reason})")
        else:
            return command, ""
    return None, ", ".join(reasons)


def _does_not_work(command: list[str]) -> str:
    """Why a compiler cannot make a library: one without the headers of C is common. Empty if it can."""
    try:
        if sys.platform == "darwin" and shutil.which("xcode-select"):
            run(["xcode-select", "-p"])  # without the tools /usr/bin/cc is a stub, which opens a window
        with tempfile.TemporaryDirectory() as scratch:
            source = Path(scratch, "trial.c")
            source.write_text(TRIAL, encoding="utf-8")
            run([*command, *flags("cc"), "-o", str(Path(scratch, "trial.so")), str(source), "-lm"])
    except Failed as failed:
        return str(failed)
    return ""


def requirements() -> list[str]:
    """What has to be installed for the build: the ``ziglang`` wheel where there is no compiler and it can be had.

    It is fetched into the cache of uv or pip here: a requirement that cannot be met would end the whole installation,
    and this one can be done without.
    """
    if system_compiler()[0] is not None or importlib.util.find_spec("ziglang") is not None:
        return []
    try:
        fetch()
    except Failed:
        return []  # the build says why
    return [ZIGLANG]


def fetch() -> None:
    """Bring the ``ziglang`` wheel into the cache of uv, or of pip."""
    # With PYTHONPATH pip hides the packages outside its build environment from us, pip itself among them.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment.setdefault("UV_HTTP_RETRIES", "1")  # without a network nobody has to wait for it
    uv = os.environ.get("UV") or shutil.which("uv")
    with tempfile.TemporaryDirectory() as scratch:
        if uv:
            command = [uv, "pip", "install", "--python", sys.executable, "--target", scratch]
        else:
            command = [sys.executable, "-m", "pip", "download", "--dest", scratch]
        run([*command, "--quiet", "--no-deps", "--only-binary=ziglang", ZIGLANG], environment)


def compile_kernel(directory: Path, library: ModuleType) -> tuple[Path, str]:
    """Compile every ``*.c`` in ``directory`` to the library there; ``library`` is ``library.py`` as a module.

    Returns its path and what compiled it. The file appears at once and whole, so that two builds do each other no harm.
    Raises `Failed`; a library of other sources is then gone, and why stands in its place.
    """
    path, reason = library.library_path(directory), library.reason_path(directory)
    try:
        command, compiler = _compiler()
        made = _compiled(directory, path, command, compiler, library.sources_digest(directory))
        try:
            made.replace(path)
        except OSError as error:
            made.unlink(missing_ok=True)
            raise Failed(f"{path.name} cannot be replaced, a program may be using it: {error.strerror}") from None
    except (Failed, OSError) as failed:
        if library.opened(directory)[0] is None:  # one of these very sources may stay
            path.unlink(missing_ok=True)
            _write(reason, str(failed))
        raise Failed(str(failed)) from None
    reason.unlink(missing_ok=True)
    return path, compiler


def _compiler() -> tuple[list[str], str]:
    command, missing = system_compiler()
    if command is not None:
        return command, "cc"
    if importlib.util.find_spec("ziglang") is None:
        raise Failed(f"{missing}, and the {ZIGLANG} wheel could not be had")
    return [sys.executable, "-m", "ziglang", "cc"], "ziglang"


def _compiled(directory: Path, path: Path, command: list[str], compiler: str, digest: str) -> Path:
    """A library with a name of its own beside ``path``."""
    handle, name = tempfile.mkstemp(prefix=f"{path.stem}.", suffix=".part", dir=directory)
    os.close(handle)
    made = Path(name)
    sources = [str(source) for source in sorted(directory.glob("*.c"))]
    named = [f"-DDEA_KERNEL_SOURCES={digest}", f"-DDEA_KERNEL_COMPILER={compiler}"]
    try:
        with tempfile.TemporaryDirectory() as scratch:
            caches = {"ZIG_GLOBAL_CACHE_DIR": scratch, "ZIG_LOCAL_CACHE_DIR": scratch}
            run([*command, *flags(compiler), *named, "-o", name, *sources, "-lm"], {**os.environ, **caches})
        made.chmod(0o755)
    except BaseException:
        made.unlink(missing_ok=True)
        raise
    return made


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError:
        return  # a folder that cannot be written to: the build has said why


def run(command: list[str], environment: dict[str, str] | None = None) -> None:
    """Run a command. Raises `Failed` with the first line of its complaint that tells something."""
    try:
        done = subprocess.run(
            command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise Failed(f"{command[0]} took longer than {SECONDS:.0f} s") from None
    except OSError as error:
        raise Failed(f"{command[0]} does not start: {error.strerror}") from None
    if done.returncode:
        lines = [line.strip() for line in done.stderr.decode(errors="replace").splitlines() if line.strip()]
        telling = [line for line in lines if "error" in line.lower()] or lines or [f"exit code {done.returncode}"]
        raise Failed(telling[0][:200])
