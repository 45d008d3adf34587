"""Options that a view's shader does not support, found by the checks that refuse them in a render:
the page disables their controls, and they are dropped when such a shader is chosen.
"""

from __future__ import annotations

from dataclasses import replace

from ..tracing import Clip, Lighting, RenderOptions, ThinLens
from ..tracing.around import check_fits
from .state import ViewState, costed

_BARE = RenderOptions()
_LENS = ThinLens(aperture=0.1, focus=1.0)
# Controls (`Class.field`), and the change of a state that turns each of them off.
_WITHOUT = {
    "RenderOptions.lighting": {"options": {"lighting": None}},
    "Lighting.indirect": {"options": {"lighting": {"indirect": 0.0}}},
    "RenderOptions.lens": {"options": {"lens": None}},
    "RenderOptions.lod": {"options": {"lod": "auto"}},
    "Clip.caps": {"options": {"clip": {"caps": False}}},
    "ViewState.show": {"show": "picture"},
}


def _try(control: str, state: ViewState) -> None:
    """Raises ValueError if a control can't be used with the rest of a state."""
    shader, options = state.shader, state.options
    if control == "RenderOptions.lighting":
        check_fits(shader, replace(_BARE, lighting=Lighting()))
    elif control == "Lighting.indirect":
        check_fits(shader, replace(_BARE, lighting=Lighting(indirect=1.0)))
    elif control == "RenderOptions.lens":
        check_fits(shader, replace(_BARE, lens=_LENS, lod=options.lod))
    elif control == "RenderOptions.lod":
        _ = replace(_BARE, lod="finest", lens=options.lens)
    elif control == "Clip.caps":
        check_fits(shader, replace(_BARE, clip=Clip(caps=True)))
    else:
        costed(shader)


def unfit(state: ViewState) -> dict[str, str]:
    """Returns why, for each control (`Class.field`) that can't be used with the rest of a state."""
    told = {}
    for control in _WITHOUT:
        try:
            _try(control, state)
        except ValueError as error:
            told[control] = str(error)
    return told


def trimmed(state: ViewState) -> tuple[ViewState, list[str]]:
    """Returns a state without the options that its shader does not support, and the reasons."""
    left_out: list[str] = []
    alone = replace(state, options=replace(state.options, lens=None))
    for control, why in unfit(alone).items():
        part = {"Lighting": state.options.lighting, "Clip": state.options.clip}
        if part.get(control.split(".")[0], state) is None:
            continue
        without = state.changed(_WITHOUT[control])
        if without.to_json() != state.to_json():
            state, left_out = without, [*left_out, why]
    return state, left_out
