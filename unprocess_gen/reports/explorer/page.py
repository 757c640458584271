"""Draw the page with Bokeh: controls, pictures with linked zoom, curves, and what ``plan`` says.

A page on a server recomputes its pair when a control changes; a saved page shows one state. Both have the template
``explorer.html`` and need no network: the scripts come from the installed Bokeh.
"""

from __future__ import annotations

import base64
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.embed import file_html
from bokeh.models import (
    Button,
    ColumnDataSource,
    CustomJS,
    Div,
    HoverTool,
    PanTool,
    Range1d,
    ResetTool,
    Select,
    TextInput,
    WheelZoomTool,
)
from bokeh.plotting import figure
from bokeh.resources import INLINE

from unprocess_gen.core.errors import UnprocessGenError
from unprocess_gen.reports.dataset_page.statistics import MEANINGS, SITE_COLUMNS
from unprocess_gen.reports.explorer import views
from unprocess_gen.reports.explorer.controls import NONE, SECTIONS, SETTINGS, WEIGHTS, shown_value, widget
from unprocess_gen.reports.explorer.exploration import Exploration, Shown
from unprocess_gen.reports.explorer.opening import Choices
from unprocess_gen.reports.html_pages import page_template, render_macro, render_page

PAGE_TEMPLATE = "explorer.html"
LINE_COLOURS = {"red": "#d1495b", "green": "#2e8b57", "blue": "#2f6db5", "clean": "#0072b2", "noisy": "#d55e00"}
PLOTS = {
    "source_histogram": ("Histogram of the source", "code", "share of the pixels"),
    "raw_histogram": ("Histogram of the raw frames", "DN", "share of the sites"),
    "highlight": ("Highlight function (Figure 4)", "intensity i of grey light", "f(i)"),
    "transfer": ("Photon transfer", "signal above black, DN", "variance of the noise, DN²"),
}
"""Titles and axes."""
MOVES = {
    "+": (2, 0, 0), "−": (0.5, 0, 0), "←": (1, -0.5, 0), "→": (1, 0.5, 0),
    "↑": (1, 0, -0.5), "↓": (1, 0, 0.5), "all": (0, 0, 0),
}  # fmt: skip
"""Buttons: zoom, and shares of the window by which it moves to the right and down."""
SMALLEST_PX = 8
"""Fewest sites of a side of the window."""
STRETCHES = ("common stretch", "own stretch")
SAVED_PX = (240, 320)
"""Most rows and columns of a picture in a saved page, of which each pixel takes 50 bytes."""

WAIT_MS = 20
"""Time in which changes are collected before the pair is computed."""


