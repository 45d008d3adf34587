"""`lasting`: for functions that make what later calls read or write."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar, cast

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


def lasting(function: Function) -> Function:
    """Makes what a function returns or keeps independent of two modes in which it may be called.

    In `torch.inference_mode` it allocates normal tensors, without gradients: torch lets nobody
    write inference tensors once that mode has ended, nor save them for a backward pass. Autocast is
    off within, so that nothing that is kept has fewer digits, or other bits, where it was on.
    """

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        inference = torch.is_inference_mode_enabled()
        casting = [name for name in ("cpu", "cuda") if torch.is_autocast_enabled(name)]
        if not inference and not casting:
            return function(*args, **kwargs)
        with ExitStack() as modes:
            if inference:
                modes.enter_context(torch.inference_mode(False))
                modes.enter_context(torch.no_grad())
            for name in casting:
                modes.enter_context(torch.autocast(name, enabled=False))
            return function(*args, **kwargs)

    return cast("Function", run)
