"""`LitShader`: the base of shaders with a light and a material."""

from __future__ import annotations

from copy import copy
from typing import Self

from ..ops import ShadeArguments
from ..ops.shading import Number, shader_number
from ..pool import N3Tree
from .lights import Headlight, Light, Material
from .shader import Shader


class LitShader(Shader):
    """A shader with a light and a material; see `Material` and csrc/shaders/shaders.h.

    Attributes:
        shadows: Whether a cone goes from each sample to the light: matter on the way takes from
            diffuse light and highlight. A `Headlight` throws no shadows.
        shadowed_kind: Its `kind` with shadows; None: it can't have any.
    """

    shadows = False
    shadowed_kind: str | None = None

    def __init__(
        self,
        *,
        normals: str | None = None,
        light: Light | None = None,
        ambient: Number = 0.2,
        diffuse: Number = 0.8,
        specular: Number = 0.3,
        shininess: Number = 40.0,
    ) -> None:
        """Takes light and material.

        Args:
            normals: Name of a channel of 3 numbers that holds normals (unsigned integers stand for
                -1 to 1); the gradient's if left out.
            light: A `Headlight` if left out.
            ambient: Factor of the base colour.
            diffuse: Factor of base colour, light and cosine.
            specular: Factor of the highlight.
            shininess: Exponent of the highlight.

        Raises:
            ValueError: A number is negative or not finite.
        """
        self.normals, self.light = normals, light or Headlight()
        self.ambient, self.diffuse = ambient, diffuse
        self.specular, self.shininess = specular, shininess
        self.material()

    def material(self) -> Material:
        """Returns light and material, checked."""
        return Material(
            light=self.light,
            ambient=self.ambient,
            diffuse=self.diffuse,
            specular=self.specular,
            shininess=self.shininess,
        )

    def shading(self, where: str, tree: N3Tree) -> ShadeArguments | None:
        """See `Shader`."""
        given = super().shading(where, tree)
        if given is None or not self.shadows:
            return given
        if self.shadowed_kind is None:
            raise ValueError(f"{where}: shadows per sample are for Lit and StoredColor")
        return given._replace(shader=shader_number(self.shadowed_kind))

    def unlit(self) -> Self:
        """See `Shader`."""
        bare = copy(self)
        bare.ambient, bare.diffuse, bare.specular, bare.shadows = 1.0, 0.0, 0.0, False
        return bare
