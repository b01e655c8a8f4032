"""A log as a Rerun recording: curves over time, the force-displacement loop, the film.

Rerun recordings are throw-away products of a log; the log stays the record.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from model.membrane.solve import profiles
from rig.base.errors import ConfigError
from rig.base.text import printable
from rig.base.toml_file import parse_table
from rig.log.dataset import Run
from rig.scene.scene import Scene

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

    from model.specimen import Specimen

TIMELINE = "run"

# Where things are in the recording.
FORCE, DISPLACEMENT, VOLTAGE, PHASES, LOOP, FILM, EVENTS, ABOUT = (
    "force",
    "displacement",
    "voltage",
    "phases",
    "loop",
    "film",
    "events",
    "about",
)

INK = (170, 176, 186)
ACCENT = (255, 196, 61)
SERIES = {FORCE: (86, 180, 233), DISPLACEMENT: (0, 190, 140), VOLTAGE: (240, 120, 90)}
# Colour-blind safe (Okabe & Ito), for one voltage each.
VOLTAGES = ((86, 180, 233), (230, 159, 0), (213, 94, 80), (204, 121, 167), (0, 158, 115), (240, 228, 66))
DIRECTIONS = {1: "loading", -1: "unloading", 0: "standing"}

LOOP_SIZE = (400.0, 280.0)  # of the plot, in the view's own units
FILM_INSTANTS = 50
RINGS, SECTORS = 24, 72


def write_recording(run: Run, path: Path) -> None:
    import rerun as rr

    film = _film(run)
    recording = rr.RecordingStream("dea_rig", recording_id=run.log.path.name)
    recording.save(path, default_blueprint=_blueprint(run, film))
    recording.send_recording_name(run.log.path.name)
    _add_series(recording, run)
    _add_phases(recording, run)
    _add_loop(recording, run)
    _add_film(recording, film)
    _add_events(recording, run)
    recording.log(ABOUT, rr.TextDocument(_about(run), media_type=rr.MediaType.MARKDOWN), static=True)
    recording.flush()
    recording.disconnect()


def _blueprint(run: Run, film: _Film) -> rrb.Blueprint:
    import rerun as rr
    import rerun.blueprint as rrb

    margin = 0.02 * (run.t[-1] - run.t[0])
    start, end = (rr.TimeRangeBoundary.absolute(seconds=float(t)) for t in (run.t[0] - margin, run.t[-1] + margin))
    axis = rrb.TimeAxis(view_range=rr.TimeRange(start, end))
    legend = rrb.PlotLegend(visible=False)
    titles = {FORCE: "Force / N", DISPLACEMENT: "Displacement / mm"}
    if run.has_hv:
        titles[VOLTAGE] = "Voltage / V (thin: set-point)"
    plots: list[Any] = [
        rrb.TimeSeriesView(origin=origin, name=title, axis_x=axis, plot_legend=legend)
        for origin, title in titles.items()
    ]
    lanes = rrb.StateTimelineView(origin=PHASES, name="Protocol", time_view=axis)
    width, height = LOOP_SIZE
    loop = rrb.Spatial2DView(
        origin=LOOP,
        name="Force over displacement",
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.16 * width, 1.12 * width), y_range=(-1.1 * height, 0.22 * height)),
    )
    size = float(film.r.max(initial=1.0))
    film_view = rrb.Spatial3DView(
        origin=FILM,
        name=film.title,
        eye_controls=rrb.EyeControls3D(
            position=(1.1 * size, -1.5 * size, 1.1 * size), look_target=(0.0, 0.0, 0.15 * size), eye_up=(0.0, 0.0, 1.0)
        ),
        line_grid=rrb.LineGrid3D(visible=False),
    )
    notes = rrb.Tabs(
        rrb.TextLogView(
            origin=EVENTS,
            name="Events and commands",
            columns=rrb.TextLogColumns(
                timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)],
                text_log_columns=["LogLevel", "Body"],
            ),
        ),
        rrb.TextDocumentView(origin=ABOUT, name="About this run"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*plots, lanes, row_shares=[3.0] * len(plots) + [2.4]),
            rrb.Vertical(loop, film_view, notes, row_shares=[4.0, 4.0, 2.4]),
            column_shares=[5.0, 4.0],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _add_series(recording: rr.RecordingStream, run: Run) -> None:
    series = {FORCE: (run.t, run.force), DISPLACEMENT: (run.t, run.h * 1e3)}
    if run.has_hv:
        hv = run.log.columns("/hv/sample")
        series[f"{VOLTAGE}/measured"] = (hv["t_s"], hv["voltage_V"])
        series[f"{VOLTAGE}/asked"] = (hv["t_s"], hv["setpoint_V"])
    for path, (t, values) in series.items():
        _add_line(recording, path, t, values)


def _add_line(recording: rr.RecordingStream, path: str, t: NDArray[np.float64], values: NDArray[np.float64]) -> None:
    import rerun as rr

    thin = path.endswith("asked")
    colour = INK if thin else SERIES[path.split("/")[0]]
    recording.log(path, rr.SeriesLines(colors=colour, names=path, widths=1.0 if thin else 2.0), static=True)
    recording.send_columns(path, indexes=[time_column(t)], columns=rr.Scalars.columns(scalars=values))


def _add_phases(recording: rr.RecordingStream, run: Run) -> None:
    """Lanes of what the protocol was doing: step, direction, nominal voltage."""
    import rerun as rr

    t = np.array([phase.t for phase in run.phases])
    lanes = {
        "step": [f"{phase.step} {printable(phase.kind)}" for phase in run.phases],
        "direction": [DIRECTIONS.get(phase.direction, "?") for phase in run.phases],
    }
    if run.has_hv:
        lanes["voltage"] = [f"{phase.voltage:g} V" for phase in run.phases]
        values = [f"{voltage:g} V" for voltage in _voltages(run)]
        colours = [_colour(run, voltage) for voltage in _voltages(run)]
        recording.log(f"{PHASES}/voltage", rr.StateConfiguration(values=values, colors=colours), static=True)
    for name, states in lanes.items():
        changed = [k for k in range(len(states)) if k == 0 or states[k] != states[k - 1]]
        recording.send_columns(
            f"{PHASES}/{name}",
            indexes=[time_column(t[changed])],
            columns=rr.StateChange.columns(state=[states[k] for k in changed]),
        )


def _add_loop(recording: rr.RecordingStream, run: Run) -> None:
    """The recorded loops with axes of our own, since the viewer has no plot of one quantity over another."""
    import rerun as rr

    usable = np.isfinite(run.h) & np.isfinite(run.force) & ~run.flagged
    recorded = np.array([phase.record for phase in run.phases] + [False])[run.phase] & usable
    shown = recorded if recorded.any() else usable
    if not shown.any():
        return
    ticks_h, ticks_f = _ticks(run.h[shown] * 1e3), _ticks(run.force[shown])

    def place(h_mm: Any, force: Any) -> NDArray[np.float64]:
        x = (np.asarray(h_mm) - ticks_h[0]) / (ticks_h[-1] - ticks_h[0]) * LOOP_SIZE[0]
        y = (np.asarray(force) - ticks_f[0]) / (ticks_f[-1] - ticks_f[0]) * LOOP_SIZE[1]
        return np.stack(np.broadcast_arrays(x, -y), axis=-1)

    grid = [place([h, h], ticks_f[[0, -1]]) for h in ticks_h] + [place(ticks_h[[0, -1]], [f, f]) for f in ticks_f]
    recording.log(
        f"{LOOP}/axes", rr.LineStrips2D(grid, colors=[(70, 74, 80)], radii=rr.Radius.ui_points(0.5)), static=True
    )
    right, down = np.array([LOOP_SIZE[0], 0.0]), np.array([0.0, LOOP_SIZE[1]])
    below = place(ticks_h, ticks_f[0]) + 0.06 * down
    beside = place(ticks_h[0], ticks_f) - 0.06 * right
    titles = [place(ticks_h.mean(), ticks_f[0]) + 0.15 * down, place(ticks_h[0], ticks_f[-1]) - 0.08 * down]
    labels = [f"{h:g}" for h in ticks_h] + [f"{f:g}" for f in ticks_f] + ["displacement / mm", "force / N"]
    recording.log(
        f"{LOOP}/labels",
        rr.Points2D(
            [*below, *beside, *titles],
            labels=labels,
            colors=[INK],
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        ),
        static=True,
    )
    for voltage in _voltages(run):
        of_voltage = np.array([phase.voltage == voltage for phase in run.phases] + [False])[run.phase] & shown
        rows = np.flatnonzero(of_voltage)
        if not rows.size:
            continue
        pieces = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        strips = [place(run.h[piece] * 1e3, run.force[piece]) for piece in pieces if piece.size > 1]
        colour, name = _colour(run, voltage), f"{LOOP}/{voltage:g}_V"
        recording.log(name, rr.LineStrips2D(strips, colors=[colour], radii=rr.Radius.ui_points(0.8)), static=True)
        farthest = rows[np.argmax(run.h[rows])]
        recording.log(
            f"{name}/label",
            rr.Points2D(
                [place(run.h[farthest] * 1e3, run.force[farthest]) + 0.07 * right],
                labels=[f"{voltage:g} V"],
                colors=[colour],
                radii=rr.Radius.ui_points(0.0),
                show_labels=True,
            ),
            static=True,
        )
    rows = np.flatnonzero(usable)[:: max(1, usable.sum() // 5000)]
    recording.log(f"{LOOP}/now", rr.Points2D.from_fields(colors=[ACCENT], radii=rr.Radius.ui_points(5.0)), static=True)
    recording.send_columns(
        f"{LOOP}/now",
        indexes=[time_column(run.t[rows])],
        columns=rr.Points2D.columns(positions=place(run.h[rows] * 1e3, run.force[rows])),
    )


class _Film(NamedTuple):
    """Meridians to draw, in millimetres: (instants, rings) each; ``share`` is 0 to 1 of what the colour shows."""

    t: NDArray[np.float64]
    r: NDArray[np.float64]
    z: NDArray[np.float64]
    share: NDArray[np.float64]
    title: str


def _film(run: Run) -> _Film:
    """The film at some instants, as the scene's material has it at the displacement and voltage logged then."""
    nothing = np.empty((0, RINGS + 1))
    specimen = _specimen(run)
    rows = _film_rows(run)
    if specimen is None or not rows.size:
        return _Film(np.empty(0), nothing, nothing, nothing, "Film (not known)")
    shape = profiles(specimen, run.h[rows], np.maximum(run.voltage[rows], 0.0), RINGS + 1)
    taut = np.isfinite(shape.r).all(axis=1)
    shown, unit = (shape.field[taut] * 1e-6, "V/µm") if run.has_hv else (shape.thinning[taut], "times")
    low, high = 0.0 if run.has_hv else 1.0, float(shown.max(initial=1.0))
    what = "true electric field" if run.has_hv else "thinning"
    title = f"Film of the scene's material; {what}: dark {low:g}, yellow {high:.3g} {unit}"
    share = (shown - low) / max(high - low, 1e-30)
    return _Film(run.t[rows[taut]], shape.r[taut] * 1e3, shape.z[taut] * 1e3, share, title)


