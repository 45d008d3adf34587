"""New processes for tests: copies of one that has imported what takes long, and forked ones."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable

# A copy takes a twentieth of a start. All tests of a process share one server of copies, so that
# there is one list of modules; none of them may run a kernel when it is imported (packets.py).
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["torch", "gvtorch.io.reading"])


def in_forked_child(function: Callable[[], object]) -> str:
    """Calls a function in a child that is forked from this process as it is now; returns what it
    returns, or its exception, as text.
    """
    context = multiprocessing.get_context("fork")
    receive, send = context.Pipe(duplex=False)

    def child() -> None:
        try:
            send.send(str(function()))
        except BaseException as error:
            send.send(repr(error))
        os._exit(0)

    process = context.Process(target=child)
    process.start()
    assert receive.poll(300), "the child did not answer"
    text = str(receive.recv())
    process.join(60)
    return text
