"""New processes for tests, each a copy of one that has imported what takes long."""

from __future__ import annotations

import multiprocessing

# A copy takes a twentieth of a start. All tests of a process share one server of copies, so that
# there is one list of modules; none of them may run a kernel when it is imported (packets.py).
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["torch", "gvtorch.io.reading"])
