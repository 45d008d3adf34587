"""The records of `ops.arguments` are the ops' schemas, name by name, in order and in type."""

from __future__ import annotations

import inspect
from typing import get_args, get_type_hints

import pytest
import torch
from torch import Tensor

from gvtorch.ops import registry
from gvtorch.ops.arguments import RayArguments, ShadeArguments, TraceArguments

TYPES = {Tensor: "Tensor", int: "int", float: "float", bool: "bool"}
PART = [("state_r3", "Optional[Tensor]"), ("limit", "int"), ("by_node", "bool")]
PLACES = [("first_r", "Tensor"), ("total", "int")]
WALKED = ("count_segments", "write_segments")


def fields(record: type) -> list[tuple[str, str]]:
    """Returns names and types of a record, spelled as in a schema."""
    return [
        (name, f"Optional[{TYPES[get_args(hint)[0]]}]" if get_args(hint) else TYPES[hint])
        for name, hint in get_type_hints(record).items()
    ]


def schema(name: str) -> list[tuple[str, str]]:
    op = getattr(torch.ops.gvtorch, name).default
    return [(a.name, str(a.real_type)) for a in op._schema.arguments]


RAYS, TRACE, SHADE = fields(RayArguments), fields(TraceArguments), fields(ShadeArguments)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("trace_rays", RAYS + TRACE),
        ("shade_rays", [*RAYS, *TRACE, *SHADE, ("parameter_54", "Tensor")]),
        ("count_segments", RAYS + TRACE + PART),
        ("write_segments", RAYS + TRACE + PART + PLACES),
    ],
)
def test_records_are_the_schema(name, expected):
    assert schema(name) == expected


def test_samples_read_rays_and_the_first_fields():
    channel = TRACE[: TRACE.index(("range_tn2c", "Tensor"))]
    assert schema("sample_bricks")[: len(RAYS + channel)] == RAYS + channel
    assert schema("sample_bricks_backward")[7:] == schema("sample_bricks")


def test_marks_are_all_that_is_written():
    for name in ("trace_rays", "shade_rays", *WALKED):
        arguments = getattr(torch.ops.gvtorch, name).default._schema.arguments
        written = {a.name for a in arguments if a.alias_info and a.alias_info.is_write}
        assert written == {"request_tn", "stamp_t", "stamp_b"}


@pytest.mark.parametrize("name", registry.FAKES)
def test_a_fake_names_arguments_of_its_op(name):
    names = {argument for argument, _ in schema(name)}
    for parameter in inspect.signature(registry.FAKES[name]).parameters.values():
        assert parameter.kind == parameter.VAR_KEYWORD or parameter.name in names
