# Requires Python 3.11 or newer and make. Everything runs in a virtual environment of the project.
PYTHON ?= python3
PYTHONS := 3.11 3.12 3.13
VENV := .venv
BIN := $(VENV)/bin
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
LOCK ?= requirements.lock
TRAIN_VENV := .venv-train
SITE_VENV := .venv-site
DIST_VENV := .venv-dist
TYPES := out/types
DATA := $(or $(BIRDSLAM_DATA),../shared/data)
MODELS := $(or $(BIRDSLAM_MODELS),../shared/models)

CORES := $(or $(shell nproc 2>/dev/null),2)
# Bytecode is written, because tests start processes that would compile all modules again
unexport PYTHONDONTWRITEBYTECODE
ON_EACH_CHANGE := not slow and not faults and not onroad

.PHONY: picture setup lock newest browser exiftool test test-cpus test-cpus-sample test-slow pythons wheel-test index-test fuzz faults onroad perf perf-check lint types train demo demo-kitti clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml setup.py $(LOCK)
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing; as root: apt-get install python3-venv, or set PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "birdslam needs Python 3.11 or newer; set PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { test "$$(id -u)" = 0 && apt-get update -q && apt-get install -qy python3-venv; } \
		|| { echo "Python's venv module is missing; as root: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@$(PIP) $(if $(LOCK),--require-hashes -r $(LOCK),-e '.[dev]') \
		|| { echo "pip can't install $(or $(LOCK),the newest packages): is its index reachable? PIP_INDEX_URL names another"; exit 1; }
	@$(PIP) --no-deps --no-build-isolation -e .
	@touch $@

# Pins the versions for tests and CI, with hashes for every platform, within the ranges of pyproject.toml
lock: setup
	$(PIP) uv
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --python-version 3.11 --extra dev pyproject.toml -o requirements.lock

# `make test` with the newest versions within the ranges
newest:
	$(MAKE) --no-print-directory test LOCK= VENV=.venv-newest

# Installs Chromium for tests of pages in a browser (Debian, as root); without it these tests skip
browser:
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null \
		|| { test "$$(id -u)" = 0 && command -v apt-get >/dev/null \
			&& apt-get update -q && apt-get install -qy --no-install-recommends chromium; } \
		|| echo "no Chromium: tests of pages in a browser skip (Debian, as root: apt-get install chromium)"

# Installs ExifTool for tests of GNSS tracks in films (Debian, as root); without it these tests skip
exiftool:
	@command -v exiftool >/dev/null \
		|| { test "$$(id -u)" = 0 && command -v apt-get >/dev/null \
			&& apt-get update -q && apt-get install -qy --no-install-recommends libimage-exiftool-perl; } \
		|| echo "no ExifTool: tests of GNSS tracks skip (Debian, as root: apt-get install libimage-exiftool-perl)"

# Runs computing tests first, one per core, then tests that start processes, four at a time
test: browser exiftool setup
	@$(BIN)/python -m tests.run

# Runs computing tests with the kernels of other processors, or of VARIANT="NAME,..." (tests/run.py)
test-cpus: setup
	@$(BIN)/python -m tests.run --cpus "$(VARIANT)"

# The same for a sample of tests, for CI
test-cpus-sample: setup
	@$(BIN)/python -m tests.run --sample

# Runs slow tests, then property tests with random examples
test-slow: setup
	$(BIN)/python -m pytest -m slow
	$(BIN)/python -m pytest -n $(CORES) --dist worksteal -m 'hypothesis and $(ON_EACH_CHANGE)' --hypothesis-profile=explore

# Runs the demo and the tests on each installed Python, in separate environments
pythons:
	@for version in $(PYTHONS); do \
		python$$version -c '' 2>/dev/null || { echo "Python $$version is not installed"; continue; }; \
		$(MAKE) --no-print-directory demo test PYTHON=python$$version VENV=.venv-$$version || exit 1; \
	done

# Tests the wheel in an empty environment without the checkout
wheel-test: setup
	$(BIN)/python -m tests.installed_wheel

# Tests uvx and pipx with a local index, on each installed Python
index-test: setup
	$(BIN)/python -m tests.installed_index

# Builds docs/ as a site in out/site; broken links are errors
site: $(SITE_VENV)/.ready
	NO_MKDOCS_2_WARNING=1 $(SITE_VENV)/bin/mkdocs build --strict --quiet