def _add_film(recording: rr.RecordingStream, film: _Film) -> None:
    import rerun as rr

    if not film.t.size:
        return
    angle = np.linspace(0.0, 2.0 * np.pi, SECTORS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(SECTORS)], axis=-1)
    up = np.array([0.0, 0.0, 1.0])

    def turned(radial: NDArray[np.float64], axial: NDArray[np.float64]) -> NDArray[np.float64]:
        """(instants, rings) to vectors of shape (instants, rings, sectors, 3)."""
        vectors: NDArray[np.float64] = radial[:, :, None, None] * circle + axial[:, :, None, None] * up
        return vectors

    positions = turned(film.r, film.z)
    normals = turned(-np.gradient(film.z, axis=1), np.gradient(film.r, axis=1))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colours = np.repeat(_heat(film.share)[:, :, None, :], SECTORS, axis=2)
    recording.log(f"{FILM}/surface", rr.Mesh3D.from_fields(triangle_indices=_triangles()), static=True)
    recording.send_columns(
        f"{FILM}/surface",
        indexes=[time_column(film.t)],
        columns=rr.Mesh3D.columns(
            vertex_positions=positions.reshape(-1, 3).astype(np.float32),
            vertex_normals=normals.reshape(-1, 3).astype(np.float32),
            vertex_colors=colours.reshape(-1, 3),
        ).partition([(RINGS + 1) * SECTORS] * film.t.size),
    )
    closed = np.concatenate([positions, positions[:, :, :1]], axis=2)[:, :: RINGS // 6]  # some of the circles
    for k in range(closed.shape[1]):
        edge = k in (0, closed.shape[1] - 1)
        style = rr.LineStrips3D.from_fields(
            colors=[INK if edge else (40, 44, 50)], radii=rr.Radius.ui_points(2.0 if edge else 0.6)
        )
        recording.log(f"{FILM}/circle_{k}", style, static=True)
        recording.send_columns(
            f"{FILM}/circle_{k}",
            indexes=[time_column(film.t)],
            columns=rr.LineStrips3D.columns(strips=list(closed[:, k].astype(np.float32))),
        )


def _specimen(run: Run) -> Specimen | None:
    """The specimen of the scene in the log; None when there is no scene that this version understands."""
    if "scene.toml" not in run.log.attachments:
        return None
    try:
        return parse_table(run.scene, Scene, "scene", f"{run.log.path} (scene.toml inside)").specimen.specimen()
    except ConfigError:
        return None


def _film_rows(run: Run) -> NDArray[np.intp]:
    """Instants to draw: evenly spread over the time in which the displacement is known, the farthest one included."""
    known = np.flatnonzero(np.isfinite(run.h) & np.isfinite(run.voltage) & (run.h >= 0.0))
    if not known.size:
        return known
    even = known[np.linspace(0, known.size - 1, FILM_INSTANTS).astype(np.intp)]
    return np.unique([*even, known[np.argmin(np.abs(run.t[known] - best_instant(run)))]])


def _triangles() -> NDArray[np.uint32]:
    ring, sector = np.meshgrid(np.arange(RINGS), np.arange(SECTORS), indexing="ij")
    a, b = ring * SECTORS + sector, ring * SECTORS + (sector + 1) % SECTORS
    quads = np.stack([a, b, b + SECTORS, a, b + SECTORS, a + SECTORS], axis=-1)
    return quads.reshape(-1, 3).astype(np.uint32)


def _heat(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """From dark blue over teal to yellow, rising in lightness (after the viridis map)."""
    stops = np.array([(68, 60, 130), (49, 104, 142), (31, 158, 137), (110, 205, 88), (253, 231, 37)], dtype=np.float64)
    at = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(share, at, stops[:, channel]) for channel in range(3)], axis=-1).astype(np.uint8)


