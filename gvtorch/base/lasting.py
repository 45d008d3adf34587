"""`lasting` and `without_autocast`: for what must not depend on the modes in which it is called."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar, cast

import torch

Function = TypeVar("Function", bound=Callable[..., Any])


def lasting(function: Function) -> Function:
    """Makes what a function allocates usable by later calls, in whatever mode it is called:

    - In `torch.inference_mode` it allocates normal tensors, without gradients. torch lets nobody
      write inference tensors once that mode has ended, nor save them for a backward pass.
    - In a transform of `torch.func`, such as `grad`, it runs outside of it: tensors made inside are
      useless once the transform has ended.
    - Autocast is off, so that nothing that is kept depends on it.
    """

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        # Each look costs a frame time; most calls are in no mode at all.
        inference, transform = torch.is_inference_mode_enabled(), in_transform()
        if not (inference or transform or torch._C._is_any_autocast_enabled()):
            return function(*args, **kwargs)
        with ExitStack() as modes:
            if inference:
                modes.enter_context(torch.inference_mode(False))
                modes.enter_context(torch.no_grad())
            if transform:
                from torch._functorch import pyfunctorch  # loaded by these transforms

                modes.enter_context(pyfunctorch.temporarily_clear_interpreter_stack())
            _stop_autocast(modes)
            return function(*args, **kwargs)

    return cast("Function", run)


def without_autocast(function: Function) -> Function:
    """Makes a function run with autocast off: what it computes has its full digits."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        with ExitStack() as modes:
            _stop_autocast(modes)
            return function(*args, **kwargs)

    return cast("Function", run)


def in_transform() -> bool:
    """Returns whether a transform of `torch.func`, such as `grad` or `vmap`, is running."""
    functorch = torch._C._functorch
    return functorch.maybe_current_level() is not None and not torch.compiler.is_compiling()


def _stop_autocast(modes: ExitStack) -> None:
    for name in ("cpu", "cuda"):
        if torch.is_autocast_enabled(name):
            modes.enter_context(torch.autocast(name, enabled=False))
