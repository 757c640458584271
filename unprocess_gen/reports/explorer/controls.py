"""Describe the controls of the page: each is a group or a key of the settings, as the command line has it."""

from __future__ import annotations

from typing import Any

from bokeh.models import InputWidget, Select, Slider, TextInput

from unprocess_gen.config.option_files import conf_dir, group_options, option_summary
from unprocess_gen.config.schema import Config, all_settings
from unprocess_gen.config.settings import Setting
from unprocess_gen.core.fields import Choice
from unprocess_gen.reports.explorer.overrides import override_text
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
SLIDERS = {"gains.red": (0.5, 4), "gains.blue": (0.5, 4), "gains.inverse_rgb": (0.3, 2.2), "gains.threshold": (0, 0.99)}
"""Ends of sliders by key."""
DRAWN = {"gains.red": "red_gain", "gains.blue": "blue_gain", "gains.inverse_rgb": "inverse_rgb_gain"}
"""Keys of which sliders show the value in the plan, which may be drawn."""
NONE = "(none)"
SETTINGS: dict[str, Setting] = {f"{group}.{name}".lstrip("."): setting for group, name, setting in all_settings()}


def widget(name: str, folders: list[Any]) -> InputWidget:
    """The control of a group or key, without a value."""
    if name in SLIDERS:
        start, end = SLIDERS[name]
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


def shown_value(name: str, settings: dict[str, str], choices: dict[str, Any], config: Config, plan: Plan) -> Any:
    """The value of a control: an option, the number in the plan, or the text of a setting."""
    if name in DRAWN:
        return float(getattr(plan.camera, DRAWN[name]))
    if name == "camera.weights":
        return override_text([round(weight, 4) for weight in plan.camera.weights])
    if name not in SETTINGS:
        return choices.get(name) or NONE
    if name in settings and name not in SLIDERS:
        return settings[name].strip("'\"")
    group, _, key = name.rpartition(".")
    value = getattr(getattr(config, group) if group else config, key)
    return float(value) if name in SLIDERS else override_text(value).strip("'")