def _add_events(recording: rr.RecordingStream, run: Run) -> None:
    import rerun as rr

    levels = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
    rows = [
        (m.fields["t_s"], levels.get(m.fields["severity"], "INFO"), f"{m.fields['source']}: {m.fields['message']}")
        for m in run.log.messages("/event")
    ]
    rows += [
        (m.fields["t_s"], "DEBUG", f"{m.fields['device']}: {m.fields['command']} {m.fields['argument']}")
        for m in run.log.messages("/command")
    ]
    rows += [(r.t, "INFO", f"{r.name} = {r.value:.6g} ± {r.standard_uncertainty:.2g} {r.unit}") for r in run.references]
    rows.sort(key=lambda row: row[0])
    if rows:
        times, names, texts = zip(*rows, strict=True)
        recording.send_columns(
            EVENTS,
            indexes=[time_column(np.array(times))],
            columns=rr.TextLog.columns(
                text=[f"{t:8.2f} s   {printable(text)}" for t, text in zip(times, texts, strict=True)],
                level=list(names),
            ),
        )


def _about(run: Run) -> str:
    """The run in words, as Markdown."""
    log = run.log
    lines = [f"# {printable(log.path.name)}", ""]
    for title, table in (("Run", log.metadata.get("run", {})), ("Outcome", log.outcome or {"status": "cut short"})):
        lines += [f"## {title}", "", *(f"- {printable(k)}: {printable(v)}" for k, v in table.items() if v), ""]
    lines += ["## Messages", "", *(f"- {topic}: {count}" for topic, count in log.topics.items()), ""]
    if not log.whole:
        lines += ["## What could not be read", ""]
        lines += [f"- bytes {gap.start} to {gap.end}: {gap.reason}" for gap in log.gaps]
        lines += [f"- {topic}: {count} messages missing" for topic, count in log.missing.items()]
    return "\n".join(lines)


