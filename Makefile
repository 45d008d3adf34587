# make demo   sets up .venv, renders the bundled CT scan, prints where the picture lies
# make test   sets up .venv, runs every test
# make soak   random flights with faults (FRAMES=100000): pools in order, memory flat, pictures exact
# make fuzz   broken input for long (MINUTES=60); what it finds is kept in tests/fuzz/found
# make asan   the op tests and hostile calls with AddressSanitizer and UndefinedBehaviorSanitizer; make tsan: threads
# make lint   ruff, mypy, clang-format
# make gallery  every picture of an example in docs/images, made again
# make bench  every workload on this machine, beside peers: docs/performance (ARGS=--quick: tiny sizes)
# make wheel  one wheel for every Python >= 3.11, every torch >= 2.11 and every card, with a manylinux tag, in dist/
#
# Torch is pinned in pyproject.toml ([build-system] requires) and nowhere else, the rest in .ci/constraints.txt.

# What is compiled is compiled while packages are being installed.
MAKEFLAGS += -j4
PYTHON ?= python3
VENV := .venv
COMMA := ,
SOURCES := $(wildcard gvtorch/cpp_ext/csrc/*.* gvtorch/cpp_ext/csrc/*/*)
BIN := $(VENV)/bin
COMPILE := gvtorch/cpp_ext/libraries.py gvtorch/cpp_ext/compilers.py
PACKETS := gvtorch/cpp_ext/lib/packet.baseline.o
TORCH := $(shell sed -n 's/.*"\(torch==[0-9.]*\)".*/\1/p' pyproject.toml)
NATIVE := $(shell nvidia-smi --query-gpu=compute_cap --format=csv,noheader 2>/dev/null | sort -u | tr -d . | paste -sd ';')
# A development build compiles CUDA for the cards that are here; without one, for one architecture, to see it compile.
# What must have run, or the tests have failed; OpenGL in software and the browser are the
# system's (Debian: libegl1, libgl1-mesa-dri; chromium). With CI set, both must be there.
REQUIRE := reference,cpp,io$(if $(CI)$(shell ldconfig -p 2>/dev/null | grep libEGL.so.1),$(COMMA)opengl)
REQUIRE := $(REQUIRE)$(if $(CI)$(shell command -v chromium chromium-browser google-chrome),$(COMMA)browser)
# Of 16,000 files of Python, those that are imported are compiled then; all at once would take a minute. The pip that
# Python brings may be years old and take three times as long to find what fits together.
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint .ci/constraints.txt
ARCHS_GIVEN := $(GVTORCH_CUDA_ARCHS)
export GVTORCH_CUDA_ARCHS ?= $(or $(NATIVE),90)
# Containers often set this; the tests' many processes would each compile all of gvtorch's Python.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo gallery test soak fuzz asan tsan lint format bench wheel clean
.DELETE_ON_ERROR:

# The scan as a store on disk, seen through a brick pool an eighth of its size in bricks.
SCAN := examples/data/stent_256x128x128_int16.npz
demo: $(VENV)/ready
	@mkdir -p out
	@rm -rf out/stent.zarr
	$(BIN)/gvtorch convert $(SCAN) out/stent.zarr
	$(BIN)/gvtorch render out/stent.zarr --brick-pool "2.2 MB" --tf examples/data/stent.json \
	  --camera look:-260,-340,190,63.5,63.5,127.5 --up 0,0,1 --background 0.02,0.02,0.03 -o out/demo.png
	@echo "The picture: $(CURDIR)/out/demo.png"

