"""`lasting`: for functions that allocate tensors which later calls write."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


def lasting(function: Function) -> Function:
    """Makes a function called in `torch.inference_mode` allocate normal tensors, without gradients:
    torch lets nobody write inference tensors once that mode has ended.
    """

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        if not torch.is_inference_mode_enabled():
            return function(*args, **kwargs)
        with torch.inference_mode(False), torch.no_grad():
            return function(*args, **kwargs)

    return cast("Function", run)
