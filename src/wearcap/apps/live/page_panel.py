"""The panel of the live page: one folder per wearer with steps, devices and numbers, and one of the sinks."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import viser

from wearcap.apps.live.status import LiveControls, LiveStatus, SinkStatus, WearerStatus
from wearcap.apps.web.page_text import MAX_NAME, block, escaped, fitting

MAX_ROWS = 12
_GOOD, _WAITING, _BAD = "#2b8a3e", "#b06a00", "#c92a2a"
STAGE_COLORS = {"waiting": _WAITING, "first minute": _WAITING, "live": _GOOD, "away": _BAD}
SILENT_S = 1.0
"""Time (s) without packets after which a device is marked."""
_TABLE = "width:100%;font-size:12px;line-height:1.45;border-spacing:0;font-variant-numeric:tabular-nums"


def number(value: float, digits: int = 0) -> str:
    """A number, or a dash for one that is not known yet."""
    return f"{value:,.{digits}f}" if math.isfinite(value) else "–"


def row(*cells: str, color: str = "") -> str:
    """A row of a table: a name, broken anywhere if it is long, and numbers to the right."""
    style = f' style="color:{color}"' if color else ""
    others = "".join(f'<td style="text-align:right;padding-left:6px">{cell}</td>' for cell in cells[1:])
    return f'<tr{style}><td style="overflow-wrap:anywhere">{cells[0]}</td>{others}</tr>'


def table(rows: Sequence[str]) -> str:
    return f'<table style="{_TABLE}">{"".join(rows)}</table>'


def wearer_html(wearer: WearerStatus, behind_s: float) -> str:
    """Stage, devices, latency and counts of a wearer."""
    rows = [row("<b>Device</b>", "<b>Rate</b>", "<b>Last</b>")]
    for device in wearer.devices[:MAX_ROWS]:
        silent = not device.last_s_ago <= SILENT_S
        ago = f"{number(device.last_s_ago, 1)} s ago" if silent else "now"
        rows.append(row(escaped(device.title, MAX_NAME), f"{number(device.hz)} Hz", ago, color=_BAD if silent else ""))
    if len(wearer.devices) > MAX_ROWS:
        rows.append(row(f"and {len(wearer.devices) - MAX_ROWS} more"))
    counted = wearer.counts
    delays = [
        row("<b>Latency</b>", "<b>median</b>", "<b>p95</b>", "<b>p99</b>"),
        row("ms", *map(number, wearer.latency)),
    ]
    counts = [
        row("Poses", number(counted.frames), "Dropped", number(counted.dropped)),
        row("Late", number(counted.late), "Gaps", number(counted.gaps)),
        row(
            "Floor (m)",
            "–" if wearer.floor_m is None else f"{wearer.floor_m:.2f}",
            "Page (ms)",
            number(1000 * behind_s),
        ),
    ]
    stage = f'<b style="color:{STAGE_COLORS[wearer.stage]}">● {wearer.stage}</b>'
    notes = "".join(f"<li>{escaped(note)}</li>" for note in wearer.notes[:MAX_ROWS])
    notes = (
        f'<details style="font-size:12px"><summary>How it was set up</summary><ul>{notes}</ul></details>'
        if notes
        else ""
    )
    return block(f"{stage}{table(rows)}{table(delays)}{table(counts)}{notes}")


def sinks_html(sinks: Sequence[SinkStatus]) -> str:
    """States of the sinks."""
    rows = [row("<b>To</b>", "<b>Frames</b>", "<b>Dropped</b>", "<b>Failed</b>")]
    for sink in sinks[:MAX_ROWS]:
        color = _BAD if sink.failed else ""
        rows.append(
            row(escaped(sink.name, MAX_NAME), number(sink.sent), number(sink.dropped), number(sink.failed), color=color)
        )
        if sink.last_error:
            rows.append(f'<tr><td colspan="4" style="color:{_BAD}">{escaped(sink.last_error, 120)}</td></tr>')
    return block(table(rows))


class WearerFolder:
    """A wearer's folder: shown or hidden, the first minute, numbers."""

    def __init__(self, gui: viser.GuiApi, name: str, color: tuple[int, int, int], controls: LiveControls):
        self.folder = gui.add_folder(fitting(name) or "wearer")
        with self.folder:
            self.shown = gui.add_checkbox("Show", initial_value=True)
            self.step = gui.add_html("", visible=False)
            self.progress = gui.add_progress_bar(0.0, visible=False, animated=True, color=color)
            self.skip = gui.add_button("Skip", visible=False, hint="Go on with a default for this step")
            self.redo = gui.add_button("Redo", visible=False, hint="Begin this step again")
            self.guide = gui.add_button("Guide me", hint="Height, floor and seats of the devices, step by step")
            self.numbers = gui.add_html("")
        self.guide.on_click(lambda _: controls.ask("guide", name))
        self.skip.on_click(lambda _: controls.ask("skip", name))
        self.redo.on_click(lambda _: controls.ask("redo", name))

    def update(self, wearer: WearerStatus, behind_s: float) -> None:
        """Show a state; viser sends what has changed."""
        guided = wearer.step is not None
        for handle in (self.step, self.progress, self.skip, self.redo):
            handle.visible = guided
        self.guide.visible = not guided
        if guided:
            self.step.content = block(f'<b style="font-size:17px">{escaped(wearer.step or "")}</b>')
            self.progress.value = min(max(round(100 * wearer.progress), 0), 100)
        self.numbers.content = wearer_html(wearer, behind_s)