# Without the film, and without the stars, which are those of a catalogue there.
gallery: $(VENV)/ready
	for name in $(filter-out mandelbulb_film stars,$(basename $(notdir $(wildcard examples/*.py)))); do \
	  $(BIN)/python examples/$$name.py --output docs/images/$$name.png || exit; \
	done

# glibc would hand each large tensor's memory back to the system, and the next one would wait for it to be cleared: kept,
# the tests take a seventh less time.
KEEP := MALLOC_MMAP_THRESHOLD_=1000000000 MALLOC_TRIM_THRESHOLD_=4000000000
# Tests wait for browsers, servers and processes of their own (with three at a time, two cores were idle for a sixth of the
# time): two more at a time than there are cores, but at most 4.
WORKERS := $(shell n=$$(getconf _NPROCESSORS_ONLN); echo $$((n < 2 ? 3 : 4)))
test: $(VENV)/ready
	OMP_NUM_THREADS=1 $(KEEP) GVTORCH_REQUIRE=$(REQUIRE) $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal \
	  --durations 20 --durations-min 5 $(ARGS)

FRAMES ?= 100000
soak: $(VENV)/ready
	OMP_NUM_THREADS=1 GVTORCH_SOAK=$(FRAMES) $(BIN)/python -m pytest -s tests/test_soak.py

MINUTES ?= 60
fuzz: $(VENV)/ready
	OMP_NUM_THREADS=1 GVTORCH_FUZZ=$(MINUTES) $(BIN)/python -m pytest -s tests/fuzz tests/test_viewer_messages.py

# The CPU library once more, watched, in a folder of its own. Python is not, so what it leaks does not count; torch and its
# OpenMP are not, so that ThreadSanitizer watches threads of Python's (tests/fuzz/tsan.txt).
WATCHED := tests/test_words.py tests/fuzz tests/test_cache_ops.py tests/test_packets.py tests/test_segments.py
asan: $(VENV)/ready
	$(BIN)/python tests/fuzz/sanitized.py address $(WATCHED) $(ARGS)
tsan: $(VENV)/ready
	$(BIN)/python tests/fuzz/sanitized.py thread tests/test_threads.py $(ARGS)

lint: $(VENV)/packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run --Werror $(SOURCES) $(wildcard gvtorch/bench/*.h tests/cpp/* examples/*.h)

format: $(VENV)/packages
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(SOURCES) $(wildcard gvtorch/bench/*.h tests/cpp/* examples/*.h)

bench: $(VENV)/bench
	for device in cpu $(if $(NATIVE),cuda); do $(BIN)/gvtorch bench all --device $$device -o docs/performance $(ARGS) || exit; done
	$(BIN)/python benchmarks/plots.py

# Without GVTORCH_CUDA_ARCHS, for all architectures that libraries.py names. auditwheel finds the oldest glibc that has what
# the libraries use, and names it in the tag; torch's own libraries are those of the torch that is installed.
wheel: export GVTORCH_CUDA_ARCHS := $(ARCHS_GIVEN)
wheel: $(VENV)/ready
	rm -rf build/wheel
	$(BIN)/python -m build --wheel --no-isolation --outdir build/wheel
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m auditwheel repair --exclude 'libtorch*' --exclude 'libc10*' \
	  --wheel-dir dist build/wheel/*.whl

clean:
	rm -rf $(VENV) build dist out gvtorch/cpp_ext/lib *.egg-info

$(VENV)/torch: pyproject.toml .ci/constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gvtorch needs Python 3.11 or newer, this is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) setuptools wheel "$(TORCH)"
	@touch $@

# Installed without what is compiled, which is done side by side.
$(VENV)/packages: $(VENV)/torch
	GVTORCH_COMPILE=0 $(PIP) --no-build-isolation -e ".[dev]"
	@touch $@

# Packets need nothing of torch: they are compiled while it is being installed.
$(PACKETS): $(SOURCES) $(COMPILE)
	$(PYTHON) gvtorch/cpp_ext/libraries.py packets
	@touch $@

# These need torch, and are compiled while the last packets still are.
$(VENV)/objects: $(VENV)/torch $(SOURCES) $(COMPILE)
	$(BIN)/python gvtorch/cpp_ext/libraries.py objects
	@touch $@

$(VENV)/cpu: $(VENV)/objects $(PACKETS)
	$(BIN)/python gvtorch/cpp_ext/libraries.py cpu
	@touch $@

$(VENV)/cuda: $(VENV)/torch $(SOURCES) $(COMPILE)
	$(BIN)/python gvtorch/cpp_ext/libraries.py cuda
	@touch $@

$(VENV)/ready: $(VENV)/cuda $(VENV)/packages $(VENV)/cpu
	@touch $@

$(VENV)/bench: $(VENV)/ready
	$(PIP) --no-build-isolation -e ".[dev,bench]"
	@touch $@