$(SITE_VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(SITE_VENV)
	$(SITE_VENV)/bin/python -m pip install --quiet --disable-pip-version-check '.[site]'
	@touch $@

# Builds wheel, source distribution, bill of materials and digests in out/dist (docs/deployment.md)
dist: $(DIST_VENV)/.ready
	$(DIST_VENV)/bin/python .ci/dist.py out/dist

$(DIST_VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(DIST_VENV)
	$(DIST_VENV)/bin/python -m pip install --quiet --disable-pip-version-check build 'setuptools>=77' cyclonedx-bom
	@touch $@

# Decodes a million mutated messages, references and files; FUZZ_SEED=N changes them
fuzz: setup
	$(BIN)/python -m tests.fuzz --cases 1000000 --seed $(or $(FUZZ_SEED),6)

# Injects every fault into a running vehicle: out/faults.md
faults: setup
	$(BIN)/python -m perf faults --markdown out/faults.md

# Tests the budgets of the running system, on an otherwise idle machine
onroad: setup
	$(BIN)/python -m pytest -m onroad

# Runs all benchmarks on this machine: out/perf/report.md
perf: setup
	$(BIN)/python -m perf all --output out/perf

# Compares the times of this checkout with those of another commit, measured in turn; fails where it is 15 % slower
perf-check: setup
	$(BIN)/python -m perf check --base $(or $(BASE),HEAD^)

# Trains the shipped networks from a seed on the built-in world (hours on four cores); continues an interrupted run
train: $(TRAIN_VENV)/.ready
	$(TRAIN_VENV)/bin/python -m birdslam.runtime.world.train --output out/train
	$(TRAIN_VENV)/bin/python -m birdslam.runtime.world.quantise out/train/multitask.onnx
	$(TRAIN_VENV)/bin/python -m birdslam.runtime.world.train_lanes
	$(TRAIN_VENV)/bin/python -m birdslam.runtime.world.train_pointnet --output out/train/pointnet --ship
	cp out/train/multitask.onnx out/train/multitask.toml out/train/multitask_int8.onnx out/train/multitask_int8.toml birdslam/perception/shipped/

$(TRAIN_VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(TRAIN_VENV)
	$(TRAIN_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -e '.[train]'
	@touch $@

lint: setup types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Checks types of the packages as installed, with runtime/ and perf/ inside birdslam/
types: setup
	rm -rf $(TYPES) && mkdir -p $(TYPES)/birdslam
	ln -s $(CURDIR)/birdslam/* $(CURDIR)/runtime $(CURDIR)/perf $(TYPES)/birdslam/
	cd $(TYPES) && $(CURDIR)/$(BIN)/mypy --config-file $(CURDIR)/pyproject.toml --cache-dir $(CURDIR)/.mypy_cache

# Runs the three processes at 33 Hz on the shipped drive; prints its errors and writes bev.png
demo: setup
	$(BIN)/birdslam run --source demo --output out/demo

# Renders the animation of the README
picture: setup
	$(BIN)/birdslam run --source demo --rate max --set source.frames=420 --output out/picture --video out/picture/drive.mp4
	$(BIN)/python docs/animation.py out/picture/drive.mp4 docs/drive.webp 40 210

# Runs on KITTI odometry 00 with two networks
demo-kitti: setup
	@test -d $(DATA)/kitti_odometry/sequences/00 || { echo "make demo-kitti needs KITTI odometry 00 in $(DATA)/kitti_odometry/sequences/00 (set BIRDSLAM_DATA)"; exit 1; }
	@test -f $(MODELS)/yolox_nano_416.onnx && test -f $(MODELS)/twinlitenet_640x360.onnx || { echo "make demo-kitti needs yolox_nano_416.onnx and twinlitenet_640x360.onnx in $(MODELS) (set BIRDSLAM_MODELS)"; exit 1; }
	$(BIN)/birdslam run --source kitti:$(DATA)/kitti_odometry/sequences/00 --model detector=$(MODELS)/yolox_nano_416.onnx \
		--model segmenter=$(MODELS)/twinlitenet_640x360.onnx --output out/00

clean:
	rm -rf $(VENV) $(TRAIN_VENV) $(SITE_VENV) $(DIST_VENV) $(PYTHONS:%=.venv-%) out build *.egg-info