def time_column(t: NDArray[np.float64]) -> rr.TimeColumn:
    import rerun as rr

    return rr.TimeColumn(TIMELINE, duration=t)


def _voltages(run: Run) -> list[float]:
    return sorted({phase.voltage for phase in run.phases})


def _colour(run: Run, voltage: float) -> tuple[int, int, int]:
    return VOLTAGES[_voltages(run).index(voltage) % len(VOLTAGES)]


def _ticks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round numbers that enclose ``values``, zero among them where it is near."""
    low, high = min(0.0, float(values.min())), max(0.0, float(values.max()))
    span = max(high - low, 1e-9)
    high = low + span
    if low > -0.06 * span:
        low = 0.0
    step = 10.0 ** np.floor(np.log10(span / 3))
    step *= next(factor for factor in (1, 2, 5, 10) if span / (factor * step) <= 6)
    ticks: NDArray[np.float64] = step * np.arange(np.floor(low / step + 1e-9), np.ceil(high / step - 1e-9) + 1)
    return ticks


def best_instant(run: Run) -> float:
    """When the film is farthest out, at the highest voltage at which that happens."""
    if not np.isfinite(run.h).any():
        return float(run.t[-1])
    far = np.flatnonzero(run.h >= 0.98 * np.nanmax(run.h))
    if not far.size:  # all displacements are negative
        far = np.array([np.nanargmax(run.h)])
    voltage = np.nan_to_num(run.voltage[far])
    return float(run.t[far[np.argmax(voltage >= 0.98 * voltage.max())]])