class Page:
    """The models of one page, and the state that they show."""

    def __init__(self, choices: Choices, label: str, saved: bool = False) -> None:
        self._choices, self._most = choices, SAVED_PX if saved else views.VIEW_PX
        self._state: Exploration = choices[label]()
        self._shown: Shown | None = None
        self._document: Document | None = None
        self._syncing, self._waiting = False, set[Callable[[], None]]()
        self._pixels = ColumnDataSource()
        self._x, self._y = Range1d(0, 1), Range1d(1, 0)
        self._message, self._facts, self._plan = map(_text_box, ("message", "facts", "plan"))
        self._pictures = {name: self._picture(name) for name in views.PICTURES}
        self._lines = {name: ColumnDataSource({"xs": [], "ys": [], "label": [], "colour": []}) for name in PLOTS}
        self._curves = {name: self._curve(name) for name in PLOTS}
        self._points = ColumnDataSource({"x": [], "y": []})
        self._curves["transfer"].scatter("x", "y", source=self._points, size=3, alpha=0.5, color=LINE_COLOURS["clean"])
        self._command = TextInput(name="command", title="Command of this pair")
        self._stretch = Select(name="stretch", title="raw and developed", options=list(STRETCHES), value=STRETCHES[0])
        self._open = Select(name="open", title="photograph or row", options=list(choices), value=label)
        self._part = Select(name="part", title="pair of the image")
        self._other = TextInput(name="other", title="other settings")
        self._other.placeholder = "source.downscale=2 output.dtype=float32"
        self._file = ColumnDataSource({"name": [], "content": []}, name="file")
        self._widgets: dict[str, Any] = {}

    # -------------------------------------------------------------------------------------------------------- figures

    def _picture(self, name: str) -> Any:
        size = {"width": 300, "height": 200, "sizing_mode": "scale_width", "min_border": 0}
        ranges = {"x_range": self._x, "y_range": self._y, "outline_line_color": None, "toolbar_location": None}
        wheel = WheelZoomTool()
        drawn = figure(name=name, tools=[PanTool(), ResetTool(), wheel], active_scroll=wheel, **size, **ranges)
        drawn.axis.visible = drawn.grid.visible = False
        renderer = drawn.image_rgba(name, "x", "y", "dw", "dh", source=self._pixels)
        tips = [
            ("site", "column $x{%d}, row $y{%d}"),
            ("source", "@r, @g, @b"),
            ("clean", "@clean_dn{0.[0]} DN"),
            ("noisy", "@noisy_dn{0.[0]} DN"),
            ("values", "@note"),
        ]
        whole = {"$x": "printf", "$y": "printf"}  # other formats round, to the next site
        drawn.add_tools(HoverTool(renderers=[renderer], tooltips=tips, point_policy="follow_mouse", formatters=whole))
        return drawn

    def _curve(self, name: str) -> Any:
        title, x, y = PLOTS[name]
        is_histogram = "histogram" in name
        size = {"width": 420, "height": 260, "sizing_mode": "stretch_width", "tools": "pan,wheel_zoom,box_zoom,reset"}
        scale = {"y_axis_type": "log", "y_range": (1e-6, 1)} if name == "raw_histogram" else {}
        drawn = figure(name=name, title=title, **size, **scale)
        drawn.xaxis.axis_label, drawn.yaxis.axis_label = x, y
        drawn.toolbar.logo, drawn.toolbar.autohide = None, True
        drawn.multi_line("xs", "ys", source=self._lines[name], color="colour", line_width=1.5, legend_field="label")
        drawn.legend.update(location="top_right" if is_histogram else "top_left", background_fill_alpha=0.6)
        drawn.legend.update(label_text_font_size="9pt", padding=3, spacing=0, margin=3)
        return drawn

    # ---------------------------------------------------------------------------------------------------------- state

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Show the sentence of an error in the page."""
        try:
            yield
        except UnprocessGenError as error:
            self._say(str(error))

    def _update(self) -> None:
        """Compute the pair, draw everything, and set the controls."""
        with self._reported():
            self._draw(self._state.shown())
            self._sync()

    def _draw(self, shown: Shown) -> None:
        is_new = self._shown is None or shown.clean.shape != self._shown.clean.shape
        self._shown = shown
        if is_new:
            height, width = shown.clean.shape
            for drawn in self._pictures.values():
                drawn.aspect_ratio = width / height
            self._go(0, width, 0, height)
        self._draw_view()
        self._draw_statistics(shown)
        self._command.value = self._state.command
        differs = self._state.digests not in (None, (str(shown.row["clean_xxh3"]), str(shown.row["noisy_xxh3"])))
        self._say("the pair differs from its row: its source or the settings have changed" if differs else "")

    def _window(self) -> tuple[slice, slice]:
        """The sites in view, from even rows and columns."""
        assert self._shown is not None
        ends = sorted((self._y.start, self._y.end)), sorted((self._x.start, self._x.end))
        parts = []
        for (low, high), length in zip(ends, self._shown.clean.shape, strict=True):
            start = max(0, min(int(low), length - SMALLEST_PX)) // 2 * 2
            parts.append(slice(start, max(start + 1, min(length, int(high) + 2))))
        return parts[0], parts[1]

    def _draw_view(self) -> None:
        if self._shown is None:  # the first settings are wrong
            return
        columns = views.view(self._shown, self._window(), self._stretch.value == STRETCHES[0], self._most)
        self._pixels.data = {name: [value] for name, value in columns.items()}

    def _draw_statistics(self, shown: Shown) -> None:
        transfer = views.photon_transfer(shown)
        curves = {
            "source_histogram": views.source_histogram(shown),
            "raw_histogram": views.raw_histogram(shown),
            "highlight": views.highlight_curves(shown),
            "transfer": {"expected": transfer.line},
        }
        for name, lines in curves.items():
            colours = [LINE_COLOURS.get(label.partition(",")[0], LINE_COLOURS["noisy"]) for label in lines]
            xs, ys = ([list(line[axis]) for line in lines.values()] for axis in (0, 1))
            if name == "raw_histogram":
                ys = [[share or None for share in line] for line in ys]
            self._lines[name].data = {"xs": xs, "ys": ys, "label": list(lines), "colour": colours}
        self._points.data = {"x": transfer.points[0], "y": transfer.points[1]}
        self._facts.text = render_macro("facts", _pair_facts(shown, transfer.text))
        self._plan.text = render_macro("lines", "\n".join(shown.lines))

    def _say(self, sentence: str) -> None:
        self._message.text = render_macro("alert", sentence) if sentence else ""

    # -------------------------------------------------------------------------------------------------------- controls

    def _go(self, left: float, right: float, top: float, bottom: float) -> None:
        self._x.update(start=left, end=right)
        self._y.update(start=bottom, end=top)

    def _move(self, zoom: float, right: float, down: float) -> None:
        """Zoom around the centre, or move by a share of the window; a zoom of 0 shows the complete frame."""
        if self._shown is None:
            return
        height, width = self._shown.clean.shape
        if not zoom:
            self._go(0, width, 0, height)
            return
        x, y = (self._x.start + self._x.end) / 2, (self._y.start + self._y.end) / 2
        half = max(abs(self._x.end - self._x.start) / zoom, SMALLEST_PX) / 2
        tall = half * height / width
        x, y = x + right * half, y + down * tall
        self._go(x - half, x + half, y - tall, y + tall)

    def document(self, document: Document) -> None:
        """Fill a document of the server."""
        self._document = document
        document.title, document.template = "unprocess_gen explorer", page_template(PAGE_TEMPLATE)
        roots = [self._message, self._facts, self._plan, *self._pictures.values(), *self._curves.values()]
        folders, names = self._state.composition.own_folders, itertools.chain(*SECTIONS.values())
        self._widgets = {name: widget(name, folders) for name in names}
        for name, control in self._widgets.items():
            control.name = name
            control.on_change("value", partial(self._changed, name))
        inputs = [*self._widgets.values(), self._open, self._part, self._other, self._stretch, self._command]
        for control in inputs:
            control.sizing_mode = "stretch_width"
        self._open.on_change("value", self._opened)
        self._part.on_change("value", self._chosen_part)
        self._other.on_change("value", self._typed)
        self._stretch.on_change("value", lambda attr, old, new: self._draw_view())
        for end in (self._x, self._y):
            for side in ("start", "end"):
                end.on_change(side, lambda attr, old, new: self._later(self._draw_view))
        for model in (*roots, *inputs, *self._buttons()):
            document.add_root(model)
        document.template_variables.update(_variables(live=True))
        self._update()

    def _buttons(self) -> list[Button]:
        copy = Button(label="Copy the command", name="copy", button_type="primary")
        copy.js_on_click(
            CustomJS(args={"text": self._command, "file": self._file}, code="navigator.clipboard.writeText(text.value)")
        )
        buttons = [copy]
        for form in ("npy", "dng"):
            save = Button(label=f"Save the pair as {form.upper()}", name=f"save_{form}")
            save.on_click(partial(self._save, form))
            buttons.append(save)
        self._file.js_on_change("data", CustomJS(args={"file": self._file}, code=render_page("explorer_save.js")))
        for number, (label, move) in enumerate(MOVES.items()):
            button = Button(label=label, name=f"move_{number}", width=48)
            button.on_click(lambda move=move: self._move(*move))
            buttons.append(button)
        return buttons

    def _later(self, task: Callable[[], None]) -> None:
        """Run a task once after the changes that have arrived."""
        if task in self._waiting or self._document is None:
            return
        self._waiting.add(task)

        def run() -> None:
            self._waiting.remove(task)
            task()

        self._document.add_timeout_callback(run, WAIT_MS)

    def _changed(self, name: str, attr: str, old: Any, new: Any) -> None:
        if self._syncing:
            return
        if name in WEIGHTS:
            values = [f"{self._widgets[weight].value:.6g}" for weight in WEIGHTS]
            self._state.settings["camera.weights"] = f"[{','.join(values)}]"
        elif name not in SETTINGS:
            self._state.choose(name, None if new == NONE else new)
        elif name.startswith("effects.") and new == "null":
            self._state.settings.pop(name, None)
        else:
            self._state.settings[name] = f"{new:.6g}" if isinstance(new, float | int) else new.strip() or "null"
        self._later(self._update)

    def _opened(self, attr: str, old: Any, new: str) -> None:
        with self._reported():
            self._state, self._shown = self._choices[new](), None
            self._later(self._update)

    def _chosen_part(self, attr: str, old: Any, new: str) -> None:
        if not self._syncing and "-" in new:
            self._state.part = new[new.index("-") :]
            self._later(self._update)

    def _typed(self, attr: str, old: Any, new: str) -> None:
        if not self._syncing:
            self._state.add(new.split())
            self._later(self._update)

    def _sync(self) -> None:
        """Set the controls to the values of the pair, in one message to the browser."""
        shown, document, choices = self._shown, self._document, self._state.composition.choices
        assert shown is not None and document is not None
        self._syncing = True
        document.hold("combine")
        for name, control in self._widgets.items():
            value = shown_value(name, self._state.settings, choices, shown.config, shown.plan)
            if isinstance(control, Select) and value not in control.options:
                control.options = [*control.options, value]
            if isinstance(value, float) and not control.start <= value <= control.end:
                control.update(start=min(value, control.start), end=max(value, control.end))
            control.value = value
            control.disabled = name in WEIGHTS and shown.config.camera.law != "convex"
        self._part.update(options=list(shown.keys), value=str(shown.row["key"]), disabled=len(shown.keys) == 1)
        document.unhold()
        self._syncing = False

    def _save(self, form: str) -> None:
        if self._shown is None:
            return
        with self._reported():
            content = base64.b64encode(self._shown.archive(form)).decode()
            self._file.data = {"name": [f"{self._shown.row['key']}.{form}.zip"], "content": [content]}

    def html(self) -> str:
        """Return a page of the state, without controls; the error of the settings is raised."""
        shown = self._state.shown()
        self._draw(shown)
        command = _text_box("command", render_macro("wrapped", self._state.command))
        models = [self._facts, self._plan, command, *self._pictures.values(), *self._curves.values()]
        title, variables = f"{shown.row['source']} as raw frames", _variables(live=False)
        template = page_template(PAGE_TEMPLATE)
        return str(file_html(models, INLINE, title=title, template=template, template_variables=variables))


def _text_box(name: str, text: str = "") -> Div:
    return Div(name=name, text=text, sizing_mode="stretch_width", stylesheets=[render_page("explorer_texts.css")])


def _pair_facts(shown: Shown, transfer: str) -> dict[str, str]:
    """Numbers of the pair, by what the page calls them."""
    row, sites, camera = shown.row, shown.clean.size, shown.plan.camera
    return {
        "frame": f"{row['width']} × {row['height']} sites, {row['pattern']}",
        **{MEANINGS[column].removesuffix(", sites"): f"{int(row[column] or 0) / sites:.3%}" for column in SITE_COLUMNS},
        "gains": f"red {camera.red_gain:.4g}, blue {camera.blue_gain:.4g}, inverse rgb {camera.inverse_rgb_gain:.4g}",
        "noise of the pair": transfer,
        "effects": ", ".join(shown.plan.noise.effects),
        "XXH3": f"clean {row['clean_xxh3']}, noisy {row['noisy_xxh3']}",
    }


def _variables(live: bool) -> dict[str, Any]:
    """Values of the template."""
    return {
        "live": live,
        "sections": SECTIONS,
        "pictures": views.PICTURES,
        "curves": PLOTS,
        "moves": [f"move_{number}" for number in range(len(MOVES))],
    }
