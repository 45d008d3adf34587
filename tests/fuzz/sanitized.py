"""Builds the CPU library with sanitizers, and runs tests with it in place of the usual one.

    python tests/fuzz/sanitized.py address tests/test_words.py ...

The package is copied into build/sanitized-KIND, so that the usual library stays as it is. It is
compiled only for baseline x86-64 (instruction sets share their source), at -O1, with
AddressSanitizer's checks as calls, and without UndefinedBehaviorSanitizer's checks that duplicate
them: this takes three minutes of a processor, all of them inline at -O3 half an hour.
"""

from __future__ import annotations

import os
import platform
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).resolve().parents[2]
UNDEFINED = (
    *("bounds", "shift", "signed-integer-overflow", "integer-divide-by-zero", "bool", "enum"),
    *("return", "unreachable"),
)
KINDS = {"address": ("address", *UNDEFINED), "thread": ("thread",)}
CALLS = {"address": " -fno-sanitize-recover=all --param asan-instrumentation-with-call-threshold=0"}
# Libraries to preload: AddressSanitizer looks for the C++ library's `throw` when it starts.
LIBRARIES = {"address": ("libasan.so", "libstdc++.so.6"), "thread": ("libtsan.so",)}
# torch's OpenMP is not compiled with ThreadSanitizer, which therefore misses its barriers: there,
# only Python's threads run, and each runs its loops alone.
THREADS = {"address": "2", "thread": "1"}


def options(kind: str, log: Path) -> dict[str, str]:
    """Returns the environment that the sanitizers read; they write to files that begin with `log`,
    because pytest captures what a test prints.
    """
    unknown = f"suppressions={ROOT / 'tests/fuzz/tsan.txt'}:ignore_noninstrumented_modules=1"
    return {
        "ASAN_OPTIONS": f"detect_leaks=0:allocator_may_return_null=1:log_path={log}",
        "UBSAN_OPTIONS": f"halt_on_error=1:print_stacktrace=1:log_path={log}",
        "TSAN_OPTIONS": f"{unknown}:exitcode=66:log_path={log}",
        "OMP_NUM_THREADS": THREADS[kind],
    }


def library_path(name: str) -> str:
    """Returns the path of a library that comes with the compiler."""
    call = ["g++", f"-print-file-name={name}"]
    return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()


def main(kind: str, *tests: str) -> int:
    """Returns pytest's exit status, or 1 if the sanitizers have reported anything."""
    folder = ROOT / "build" / f"sanitized-{kind}"
    package = folder / "gvtorch"
    shutil.copytree(
        *(ROOT / "gvtorch", package),
        ignore=shutil.ignore_patterns("lib", "__pycache__"),
        dirs_exist_ok=True,
    )
    os.chdir(folder)
    flags = f"-fsanitize={','.join(KINDS[kind])} -fno-omit-frame-pointer -g1{CALLS.get(kind, '')}"
    os.environ |= {"GVTORCH_CUDA": "0", "CXX": f"{os.environ.get('CXX') or 'g++'} {flags}"}
    with mock.patch.object(platform, "machine", lambda: "any"):
        build = runpy.run_path("gvtorch/cpp_ext/libraries.py")
        compilers = build["compilers"]
        compilers.CXX_FLAGS = tuple(flag.replace("-O3", "-O1") for flag in compilers.CXX_FLAGS)
        build["compile_libraries"](Path("gvtorch/cpp_ext/lib"))
    log = folder / "told"
    for old_report in folder.glob("told.*"):
        old_report.unlink()
    preload = " ".join(library_path(name) for name in LIBRARIES[kind])
    extra = {"LD_PRELOAD": preload, "PYTHONPATH": str(folder), **options(kind, log)}
    paths = [str(ROOT / test) if (ROOT / test).exists() else test for test in tests]
    call = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-c"]
    call += [str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT), *paths]
    status = subprocess.run(call, env=os.environ | extra, cwd=folder, check=False).returncode
    reports = [file.read_text() for file in sorted(folder.glob("told.*"))]
    print(*reports, sep="\n", end="", file=sys.stderr)
    return status or bool(reports)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
