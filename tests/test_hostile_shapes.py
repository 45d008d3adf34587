"""Arguments of producers, fields, meshes and points that are wrong, or of extreme size: one line says
what is wrong, and nothing hangs, overflows or is taken silently.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import gvtorch as gv
from gvtorch import sdf

BALL = sdf.Sphere()
TALL = ((-1, -1, -1), (1, 1, 3))
POINTS = [[0.0, 0, 0], [1, 1, 2]]


@pytest.mark.parametrize("extent", [(32, 32), "32", None, 32.5, math.nan, (32, 32, 0)])
@pytest.mark.parametrize(
    "make",
    [
        lambda extent: gv.FieldProducer(BALL, extent),
        lambda extent: gv.FieldProducer(BALL, extent, box=TALL),
        lambda extent: gv.Hypertexture(BALL, extent, thickness=0.1),
        lambda extent: gv.PointProducer(POINTS, extent=extent),
        lambda extent: gv.Producer(extent),
    ],
)
def test_every_producer_says_what_an_extent_must_be(make, extent):
    with pytest.raises(ValueError, match=r"extent must be (an int >= 1|a number or \(x, y, z\))"):
        make(extent)


def test_integers_of_numpy_are_extents():
    """Along the longest side of the box, as other integers are: voxels are cubes."""
    size = np.int64(32)
    assert gv.FieldProducer(BALL, size, box=TALL).extent == (16, 16, 32)
    assert gv.FieldProducer(BALL, size).extent == gv.FieldProducer(BALL, 32).extent
    assert gv.Hypertexture(BALL, size, thickness=0.1, box=TALL).extent == (16, 16, 32)
    assert gv.PointProducer(POINTS, extent=size).extent == (16, 16, 32)
