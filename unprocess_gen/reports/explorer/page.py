"""Draw the page with Bokeh, without network: controls, pictures with linked zoom, curves, and what ``plan`` says."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from bokeh.document import Document
from bokeh.models import (
    Button,
    ColumnDataSource,
    CustomJS,
    Div,
    HoverTool,
    InputWidget,
    Range1d,
    Select,
    Slider,
    TextInput,
)
from bokeh.plotting import figure

from unprocess_gen.config.option_files import conf_dir, group_options, option_summary
from unprocess_gen.config.schema import Config
from unprocess_gen.config.settings import all_settings
from unprocess_gen.core.errors import UnprocessGenError
from unprocess_gen.core.fields import Choice
from unprocess_gen.reports.explorer import views
from unprocess_gen.reports.explorer.exploration import Choices, Shown
from unprocess_gen.reports.explorer.overrides import override_text
from unprocess_gen.reports.manifest_statistics import MEANINGS, SITE_COLUMNS
from unprocess_gen.reports.pages import page_template, render_macro, render_page
from unprocess_gen.reports.photon_transfer import NoiseFit
from unprocess_gen.simulation.effects import EFFECTS
from unprocess_gen.simulation.plan import Plan

SECTIONS = {
    "Camera": ("body", "camera", "camera.weights"),
    "Gains and highlights": (
        *("gains", "gains.light", "gains.red", "gains.blue", "gains.inverse_rgb"),
        *("gains.highlight", "gains.threshold"),
    ),
    "Tone curve": ("isp", "isp.tone", "isp.gamma"),
    "Sensor": ("sensor", "sensor.bits", "sensor.black_level_dn", "sensor.white_level_dn", "sensor.pattern"),
    "Scene": ("scene", "scene.iso", "scene.exposure_s", "scene.temperature_c", "scene.exposure_ratio"),
    "Noise": ("noise", "noise.a", "noise.b", "noise.iso", "accuracy", "seed"),
    "Effects": (
        *("effects.all", "effects.tolerance"),
        *(f"effects.{effect.name}" for effect in EFFECTS if effect.has_switch),
    ),
}
"""Groups and keys by the title of their section."""
SLIDERS = {
    "gains.red": (0.5, 4, "camera.red_gain"),
    "gains.blue": (0.5, 4, "camera.blue_gain"),
    "gains.inverse_rgb": (0.3, 2.2, "camera.inverse_rgb_gain"),
    "gains.threshold": (0, 0.99, "isp.highlight_threshold"),
}
"""Ends of sliders by key, and the number of the plan that they show, which may be drawn."""
NONE = "(none)"
SETTINGS = all_settings(Config)
TIPS = [
    ("site", "column $x{%d}, row $y{%d}"),
    ("source", "@r, @g, @b"),
    ("clean", "@clean_dn{0.[0]} DN"),
    ("noisy", "@noisy_dn{0.[0]} DN"),
    ("values", "@note"),
]
"""What the pictures show under the pointer."""
MOVES = "pan,wheel_zoom,zoom_in,zoom_out,pan_left,pan_right,pan_up,pan_down,reset"
SMALLEST_PX = 8
"""Fewest sites of a side of the window."""
POINTS_DRAWN = 1000
"""Most points of the photon transfer."""
STRETCHES = ("common stretch", "own stretch")
WAIT_MS = 20
"""Time in which changes are collected before the pair is computed."""


class Page:
    """The models of one page, and the state that they show."""

    def __init__(self, choices: Choices, document: Document) -> None:
        label = next(iter(choices))
        self._choices, self._document, self._state = choices, document, choices[label]()
        self._shown: Shown | None = None
        self._syncing, self._waiting = False, set[Callable[[], None]]()
        self._pixels, self._points = ColumnDataSource(), ColumnDataSource({"x": [], "y": []})
        self._x, self._y = (Range1d(*ends, min_interval=SMALLEST_PX) for ends in ((0, 1), (1, 0)))
        self._message, self._facts, self._plan = map(_text_box, ("message", "facts", "plan"))
        self._pictures = [self._picture(name) for name in views.PICTURES]
        self._lines = {name: ColumnDataSource({part: [] for part in views.Curve._fields}) for name in views.PLOTS}
        self._curves = {name: self._curve(name) for name in views.PLOTS}
        self._curves["transfer"].scatter("x", "y", source=self._points, size=3, alpha=0.5, color=views.COLOURS["clean"])
        self._command = TextInput(name="command", title="Command of this pair")
        self._stretch = Select(name="stretch", title="raw and developed", options=list(STRETCHES), value=STRETCHES[0])
        self._open = Select(name="open", title="photograph or row", options=list(choices), value=label)
        self._part = Select(name="part", title="pair of the image")
        self._other = TextInput(
            name="other", title="other settings", placeholder="source.downscale=2 output.dtype=float32"
        )
        names = itertools.chain(*SECTIONS.values())
        folders = [folder for folder in (self._state.folders.own, self._state.folders.main) if folder is not None]
        self._widgets: dict[str, Any] = {name: _widget(name, folders) for name in names}

    # -------------------------------------------------------------------------------------------------------- figures

    def _picture(self, name: str) -> Any:
        size = {"width": 300, "height": 200, "sizing_mode": "scale_width", "min_border": 0, "outline_line_color": None}
        tools = {"tools": MOVES, "active_scroll": "wheel_zoom", "toolbar_location": None}
        drawn = figure(name=name, x_range=self._x, y_range=self._y, **tools, **size)
        drawn.axis.visible = drawn.grid.visible = False
        drawn.toolbar.update(name=f"moves_{name}", logo=None)
        renderer = drawn.image_rgba(name, "x", "y", "dw", "dh", source=self._pixels)
        whole = {"$x": "printf", "$y": "printf"}  # other formats round, to the next site
        drawn.add_tools(HoverTool(renderers=[renderer], tooltips=TIPS, point_policy="follow_mouse", formatters=whole))
        return drawn

    def _curve(self, name: str) -> Any:
        title, x, y = views.PLOTS[name]
        size = {"width": 420, "height": 260, "sizing_mode": "stretch_width", "tools": "pan,wheel_zoom,box_zoom,reset"}
        scale = {"y_axis_type": "log", "y_range": (1e-6, 1)} if name == "raw_histogram" else {}
        drawn = figure(name=name, title=title, x_axis_label=x, y_axis_label=y, **size, **scale)
        drawn.toolbar.update(logo=None, autohide=True)
        drawn.multi_line("xs", "ys", source=self._lines[name], color="colour", line_width=1.5, legend_field="label")
        place = "top_right" if "histogram" in name else "top_left"
        drawn.legend.update(location=place, background_fill_alpha=0.6, label_text_font_size="9pt", padding=3, margin=3)
        return drawn

    def fill(self) -> None:
        """Fill the document, and show the first pair."""
        document = self._document
        document.title, document.template = "unprocess_gen explorer", page_template("explorer.html")
        document.template_variables.update(sections=SECTIONS, pictures=views.PICTURES, curves=views.PLOTS)
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
        copy = Button(label="Copy the command", name="copy", button_type="primary")
        copy.js_on_click(CustomJS(args={"text": self._command}, code="navigator.clipboard.writeText(text.value)"))
        boxes = [self._message, self._facts, self._plan, copy, self._pictures[0].toolbar]
        with document.models.freeze():  # else Bokeh searches all models again for each root, 1 s in total
            for model in (*boxes, *self._pictures, *self._curves.values(), *inputs):
                document.add_root(model)
        self._update()

    # ---------------------------------------------------------------------------------------------------------- state

    @contextmanager
    def _reported(self) -> Iterator[None]:
        """Show the sentence of an error in the page."""
        try:
            yield
        except UnprocessGenError as error:
            self._message.text = render_macro("alert", str(error))

    def _update(self) -> None:
        """Compute the pair, draw everything, and set the controls."""
        with self._reported():
            shown = self._state.shown()
            is_new = self._shown is None or shown.clean.shape != self._shown.clean.shape
            self._shown = shown
            if is_new:
                height, width = shown.clean.shape
                for drawn in self._pictures:
                    drawn.aspect_ratio = width / height
                self._x.update(start=0, end=width, reset_start=0, reset_end=width)
                self._y.update(start=height, end=0, reset_start=height, reset_end=0)
            self._draw_view()
            self._draw_statistics(shown)
            self._command.value = self._state.command
            self._message.text = ""
            self._sync(shown)

    def _draw_view(self) -> None:
        """Draw the sites in view, from even rows and columns."""
        if self._shown is None:  # the first settings are wrong
            return
        ends = sorted((self._y.start, self._y.end)), sorted((self._x.start, self._x.end))
        window = []
        for (low, high), length in zip(ends, self._shown.clean.shape, strict=True):
            start = max(0, min(int(low), length - SMALLEST_PX)) // 2 * 2
            window.append(slice(start, max(start + 1, min(length, int(high) + 2))))
        columns = views.view(self._shown, (window[0], window[1]), self._stretch.value == STRETCHES[0])
        self._pixels.data = {name: [value] for name, value in columns.items()}

    def _draw_statistics(self, shown: Shown) -> None:
        fit = views.noise_fit(shown)
        for name, lines in views.curves(shown, fit).items():
            self._lines[name].data = {part: [getattr(line, part) for line in lines] for part in views.Curve._fields}
        points: Any = ([], []) if fit is None else (fit.signal_dn, fit.variance_dn2)
        step = len(points[0]) // POINTS_DRAWN + 1
        self._points.data = {"x": points[0][::step], "y": points[1][::step]}
        self._facts.text = render_macro("facts", _pair_facts(shown, fit))
        self._plan.text = render_macro("lines", "\n".join(shown.lines))

    def _sync(self, shown: Shown) -> None:
        """Set the controls to the values of the pair, in one message to the browser."""
        self._syncing = True
        self._document.hold("combine")
        for name, control in self._widgets.items():
            value = _shown_value(name, self._state.settings, shown.choices, shown.config, shown.plan)
            if isinstance(control, Select) and value not in control.options:
                control.options = [*control.options, value]
            if isinstance(value, float) and not control.start <= value <= control.end:
                control.update(start=min(value, control.start), end=max(value, control.end))
            control.value = value
        self._part.update(options=list(shown.keys), value=str(shown.row["key"]), disabled=len(shown.keys) == 1)
        self._document.unhold()
        self._syncing = False

    # -------------------------------------------------------------------------------------------------------- controls

    def _later(self, task: Callable[[], None]) -> None:
        """Run a task once after the changes that have arrived."""
        if task in self._waiting:
            return
        self._waiting.add(task)

        def run() -> None:
            self._waiting.remove(task)
            task()

        self._document.add_timeout_callback(run, WAIT_MS)

    def _changed(self, name: str, attr: str, old: Any, new: Any) -> None:
        if self._syncing:
            return
        if name not in SETTINGS:
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
        self._state.add(new.split())
        self._later(self._update)


def _widget(name: str, folders: list[Any]) -> InputWidget:
    """The control of a group or key, without a value."""
    if name in SLIDERS:
        start, end, _ = SLIDERS[name]
        return Slider(title=name, start=start, end=end, step=0.01, value=start)
    setting = SETTINGS.get(name)
    if setting is None:
        options = group_options(name, conf_dir(), *folders)
        summary = "; ".join(f"{option}: {option_summary(name, option)}" for option in group_options(name))
        return Select(title=name, options=[*([NONE] if name == "body" else []), *options], description=summary or None)
    if isinstance(setting.limit, Choice):
        words = [*(["null"] if setting.null else []), *setting.limit.words]
        return Select(title=name, options=words, description=setting.description)
    return TextInput(title=name, description=setting.description)


def _shown_value(name: str, settings: dict[str, str], choices: dict[str, Any], config: Config, plan: Plan) -> Any:
    """The value of a control: an option, the number in the plan, or the text of a setting."""
    if name in SLIDERS:
        return float(operator.attrgetter(SLIDERS[name][2])(plan))
    if name == "camera.weights":
        return override_text([round(weight, 4) for weight in plan.camera.weights])
    if name not in SETTINGS:
        return choices.get(name) or NONE
    text = settings[name] if name in settings else override_text(operator.attrgetter(name)(config))
    return text.strip("'\"")


def _text_box(name: str) -> Div:
    return Div(name=name, sizing_mode="stretch_width", stylesheets=[render_page("explorer_texts.css")])


def _pair_facts(shown: Shown, fit: NoiseFit | None) -> dict[str, str]:
    """Numbers of the pair, by what the page calls them."""
    row, sites, camera = shown.row, shown.clean.size, shown.plan.camera
    return {
        "frame": f"{row['width']} × {row['height']} sites, {row['pattern']}",
        **{MEANINGS[column].removesuffix(", sites"): f"{int(row[column] or 0) / sites:.3%}" for column in SITE_COLUMNS},
        "gains": f"red {camera.red_gain:.4g}, blue {camera.blue_gain:.4g}, inverse rgb {camera.inverse_rgb_gain:.4g}",
        "noise of the pair": "too few sites or levels for a fit" if fit is None else str(fit),
        "effects": ", ".join(shown.plan.noise.effects),
        "XXH3": f"clean {row['clean_xxh3']}, noisy {row['noisy_xxh3']}",
    }
