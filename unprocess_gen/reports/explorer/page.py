"""Draw the page with Bokeh, without network: controls, pictures with linked zoom, curves, and what ``plan`` says."""

from __future__ import annotations

import functools
import itertools
import operator
from collections.abc import Callable, Mapping
from dataclasses import replace
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
from unprocess_gen.config.overrides import override_text
from unprocess_gen.config.schema import Config
from unprocess_gen.config.settings import all_settings
from unprocess_gen.core.errors import UnprocessGenError
from unprocess_gen.core.fields import Choice
from unprocess_gen.reports.explorer import views
from unprocess_gen.reports.explorer.exploration import Choices, Exploration, Shown
from unprocess_gen.reports.explorer.overrides import key_of, split_overrides
from unprocess_gen.reports.manifest_statistics import MEANINGS, SITE_COLUMNS
from unprocess_gen.reports.pages import page_template, render_macro, render_page
from unprocess_gen.reports.photon_transfer import NoiseFit
from unprocess_gen.simulation.effects import EFFECTS
from unprocess_gen.simulation.plan import Plan

SECTIONS = {
    "Scene": ("scene", "scene.iso", "scene.exposure_s", "scene.temperature_c", "scene.exposure_ratio"),
    "Noise": ("body", "noise", "noise.iso", "noise.a", "noise.b", "seed"),
    "Effects": (
        *("effects.all", "effects.tolerance", "accuracy"),
        *(f"effects.{effect.name}" for effect in EFFECTS if effect.has_switch),
    ),
    "Sensor": ("sensor", "sensor.bits", "sensor.black_level_dn", "sensor.white_level_dn", "sensor.pattern"),
    "Camera": ("camera", "camera.weights"),
    "Gains and highlights": (
        *("gains", "gains.light", "gains.red", "gains.blue", "gains.inverse_rgb"),
        *("gains.highlight", "gains.threshold"),
    ),
    "Tone curve": ("isp", "isp.tone", "isp.gamma"),
}
"""Groups and keys by the title of their section; the first two are open."""
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
POINTS_DRAWN = 1000
"""Most points of the photon transfer."""
STRETCHES = ("common stretch", "own stretch")
WAIT_MS = 20
"""Time in which changes are collected before the pair is computed."""


Change = Callable[[Exploration], Exploration]
"""What a control changes in the settings."""


