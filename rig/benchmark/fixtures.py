"""The recorded logs among the fixtures: small runs of the simulated bench, made anew by one command.

Each has a folder in ``sim_fixtures/logs`` with the scene, the protocol, ``fixture.toml`` (the truth behind it and what
must come out of it, neither taken from the software) and ``log.mcap``. Nothing of the machine or the day is in a log,
so that the same software makes the same bytes wherever its arithmetic is the same; `arithmetic` tells.

    uv run python -m rig.benchmark.fixtures [NAME ...]
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import click
import numpy as np
import zstandard
from pydantic import Field

from drivers.links.link import DeviceError
from rig.base.errors import RigError
from rig.base.table import Table
from rig.base.toml_file import load_table
from rig.protocol.experiment import prepare
from rig.run.backend import simulated_bench
from rig.run.run import run
from rig.scene.scene import load_scene

LOGS = Path(str(files("sim_fixtures"))) / "logs"
MADE_ON = LOGS / "made_on.json"
ORIGIN = {
    "versions": {"dea-rig": "as of this fixture"},
    "host": {"system": "any, by `python -m rig.benchmark.fixtures`"},
}

Share = Annotated[float, Field(gt=0, le=1)]


class Truth(Table):
    """Of the simulated film."""

    G_Pa: float = Field(gt=0, description="Shear modulus at small strain (Pa).")
    eps_r: float | None = Field(default=None, gt=1, description="Relative permittivity. Absent: nothing tells it.")


class Fit(Table):
    """How near to the truth an identification with ``terms`` Ogden terms must come."""

    terms: int = Field(ge=1, le=3, description="Ogden terms of the fit.")
    G_relative_tolerance: Share = Field(description="How far G may be off, as a part of the truth.")
    eps_r_relative_tolerance: Share | None = Field(default=None, description="The same of eps_r.")


class Expected(Table):
    """What must come out of the log."""

    status: Literal["complete", "limit", "fault", "cut short"] = Field(description="How the run ended.")
    reason: str = Field(default="", description="Words that the outcome's reason holds.")
    wrinkled: bool = Field(default=False, description="Whether the true film loses its hoop tension on the way.")
    fit: Fit | None = Field(default=None, description="How near an identification must come. Absent: none is made.")


class Fixture(Table):
    """One ``fixture.toml``."""

    title: str = Field(description="What the fixture shows.")
    killed_at_s: float | None = Field(
        default=None, gt=0, description="At this time of the plan (s) what was on disk is the log. Absent: at the end."
    )
    truth: Truth = Field(description="The film behind it.")
    expected: Expected = Field(description="What must come out of the log.")


def names() -> list[str]:
    """All fixtures, by name."""
    return sorted(path.parent.name for path in LOGS.glob("*/fixture.toml"))


def load_fixture(name: str) -> Fixture:
    """What is known of one fixture."""
    return load_table(LOGS / name / "fixture.toml", Fixture, "fixture")[0]


def record(name: str, out: Path) -> None:
    """Make the log of one fixture at ``out``."""
    folder = LOGS / name
    experiment = prepare(folder / "scene.toml", folder / "protocol.toml")
    killed_at = load_fixture(name).killed_at_s
    with TemporaryDirectory() as directory:
        log = Path(directory) / "log.mcap"
        part = log.with_name(log.name + ".part")
        killed: bytes | None = None

        def progress(done: float, total: float, label: str) -> None:
            nonlocal killed
            if killed_at is not None and killed is None and done >= killed_at:
                killed = part.read_bytes()

        try:
            run(experiment, log, progress, origin=ORIGIN)
        except (RigError, DeviceError) as error:
            if not log.exists():
                raise error
        out.write_bytes(log.read_bytes() if killed_at is None else killed or b"")


def arithmetic(name: str) -> str:
    """A fingerprint of everything that the bytes of a fixture depend on beside this software's own text.

    It holds the library versions, and results of the functions whose last digits differ between processors and
    mathematical libraries: the simulated film's table, products of matrices, random and transcendental numbers.
    """
    table = simulated_bench(load_scene(LOGS / name / "scene.toml")[0]).world.film
    numbers = np.random.default_rng(1).standard_normal((64, 64))
    probes = [
        [metadata.version(package) for package in ("numpy", "scipy", "mcap", "protobuf", "zstandard")],
        list(zstandard.ZSTD_VERSION),
        repr(table),
        (numbers @ numbers).tobytes().hex(),
        np.exp(numbers).tobytes().hex(),
        [[f(x).hex() for f in (math.sin, math.exp, math.expm1)] for x in numbers[0].tolist()],
    ]
    return hashlib.sha256(json.dumps(probes).encode()).hexdigest()


def made_on() -> dict[str, str]:
    """The `arithmetic` with which each log was made."""
    found: dict[str, str] = json.loads(MADE_ON.read_text(encoding="utf-8"))
    return found


@click.command(help=__doc__)
@click.argument("chosen", nargs=-1, metavar="[NAME]...")
def main(chosen: tuple[str, ...]) -> None:
    known = made_on() if MADE_ON.exists() else {}
    for name in chosen or names():
        out = LOGS / name / "log.mcap"
        record(name, out)
        known[name] = arithmetic(name)
        click.echo(f"{out}: {out.stat().st_size / 1e3:.0f} kB")
    MADE_ON.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
    sys.exit()
