"""Options that a view's shader does not support, found by the checks that refuse them in a render:
the page disables their controls, and they are dropped when such a shader is chosen.
"""

from __future__ import annotations

from dataclasses import replace

from ..shaders.lights import LitShader
from ..tracing import Clip, Lighting, RenderOptions, ThinLens
from ..tracing.effects import check_fits
from .state import ViewState, costed

_DEFAULTS = RenderOptions()
_LENS = ThinLens(aperture=0.1, focus=1.0)
# Controls (`Class.field`; LitShader: the class of the shader), and the change of a state that turns
# each of them off.
_TURNED_OFF = {
    "RenderOptions.lighting": {"options": {"lighting": None}},
    "Lighting.indirect": {"options": {"lighting": {"indirect": 0.0}}},
    "RenderOptions.lens": {"options": {"lens": None}},
    "RenderOptions.lod": {"options": {"lod": "auto"}},
    "Clip.caps": {"options": {"clip": {"caps": False}}},
    "LitShader.octaves": {"shader": {"octaves": 0}},
    "ViewState.show": {"show": "picture"},
}


def _check_control(control: str, state: ViewState) -> None:
    """Raises ValueError if a control can't be used with the rest of a state."""
    shader, options = state.shader, state.options
    if control == "RenderOptions.lighting":
        check_fits(shader, replace(_DEFAULTS, lighting=Lighting()))
    elif control == "Lighting.indirect":
        check_fits(shader, replace(_DEFAULTS, lighting=Lighting(indirect=1.0)))
    elif control == "RenderOptions.lens":
        check_fits(shader, replace(_DEFAULTS, lens=_LENS, lod=options.lod))
    elif control == "RenderOptions.lod":
        _ = replace(_DEFAULTS, lod="finest", lens=options.lens)
    elif control == "Clip.caps":
        check_fits(shader, replace(_DEFAULTS, clip=Clip(caps=True)))
    elif control == "LitShader.octaves":
        if isinstance(shader, LitShader):
            shader.check_scattering("render")
    else:
        costed(shader)


def unfit(state: ViewState) -> dict[str, str]:
    """Returns why, for each control (`Class.field`) that can't be used with the rest of a state."""
    kind = type(state.shader).__name__
    return {c.replace("LitShader", kind): reason for c, reason in _reasons(state).items()}


def _reasons(state: ViewState) -> dict[str, str]:
    """Returns the same by the names of `_TURNED_OFF`."""
    reasons = {}
    for control in _TURNED_OFF:
        try:
            _check_control(control, state)
        except ValueError as error:
            reasons[control] = str(error)
    return reasons


def trimmed(state: ViewState) -> tuple[ViewState, list[str]]:
    """Returns a state without the options that its shader does not support, and the reasons."""
    left_out: list[str] = []
    without_lens = replace(state, options=replace(state.options, lens=None))
    for control, reason in _reasons(without_lens).items():
        owners = {"Lighting": state.options.lighting, "Clip": state.options.clip}
        if owners.get(control.split(".")[0], state) is None:
            continue
        changed = state.changed(_TURNED_OFF[control])
        if changed.to_json() != state.to_json():
            state, left_out = changed, [*left_out, reason]
    return state, left_out