class Panel:
    """The whole panel. `update` is called some times a second."""

    def __init__(self, server: viser.ViserServer, controls: LiveControls):
        self.gui, self.controls = server.gui, controls
        self.title = self.gui.add_html(block("Starting: the network is being loaded."))
        self.record = self.gui.add_button("Record", color="red")
        self.stop = self.gui.add_button("Stop the capture", color="gray")
        self.follow = self.gui.add_checkbox("Follow with the camera", initial_value=True)
        self.devices = self.gui.add_checkbox("Devices", initial_value=True)
        self.points = self.gui.add_checkbox("Surroundings", initial_value=True)
        self.wearers: dict[str, WearerFolder] = {}
        self._sinks_folder = self.gui.add_folder("Sinks", order=1e6, visible=False)
        with self._sinks_folder:
            self._sinks = self.gui.add_html("")
        self._recording = False
        self.record.on_click(lambda _: controls.record(not self._recording))
        self.stop.on_click(lambda _: self._stop())

    def _stop(self) -> None:
        self.stop.disabled = self.record.disabled = True
        self.controls.stop()

    def folder(self, name: str, color: tuple[int, int, int]) -> WearerFolder:
        """A wearer's folder, new or known."""
        if name not in self.wearers:
            self.wearers[name] = WearerFolder(self.gui, name, color, self.controls)
        return self.wearers[name]

    def update(
        self, status: LiveStatus, color_of: Callable[[str], tuple[int, int, int]], behind: dict[str, float]
    ) -> None:
        """Show a state; wearers beyond those that the page has room for are left out by the caller."""
        self._recording = status.recording is not None
        self.record.label = "Stop recording" if self._recording else "Record"
        minutes, seconds = divmod(int(status.seconds), 60)
        to = f"Recording to {Path(status.recording).name}" if status.recording is not None else "Not recording"
        self.title.content = block(f"<b>{minutes}:{seconds:02d}</b> &nbsp; {escaped(to)}")
        for wearer in status.wearers:
            self.folder(wearer.name, color_of(wearer.name)).update(wearer, behind.get(wearer.name, 0.0))
        self._sinks_folder.visible = bool(status.sinks)
        self._sinks.content = sinks_html(status.sinks)
