"""The kernel's build and its loader: which compiler is taken, what is refused, and that nothing of it stops the job."""

from __future__ import annotations

import ctypes
import os
import shutil
import stat
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from model.kernel import build, library

HERE = Path(library.__file__).parent
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="the stand-in compilers are shell scripts")
GOOD = """#!/bin/sh
# A stand-in for a C compiler: hands out a library that was made before, and notes how it was called.
echo "$@" >> "$0.calls"
while [ "$1" != -o ]; do shift; done
[ -f "$0.so" ] && cp "$0.so" "$2" || echo made > "$2"
"""
BAD = "#!/bin/sh\necho 'some.c: note: in what follows' >&2\necho 'some.c:1: error: no math.h here' >&2\nexit 1\n"


@pytest.fixture
def bin_(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A PATH that holds what sh needs, and no compiler; no network."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("sh", "cp", "echo"):
        found = shutil.which(name)
        assert found is not None
        (folder / name).symlink_to(found)
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("UV", raising=False)
    return folder


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """A copy of the kernel's folder, without what was built there."""
    folder = tmp_path / "kernel"
    folder.mkdir()
    for path in HERE.iterdir():
        if path.suffix in {".c", ".h", ".py"}:
            shutil.copy(path, folder)
    return folder


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of its own with a library that was really compiled, in a quarter of the time: not optimised.

    Optimised it is built by every installation, and its flags are in the next tests.
    """
    if build.system_compiler()[0] is None:
        pytest.skip("no C compiler on this machine")
    folder = tmp_path_factory.mktemp("once") / "kernel"
    shutil.copytree(HERE, folder, ignore=shutil.ignore_patterns("__pycache__", "dea_kernel-*"))
    flags = build.flags
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "flags", lambda compiler: [{"-O3": "-O0"}.get(flag, flag) for flag in flags(compiler)])
        assert build.compile_kernel(folder, library) == (library.library_path(folder), "cc")
    return folder


@pytest.fixture
def compiled(compiled_once: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(compiled_once, tmp_path / "compiled"))


def put(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def calls(compiler: Path) -> list[str]:
    return compiler.with_name(f"{compiler.name}.calls").read_text(encoding="utf-8").splitlines()


def built(sources: Path) -> list[str]:
    return sorted(path.name for path in sources.iterdir() if path.suffix not in {".c", ".h", ".py"})


@POSIX
def test_digits_do_not_depend_on_the_machine(bin_: Path, sources: Path) -> None:
    compiler = put(bin_ / "cc", GOOD)
    assert build.compile_kernel(sources, library) == (library.library_path(sources), "cc")
    told = calls(compiler)[-1].split()
    assert {"-O3", "-std=c99", "-ffp-contract=off", "-fno-math-errno", "-shared", "-lm"} <= set(told)
    assert not {"-ffast-math", "-Ofast", "-march=native"} & set(told)
    assert f"-DDEA_KERNEL_SOURCES={library.sources_digest(sources)}" in told
    assert {path.name for path in sources.glob("*.c")} == {Path(word).name for word in told if word.endswith(".c")}


@pytest.mark.parametrize(
    ("system", "machine", "compiler", "wanted", "not_wanted"),
    [
        ("linux", "x86_64", "cc", {"-march=x86-64-v2", "-fPIC"}, {"-arch", "-target"}),
        ("linux", "x86_64", "ziglang", {"-march=x86_64_v2", "-target", "x86_64-linux-gnu"}, {"-march=x86-64-v2"}),
        ("linux", "aarch64", "ziglang", {"-fPIC", "aarch64-linux-gnu"}, {"-march=x86_64_v2"}),
        ("darwin", "arm64", "cc", {"-arch", "arm64", "-fPIC"}, {"-target", "-march=x86-64-v2"}),
        ("darwin", "arm64", "ziglang", {"-target", "aarch64-macos"}, {"-arch"}),
        ("win32", "AMD64", "ziglang", {"-march=x86_64_v2", "x86_64-windows-gnu"}, {"-fPIC", "-arch"}),
    ],
)
def test_flags_of_other_systems(
    system: str, machine: str, compiler: str, wanted: set[str], not_wanted: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(build.platform, "machine", lambda: machine)
    monkeypatch.setattr(build.platform, "libc_ver", lambda: ("glibc", "2.36"))
    flags = set(build.flags(compiler))
    assert wanted <= flags and not not_wanted & flags


@POSIX
def test_cc_is_honoured_with_its_arguments(bin_: Path, sources: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put(bin_ / "cc", BAD)
    compiler = put(bin_ / "my-cc", GOOD)
    monkeypatch.setenv("CC", "my-cc -pipe")
    build.compile_kernel(sources, library)
    assert calls(compiler)[-1].startswith("-pipe ")
    assert build.requirements() == []


@POSIX
def test_a_compiler_that_cannot_compile_is_passed_over(bin_: Path, sources: Path) -> None:
    put(bin_ / "cc", BAD)
    compiler = put(bin_ / "clang", GOOD)
    build.compile_kernel(sources, library)
    assert len(calls(compiler)) == 2  # the trial, and the kernel


@POSIX
def test_without_any_compiler_the_reason_stands_beside_the_package(bin_: Path, sources: Path) -> None:
    put(bin_ / "cc", BAD)
    library.library_path(sources).write_bytes(b"of another day")
    with pytest.raises(build.Failed, match=r"cc does not work \(some.c:1: error: no math.h here\), gcc is not there"):
        build.compile_kernel(sources, library)
    found, why = library.opened(sources)
    assert found is None and "gcc is not there" in why and "ziglang" in why and "\n" not in why
    assert built(sources) == [library.reason_path(sources).name]
    put(bin_ / "cc", GOOD)
    build.compile_kernel(sources, library)
    assert built(sources) == [library.library_path(sources).name]


@POSIX
def test_ziglang_is_required_only_where_it_is_needed_and_can_be_had(bin_: Path) -> None:
    put(bin_ / "uv", BAD)
    assert build.requirements() == []  # no compiler, no network: the installation must go on
    fetcher = put(bin_ / "uv", '#!/bin/sh\necho "$@" >> "$0.calls"\n')
    assert build.requirements() == [build.ZIGLANG]
    assert build.ZIGLANG in calls(fetcher)[0].split()  # it is in the cache before anybody is asked to have it
    put(bin_ / "gcc", GOOD)
    assert build.requirements() == []


@POSIX
def test_a_failed_compilation_leaves_no_part_of_a_library(bin_: Path, sources: Path) -> None:
    put(bin_ / "cc", f"{GOOD}case $(basename $2) in trial.so) ;; *) exit 1 ;; esac\n")
    (bin_ / "basename").symlink_to(shutil.which("basename", path="/usr/bin:/bin") or "/usr/bin/basename")
    with pytest.raises(build.Failed):
        build.compile_kernel(sources, library)
    assert built(sources) == [library.reason_path(sources).name]


def test_what_is_no_library_is_refused(sources: Path) -> None:
    assert library.opened(sources)[0] is None
    assert "has not been built" in library.opened(sources)[1]
    library.library_path(sources).write_bytes(b"not a library")
    found, why = library.opened(sources)
    assert found is None and "does not load" in why and "\n" not in why


@pytest.mark.slow
def test_a_real_build_loads_and_a_stale_one_is_refused(compiled: Path) -> None:
    found, says = library.opened(compiled)
    assert isinstance(found, ctypes.CDLL) and found.dea_kernel_version() == library.VERSION
    assert says == f"compiled kernel {library.sources_digest(compiled)}, cc"
    (compiled / "added.h").write_text("/* changed since */\n", encoding="utf-8")
    found, says = library.opened(compiled)
    assert found is None and "other sources" in says
    assert built(compiled) == [library.library_path().name]


@pytest.mark.slow
def test_a_library_of_another_interface_is_refused(compiled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "VERSION", library.VERSION + 1)
    found, says = library.opened(compiled)
    assert found is None and "interface" in says


@pytest.mark.slow
def test_a_failed_build_leaves_a_good_library(compiled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", str(put(tmp_path / "cc", BAD)))
    with pytest.raises(build.Failed):
        build.compile_kernel(compiled, library)
    assert library.opened(compiled)[0] is not None


def test_this_installation_has_its_kernel() -> None:
    """Where there is a compiler, a change of the sources is followed by a build: cache-keys in pyproject.toml."""
    if build.system_compiler()[0] is None:
        pytest.skip("no C compiler on this machine")
    assert library.load() is not None, library.says()


@pytest.mark.slow
@POSIX
def test_wheel_and_source_distribution_of_the_project(tmp_path: Path) -> None:
    """With a compiler a wheel of this platform with the library; without one a pure wheel that says why."""
    root = HERE.parents[1]
    project = tmp_path / "project"
    not_needed = shutil.ignore_patterns("__pycache__", "logs", "pictures", "dea_kernel-*")
    for name in ("rig", "drivers", "calibration", "model", "sim_fixtures"):
        shutil.copytree(root / name, project / name, ignore=not_needed)
    for name in ("pyproject.toml", "README.md", "LICENSE", ".gitignore"):
        shutil.copy(root / name, project)

    def contents(target: str, **environment: str) -> tuple[str, set[str]]:
        out = tmp_path / f"{target}{len(environment)}"
        command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(out)]
        subprocess.run(command, cwd=project, env={**os.environ, **environment}, check=True, capture_output=True)
        (made,) = out.iterdir()
        if target == "sdist":
            with tarfile.open(made) as archive:
                names = {name.partition("/")[2] for name in archive.getnames()}
        else:
            names = set(zipfile.ZipFile(made).namelist())
        return made.name, {name.removeprefix("model/kernel/") for name in names if name.startswith("model/kernel/")}

    sources = {path.name for path in HERE.iterdir() if path.suffix in {".c", ".h", ".py"}}
    without, found = contents("wheel", CC=str(put(tmp_path / "cc", BAD)))
    assert without.endswith("-py3-none-any.whl")
    assert found == sources | {library.reason_path().name}
    working = put(
        tmp_path / "working-cc", GOOD
    )  # a real compiler: `test_a_real_build_loads_and_a_stale_one_is_refused`
    made, found = contents("wheel", CC=str(working), PATH=os.environ["PATH"])
    assert not made.endswith("-any.whl") and "-py3-none-" in made
    assert found == sources | {library.library_path().name}
    _, found = contents("sdist")
    assert found == sources


def test_uv_builds_anew_when_a_source_changes() -> None:
    keys = tomllib.loads((HERE.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["uv"]["cache-keys"]
    assert {"file": "model/kernel/*.{c,h,py}"} in keys and {"file": "pyproject.toml"} in keys