class Page:
    """The models of one page, and the state that they show.

    ``_new`` are changes by control that wait to be tried, ``_refused`` those that failed, each with the
    reason.
    """

    def __init__(self, start: Exploration, choices: Choices, document: Document) -> None:
        label = next(iter(choices))
        self._choices, self._document, self._state = choices, document, start
        self._new: dict[str, Change] = {"open": choices[label]}
        self._refused: dict[str, tuple[Change, str]] = {}
        self._shown: Shown | None = None
        self._syncing, self._waiting = False, set[Callable[[], None]]()
        self._pixels, self._points = ColumnDataSource(), ColumnDataSource({"x": [], "y": []})
        self._x, self._y = (Range1d(*ends, min_interval=views.SMALLEST_PX) for ends in ((0, 1), (1, 0)))
        self._message, self._refusal, self._facts, self._plan = map(_text_box, ("message", "refusal", "facts", "plan"))
        self._command = _text_box("command", render_as_text=True, css_classes=["command"])
        self._pictures = [self._picture(name) for name in views.PICTURES]
        self._lines = {name: ColumnDataSource({part: [] for part in views.Curve._fields}) for name in views.PLOTS}
        self._curves = {name: self._curve(name) for name in views.PLOTS}
        self._curves["transfer"].scatter("x", "y", source=self._points, size=3, alpha=0.5, color=views.COLOURS["clean"])
        self._stretch = _select("raw and developed", list(STRETCHES), name="stretch", value=STRETCHES[0])
        names = itertools.chain(*SECTIONS.values())
        folders = [folder for folder in (start.folders.own, start.folders.main) if folder is not None]
        self._widgets: dict[str, Any] = {name: _widget(name, folders) for name in names}
        self._others: dict[str, Any] = {
            "open": _select("photograph or row", list(choices), value=label),
            "part": _select("pair of the image", []),
            "other": TextInput(title="other settings", placeholder="source.downscale=2 output.dtype=float32"),
        }

    # -------------------------------------------------------------------------------------------------------- figures

    def _picture(self, name: str) -> Any:
        size = {"width": 300, "height": 200, "sizing_mode": "scale_width", "min_border": 0, "outline_line_color": None}
        size |= {"border_fill_alpha": 0, "background_fill_alpha": 0}
        tools = {"tools": "pan,wheel_zoom", "active_scroll": "wheel_zoom", "toolbar_location": None}
        drawn = figure(name=name, x_range=self._x, y_range=self._y, **tools, **size)
        drawn.axis.visible = drawn.grid.visible = False
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
        shown = {"pictures": views.PICTURES, "curves": views.PLOTS, "windows": views.WINDOWS}
        document.template_variables.update(sections=SECTIONS, **shown)
        controls = self._widgets | self._others
        for name, control in controls.items():
            control.name = name
            control.on_change("value", partial(self._changed, name))
        for control in (*controls.values(), self._stretch):
            control.sizing_mode = "stretch_width"
        self._stretch.on_change("value", lambda attr, old, new: self._draw_view())
        for end in (self._x, self._y):
            for side in ("start", "end"):
                end.on_change(side, lambda attr, old, new: self._later(self._draw_view))
        copy = Button(label="Copy the command", name="copy", button_type="primary")
        copy.js_on_click(CustomJS(args={"text": self._command}, code="navigator.clipboard.writeText(text.text)"))
        windows = [Button(label=label, name=label, margin=0) for label in views.WINDOWS]
        for button in windows:
            button.on_click(partial(self._zoom, button.name))
        boxes = [self._message, self._refusal, self._command, self._facts, self._plan, copy, self._stretch]
        with document.models.freeze():  # else Bokeh searches all models again for each root, 1 s in total
            for model in (*boxes, *windows, *self._pictures, *self._curves.values(), *controls.values()):
                document.add_root(model)
        self._update()

    def _zoom(self, label: str) -> None:
        """Show the part that the label of a button names."""
        if self._shown is not None:
            (top, bottom), (left, right) = views.window_of(label, self._shown).tolist()
            self._x.update(start=left, end=right)
            self._y.update(start=bottom, end=top)

    # ---------------------------------------------------------------------------------------------------------- state

    def _update(self) -> None:
        """Try the new changes, with those that were refused before or without, and show the pair."""
        new, self._new = self._new, {}
        before = {name: change for name, (change, _) in self._refused.items()}
        for changes in (before | new, new) if before else (new,):
            try:
                state = functools.reduce(lambda state, change: change(state), changes.values(), self._state)
                state = state.with_field(self._widgets)
                shown = state.shown()
            except UnprocessGenError as error:
                sentence = str(error)
            else:
                self._state = state
                self._refused = {name: kept for name, kept in self._refused.items() if name not in changes}
                self._draw(shown, "open" in changes)
                break
        else:
            self._refused |= {name: (change, sentence) for name, change in new.items()}
        self._report()

    def _report(self) -> None:
        """Show why changes were refused, above the pictures, and outline their controls."""
        sentences = {name: sentence for name, (_, sentence) in self._refused.items()}
        below = [sentence for name, sentence in sentences.items() if name == "other"]
        for box, texts in ((self._message, dict.fromkeys(sentences.values())), (self._refusal, below)):
            box.update(text="".join(render_macro("alert", text) for text in texts), visible=bool(texts))
        for name, control in (self._widgets | self._others).items():
            control.css_classes = ["refused"] if name in self._refused else []

    def _draw(self, shown: Shown, is_new: bool) -> None:
        """Draw everything of a pair, and set the controls."""
        is_new = is_new or self._shown is None or shown.clean.shape != self._shown.clean.shape
        self._shown = shown
        if is_new:
            height, width = shown.clean.shape
            for drawn in self._pictures:
                drawn.update(
                    aspect_ratio=width / height, styles={"max-width": f"calc(var(--tallest) * {width / height:.4f})"}
                )
            self._zoom("Everything")
        self._draw_view()
        self._draw_statistics(shown)
        self._command.text = self._state.command
        self._sync(shown)

    def _draw_view(self) -> None:
        """Draw the sites in view, from even rows and columns."""
        if self._shown is None:  # the first settings are wrong
            return
        ends = sorted((self._y.start, self._y.end)), sorted((self._x.start, self._x.end))
        window = []
        for (low, high), length in zip(ends, self._shown.clean.shape, strict=True):
            start = max(0, min(int(low), length - views.SMALLEST_PX)) // 2 * 2
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
        given = {key_of(override): override.partition("=")[2] for override in self._state.overrides}
        for name, control in self._widgets.items():
            if name in self._refused:
                continue
            value = _shown_value(name, given, shown.choices, shown.config, shown.plan)
            if isinstance(control, Select) and value not in control.options:
                control.options = [*control.options, value]
            if isinstance(value, float) and not control.start <= value <= control.end:
                control.update(start=min(value, control.start), end=max(value, control.end))
            control.value = value
        self._widgets["camera.weights"].visible = shown.config.camera.law == "convex"
        several = len(shown.keys) > 1
        self._others["part"].update(options=list(shown.keys), value=str(shown.row["key"]), visible=several)
        if "other" not in self._refused:
            self._others["other"].value = " ".join(self._state.typed)
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
        if not self._syncing:
            self._new[name] = self._change(name, new)
            self._later(self._update)

    def _change(self, name: str, new: Any) -> Change:
        """The change that a control makes; without a text, a key has its default."""
        if name == "open":
            return self._choices[new]
        if name == "part":
            return lambda state: replace(state, part=new[new.index("-") :])
        if name == "other":
            return lambda state: replace(state, typed=split_overrides(new))
        if name not in SETTINGS:
            return lambda state: state.with_option(name, None if new == NONE else new)
        text = f"{new:.6g}" if isinstance(new, float | int) else new.strip()
        if not text or (name.startswith("effects.") and text == "null"):
            return lambda state: state.without(name.__eq__)
        return lambda state: state.with_settings({name: text})


