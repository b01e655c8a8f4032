"""``dea-rig analyse``: breakdown, endurance and charge of films, from logs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rig.cli.files import FILE, POSITIVE, tell_written

if TYPE_CHECKING:
    from rich.table import Table

    from calibration.breakdown.intervals import Estimate, Interval
    from calibration.breakdown.study import Study
    from rig.analysis.breakdown_table import Breakdowns


@click.group("analyse")
def command() -> None:
    """Breakdown of many specimens, cycles of one, permittivity by its charge."""


@command.command("breakdown")
@click.argument("files", type=FILE, nargs=-1, required=True)
@click.option("-o", "--out", type=FILE, help="All numbers as JSON, in SI units.")
@click.option("--plot", type=FILE, help="Probability plot, SVG or PNG.")
@click.option("--area-mm2", type=POSITIVE, help="Reference area. Absent: the mean.")
@click.option(
    "--value",
    type=click.Choice(["field", "field-at-disk", "voltage"]),
    default="field",
    show_default=True,
    help="What is taken from logs: the largest field in the film, that at the disk's edge, or the voltage.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of the simulated campaigns.")
@click.option(
    "--simulated", type=click.IntRange(200, 20000), default=1000, show_default=True, help="Campaigns simulated."
)
def breakdown(
    files: tuple[Path, ...],
    out: Path | None,
    plot: Path | None,
    area_mm2: float | None,
    value: str,
    seed: int,
    simulated: int,
) -> None:
    """Weibull statistics of breakdown from FILES: logs of breakdown steps, or CSV or TOML, one row a specimen.

    \b
    Columns: voltage_kV, voltage_V or field_V_per_um; censored (yes: survived up to this value);
    if wanted area_mm2, group, specimen, note, upper_bound (yes: its supply measures no current).
    Logs need nothing more.
    """
    from calibration.breakdown.study import study
    from rig.analysis.breakdown_table import read_breakdowns
    from rig.base.errors import ConfigError
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show

    check_new(out, plot)
    if plot is not None and plot.suffix.lower() not in (".svg", ".png"):
        raise ConfigError(f"{plot}: a picture ends in .svg or .png.")
    table = read_breakdowns(files, area_mm2, value)
    found = study(table.sample, table.groups, seed, simulated)
    show(_fits(table, found))
    for line in _answers(found):
        click.echo(line)
    for warning in (*_of_bounds(table), *found.warnings):
        click.echo(f"Warning: {warning}")
    if out is not None:
        write_text(out, _json(table, found, seed))
    if plot is not None:
        from rig.analysis.breakdown_picture import draw

        draw(table, found, plot)
    tell_written(out, plot)


@command.command("cycles")
@click.argument("logs", type=FILE, nargs=-1, required=True)
@click.option("-o", "--out", type=FILE, help="One row a cycle as CSV or Parquet, by the ending; units in the headings.")
@click.option("--plot", type=FILE, help="Peak force, response and loop area over the cycles: SVG or PNG.")
@click.option("--step", type=click.IntRange(min=1), help="Step of the protocol. Absent: the only one that cycles.")
def cycles(logs: tuple[Path, ...], out: Path | None, plot: Path | None, step: int | None) -> None:
    """Every cycle of LOGS: those of a run and of the runs that went on with it; each must be there once."""
    from rig.analysis.cycles import as_table, read_cycles
    from rig.base.errors import ConfigError
    from rig.base.outputs import check_new
    from rig.cli.show import show
    from rig.log.export import check_format, write_table

    check_new(out, plot)
    if out is not None:
        check_format(out)
    if plot is not None and plot.suffix.lower() not in (".svg", ".png"):
        raise ConfigError(f"{plot}: a picture ends in .svg or .png.")
    found = read_cycles(logs, step)
    show(as_table(found))
    for line in found.remarks:
        click.echo(line)
    if out is not None:
        write_table(found.columns, out)
    if plot is not None:
        from rig.analysis.cycles_picture import draw

        draw(found, plot)
    tell_written(out, plot)


@command.command("charge")
@click.argument("logs", type=FILE, nargs=-1, required=True)
@click.option("-o", "--out", type=FILE, help="All numbers as JSON, in SI units.")
def charge(logs: tuple[Path, ...], out: Path | None) -> None:
    """Permittivity and leakage of one film from the current that charges it while the voltage rises in LOGS."""
    import json

    from calibration.electrical.charge import charge_as_json
    from rig.analysis.charge import as_tables, permittivity_of
    from rig.base.outputs import check_new, write_text
    from rig.cli.show import show

    check_new(out)
    found = permittivity_of(logs)
    show(as_tables(found))
    if out is not None:
        write_text(out, json.dumps(charge_as_json(found), indent=2, allow_nan=False) + "\n")
    tell_written(out)


def _fits(table: Breakdowns, found: Study) -> Table:
    from rich.table import Table

    unit, factor = ("kV", 1e-3) if table.unit == "V" else ("V/um", 1e-6)
    area = "" if table.reference_area is None else f" at {table.reference_area * 1e6:.3g} mm2"
    view = Table(
        title=f"Weibull fits by maximum likelihood{area}",
        caption="In brackets 95 % intervals by profile likelihood, calibrated by simulated campaigns of this design; "
        "below them those by bootstrap.",
    )
    for heading in ("", "n", "failed"):
        view.add_column(heading, no_wrap=True)
    for heading in ("shape", f"scale / {unit}", f"10 % fail below / {unit}", "shape too high by"):
        view.add_column(heading, justify="right")
    for name, fit in {"all": found.weibull, **found.group_fits}.items():
        view.add_row(
            name,
            str(fit.specimens),
            str(fit.failures),
            _with_ends(fit.shape, 1.0),
            _with_ends(fit.scale, factor),
            _with_ends(fit.low_quantile, factor),
            f"{fit.shape_bias - 1:.0%}",
        )
    return view


def _with_ends(estimate: Estimate, factor: float) -> str:
    return f"{estimate.value * factor:.4g} {_ends(estimate.profile, factor)}\n{_ends(estimate.bootstrap, factor)}"


def _ends(interval: Interval, factor: float = 1.0) -> str:
    return f"({interval.low * factor:.4g} to {interval.high * factor:.4g})"


def _answers(found: Study) -> list[str]:
    location, lognormal = found.location, found.lognormal
    lines = [
        f"Three parameters: location {location.location / found.weibull.scale.value:.2f} of the scale, "
        f"shape {location.shape:.3g}; better than two by chance: p = {location.p_none:.3f}.",
        f"Weibull against lognormal: ln of the likelihood ratio {lognormal.log_ratio:+.2f}; wrong choice in "
        f"{lognormal.wrong_if_weibull:.0%} (if Weibull) and {lognormal.wrong_if_lognormal:.0%} (if lognormal).",
    ]
    if found.area is not None:
        lines.append(
            f"Area: hazard grows as area^{found.area.exponent:.2f} {_ends(found.area.interval)}; weakest link (1) "
            f"p = {found.area.p_weakest_link:.3f}, no influence (0) p = {found.area.p_no_influence:.3f}."
        )
    compared = found.groups or found.halves
    if compared is not None:
        pairs = list(zip(compared.names, compared.scale_ratio, compared.scale_ratio_interval, strict=True))[1:]
        ratios = "; ".join(f"{name} {ratio:.3f} {_ends(ends)}" for name, ratio, ends in pairs)
        lines.append(
            f"Scale against {compared.names[0]}: {ratios}. Same scale: p = {compared.p_scale:.3f}; same shape: "
            f"p = {compared.p_shape:.3f}. Power to see 20 % in scale: {compared.power:.0%}."
        )
    return lines


def _of_bounds(table: Breakdowns) -> list[str]:
    bounds, failed = sum(table.upper_bound), int(table.sample.failed.sum())
    if not bounds:
        return []
    return [
        f"{bounds} of {failed} failures come from supplies that measure no current. Their values are upper bounds and "
        "count as exact here: the true scale may be lower, and the shape may be off either way."
    ]


def _json(table: Breakdowns, found: Study, seed: int) -> str:
    import json
    from dataclasses import asdict

    facts: dict[str, Any] = {
        "unit": table.unit,
        "reference_area_m2": table.reference_area,
        "seed": seed,
        "level": 0.95,
        "upper_bounds_taken_as_exact": sum(table.upper_bound),
        "specimens": [
            {"specimen": name, "value": float(at), "failed": bool(failed), "upper_bound": bound}
            for name, at, failed, bound in zip(
                table.names, table.sample.value, table.sample.failed, table.upper_bound, strict=True
            )
        ],
        **asdict(found),
    }
    return json.dumps(_finite(facts), indent=2, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    """JSON knows no infinity: an open end of an interval is null."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    if isinstance(value, float):
        return float(value) if value - value == 0 else None
    return value
