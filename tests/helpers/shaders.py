"""The fused shaders, which read channels of the fixture `channels`."""

from __future__ import annotations

from dataclasses import replace

import gvtorch as gv
from helpers.traces import SHADER

POINT = gv.PointLight((0.0, 40.0, 60.0), (1.0, 0.9, 0.8))

LOOKS = [
    gv.ChannelLook(window=(60, 200), component=3),
    gv.TransferFunction.from_points([(90, 0), (130, 0.4), (170, 0)], [(90, 1, 1, 0)], 2.0),
    gv.ChannelLook(window=(120, 255), color="magenta", component=0, opacity=0.9),
]


SHADERS = {
    "lit": gv.Lit(SHADER),
    "lit by stored normals": gv.Lit(SHADER, normals="normal", light=POINT),
    "pre-integrated": gv.PreIntegrated(SHADER),
    "stored colour": gv.StoredColor("rgba"),
    "stored colour lit": gv.StoredColor(
        "premultiplied", premultiplied=True, light=gv.DirectionalLight((1, -1, -1)), lit=True
    ),
    "lit with shadows": gv.Lit(SHADER, shadows=True, light=replace(POINT, radius=20.0)),
    "colour with shadows": gv.StoredColor(
        "six", shadows=True, light=gv.DirectionalLight((1, -1, -1), angle=9.0)
    ),
    "scattering with shadows": gv.Lit(
        SHADER, octaves=4, anisotropy=0.6, light=gv.DirectionalLight((1, -1, -1), (1.0, 0.9, 0.8))
    ),
    "colour that scatters, with shadows": gv.StoredColor(
        "rgba", octaves=2, anisotropy=-0.3, light=POINT
    ),
    "six directions": gv.StoredColor("six", light=POINT, lit=True),
    "isosurface": gv.Isosurface(0.5, (0.9, 0.4, 0.2), light=POINT),
    "coloured isosurface": gv.Isosurface(0.4, SHADER, color_channel="rgba", color_component=1),
    "surface of stored colour": gv.Isosurface(
        0.4, None, color_channel="premultiplied", premultiplied=True
    ),
    "distance field": gv.DistanceField(offset=0.3, filled=False),  # `value` is not a distance
    "maximum": gv.Projection("maximum", SHADER),
    "minimum": gv.Projection("minimum", SHADER),
    "mean": gv.Projection("mean", SHADER),
    "features": gv.Features(SHADER, "rgba"),
    "gradient magnitude": gv.GradientMagnitude(SHADER, 0.1),
    "channels": gv.Channels(LOOKS, channel="rgba"),
    "channels by opacity": gv.Channels(LOOKS, "opacity", channel="rgba"),
    "labels": gv.Labels(channel="label", light=POINT),
    "flat labels": gv.Labels(opacity={2000: 0.1, 3000: 0.4}, channel="label", lit=False),
}
