"""``dea-rig init``: scene, protocols and certificates for your film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from rig.cli.files import FOLDER, POSITIVE, Number

if TYPE_CHECKING:
    from rig.analysis.first_bench import Film, Instruments


@click.command("init")
@click.argument("folder", type=FOLDER)
@click.option("--preset", help="The film: parker, vhb-4905, vhb-4910, elastosil-2030, ecoflex-00-30, sylgard-184.")
@click.option("--disk-radius-mm", type=POSITIVE, help="Radius of the disk.")
@click.option("--ring-radius-mm", type=POSITIVE, help="Inner radius of the ring.")
@click.option("--prestretch", type=Number(min=1), help="Stretched over original length; 1 is none.")
@click.option("--thickness-um", type=POSITIVE, help="Of the film before pre-stretch; default: as sold.")
@click.option("--name", default="film-1", show_default=True, help="Of this specimen.")
@click.option("--no-hv", is_flag=True, help="A bench without high voltage.")
@click.option("--no-laser", is_flag=True, help="A bench without a displacement sensor.")
@click.option("--monitor", help="Also a second reading of the voltage by this driver, e.g. scpi.")
@click.option("--from-devices", is_flag=True, help="A real bench: find the instruments, write ports and serials.")
@click.option("--port", "ports", multiple=True, help="With --from-devices: look on this serial port only.")
@click.option("--bus", "buses", multiple=True, metavar="INTERFACE:CHANNEL[@BITRATE]", help="And on this CAN bus.")
@click.option("--yes", is_flag=True, help="Ask nothing: usual values for what is not given.")
def command(
    folder: Path,
    preset: str | None,
    disk_radius_mm: float | None,
    ring_radius_mm: float | None,
    prestretch: float | None,
    thickness_um: float | None,
    name: str,
    no_hv: bool,
    no_laser: bool,
    monitor: str | None,
    from_devices: bool,
    ports: tuple[str, ...],
    buses: tuple[str, ...],
    yes: bool,
) -> None:
    """Write scene.toml, protocols/ and certificates/ into a new FOLDER, every key explained.

    The scene runs on the simulated bench; with --from-devices on the instruments that answer (nothing is sent to them
    but questions). What is not given as an option is asked.
    """
    from rig.analysis.first_bench import Film, simulated_instruments
    from rig.base.errors import ConfigError
    from rig.scene.presets import PRESETS
    from rig.sim.twins import of_role

    if monitor and monitor not in of_role("monitor"):
        raise ConfigError(f"--monitor {monitor}: there is no such driver; there are {', '.join(of_role('monitor'))}.")
    if monitor and (no_hv or from_devices):
        raise ConfigError(
            "--monitor goes with a simulated bench that has high voltage. For a real one write [monitor] by hand: "
            f"`dea-rig keys {monitor}`."
        )
    if folder.exists():
        raise ConfigError(f"{folder} exists already; nothing is overwritten. Name a new folder.")
    if not folder.absolute().parent.is_dir():
        raise ConfigError(f"{folder}: its folder {folder.parent} does not exist.")

    def asked(text: str, given: float | None, usual: float) -> float:
        if given is not None:
            return given
        return usual if yes else float(click.prompt(text, default=usual, type=float))

    if preset is None:
        preset = "parker" if yes else click.prompt("Film", type=click.Choice(list(PRESETS)), default="parker")
    if preset not in PRESETS:
        from difflib import get_close_matches

        near = get_close_matches(preset, list(PRESETS), n=1, cutoff=0.5)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise ConfigError(f"--preset {preset}: there is no such film; there are {', '.join(PRESETS)}.{hint}")
    known = PRESETS[preset]
    film = Film(
        preset=known,
        name=name,
        disk_radius_mm=asked("Radius of the disk / mm", disk_radius_mm, 5.0),
        ring_radius_mm=asked("Inner radius of the ring / mm", ring_radius_mm, 25.0),
        thickness_um=asked("Thickness before pre-stretch / um", thickness_um, known.thicknesses_um[0]),
        prestretch=asked("Pre-stretch, 1 is none", prestretch, known.prestretch),
    )
    _check(film)
    instruments = simulated_instruments(hv=not no_hv, displacement=not no_laser, monitor=monitor or "")
    if from_devices:
        instruments = _found(
            ports, buses, [role for role in ("stage", "force", "displacement", "hv") if role in instruments]
        )
    made = _write(film, folder, instruments, real=from_devices)
    for path in made:
        click.echo(f"written: {path}")
    scene, sweep, log = folder / "scene.toml", folder / "protocols" / "sweep.toml", folder / "run.mcap"
    click.echo(f"Film: {known.source}.")
    if from_devices:
        click.echo(
            "The certificates are guesses from data sheets: write what yours say, or calibrate before you measure."
        )
    click.echo("Next:")
    if from_devices:
        click.echo(f"  dea-rig read {scene}")
        click.echo(f"  dea-rig jog {scene}    # find where the film is, then set stage.approach_from_mm short of it")
    click.echo(f"  dea-rig check {scene} {sweep}")
    click.echo(f"  dea-rig run {scene} {sweep} -o {log}")
    click.echo(f"  dea-rig fit {log} -o {folder / 'fit.json'} --report {folder / 'report.html'}")


def _check(film: Film) -> None:
    """Dimensions that are hardly meant are told as the options that they came by."""
    from rig.base.errors import ConfigError
    from rig.base.unusual import slip_of, usual_of
    from rig.scene.specimen import SpecimenTable

    for key in ("disk_radius_mm", "ring_radius_mm", "thickness_um", "prestretch"):
        value, usual = getattr(film, key), usual_of(SpecimenTable.model_fields[key])
        if usual is not None and not usual[0] <= value <= usual[1]:
            raise ConfigError(
                f"--{key.replace('_', '-')} {value:g}: usual are {usual[0]:g} to {usual[1]:g}. "
                f"{slip_of(SpecimenTable, key, value)}".rstrip()
            )
    if not film.disk_radius_mm < film.ring_radius_mm:
        raise ConfigError(
            f"--disk-radius-mm {film.disk_radius_mm:g} and --ring-radius-mm {film.ring_radius_mm:g}: the disk must be "
            "smaller than the ring. Were the two swapped?"
        )


def _found(ports: tuple[str, ...], buses: tuple[str, ...], roles: list[str]) -> Instruments:
    """The keys of the instruments that answer, for these roles."""
    import tomllib

    from drivers.discovery import Bus, discover
    from rig.base.clock import RealClock
    from rig.base.errors import ConfigError

    try:
        named = [Bus.parse(text) for text in buses]
    except ValueError as error:
        raise click.BadParameter(f"{error}.", param_hint="--bus") from None
    everywhere = not (ports or buses)
    answered = discover(RealClock(), None if everywhere else ports, None if everywhere else named)
    found: Instruments = {}
    for role in roles:
        ours = [one for one in answered if one.role == role]
        if len(ours) > 1:
            places = ", ".join(one.where for one in ours)
            raise ConfigError(f"{role}: several instruments answer: {places}. Name the ports and buses: --port, --bus.")
        if ours:
            found[role] = tomllib.loads(ours[0].scene)[role]
    if missing := [role for role in ("stage", "force") if role not in found]:
        raise ConfigError(
            f"No instrument answers as {' and '.join(missing)}; nothing was written. `dea-rig devices` shows who "
            "answers where, and why others do not. A CAN bus is named so: --bus slcan:/dev/ttyACM0@125000."
        )
    return found


def _write(film: Film, folder: Path, instruments: Instruments, *, real: bool) -> list[Path]:
    """All files at once: the folder appears when every protocol has passed `check` on the scene, or not at all."""
    import shutil
    from importlib.resources import as_file, files
    from tempfile import TemporaryDirectory

    from rig.analysis.first_bench import certificate_texts, extent, protocol_texts, scene_text
    from rig.base.errors import ConfigError
    from rig.protocol.experiment import prepare

    reach = extent(film)
    texts = {"scene.toml": scene_text(film, reach, instruments, real=real)}
    for role, text in certificate_texts(reach, instruments, real=real).items():
        texts[f"certificates/{role}.toml"] = text
    protocols = protocol_texts(reach, hv="hv" in instruments)
    texts |= {f"protocols/{name}.toml": text for name, text in protocols.items()}
    try:
        with TemporaryDirectory(prefix=".dea-rig-init-", dir=folder.absolute().parent) as parent:
            part = Path(parent) / folder.name
            with as_file(files("sim_fixtures") / "schema") as schema:
                shutil.copytree(schema, part / "schema")
            for name, text in texts.items():
                (part / name).parent.mkdir(exist_ok=True)
                (part / name).write_text(text, encoding="utf-8")
            for name in protocols:
                prepare(part / "scene.toml", part / "protocols" / f"{name}.toml")
            part.rename(folder)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}.") from None
    return [folder / name for name in texts]