def _widget(name: str, folders: list[Any]) -> InputWidget:
    """The control of a group or key, without a value."""
    if name in SLIDERS:
        start, end, _ = SLIDERS[name]
        return Slider(title=name, start=start, end=end, step=0.01, value=start, margin=(5, 5, 12, 5))
    setting = SETTINGS.get(name)
    if setting is None:
        options = group_options(name, conf_dir(), *folders)
        summary = "; ".join(f"{option}: {option_summary(name, option)}" for option in group_options(name))
        return _select(name, [*([NONE] if name == "body" else []), *options], summary)
    if isinstance(setting.limit, Choice):
        words = [*(["null"] if setting.null else []), *setting.limit.words]
        return _select(name, words, setting.description)
    return TextInput(title=name, description=setting.description)


def _select(title: str, options: list[str], description: str = "", **properties: Any) -> Select:
    arrow = "select.bk-input:not([multiple]) { appearance: auto; background-image: none; }"  # follows the colour scheme
    return Select(title=title, options=options, description=description or None, stylesheets=[arrow], **properties)


def _shown_value(name: str, settings: Mapping[str, str], choices: dict[str, Any], config: Config, plan: Plan) -> Any:
    """The value of a control: an option, the number in the plan, or the text of a setting."""
    if name in SLIDERS:
        return float(operator.attrgetter(SLIDERS[name][2])(plan))
    if name == "camera.weights":
        return override_text([round(weight, 4) for weight in plan.camera.weights])
    if name not in SETTINGS:
        return choices.get(name) or NONE
    text = settings[name] if name in settings else override_text(operator.attrgetter(name)(config))
    return text.strip("'\"")


def _text_box(name: str, **properties: Any) -> Div:
    return Div(name=name, sizing_mode="stretch_width", stylesheets=[render_page("explorer_texts.css")], **properties)


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
