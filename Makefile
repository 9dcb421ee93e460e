# Everything runs in the project's own virtual environment; the only needs are Python 3.11 and make.
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
# Each test starts processes, which would compile all modules anew
unexport PYTHONDONTWRITEBYTECODE
ON_EACH_CHANGE := not slow and not faults and not onroad

.PHONY: picture setup lock newest browser exiftool test test-cpus test-cpus-sample test-slow pythons wheel-test index-test fuzz faults onroad perf lint types train demo demo-kitti clean

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

# The versions that tests and CI install, with hashes for every platform, from the ranges in pyproject.toml
lock: setup
	$(PIP) uv
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --python-version 3.11 --extra dev pyproject.toml -o requirements.lock

# `make test` with the newest versions that the ranges allow
newest:
	$(MAKE) --no-print-directory test LOCK= VENV=.venv-newest

# For the tests of pages that a browser draws: Debian's, which root may install; without one they skip, and say so
browser:
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null \
		|| { test "$$(id -u)" = 0 && command -v apt-get >/dev/null \
			&& apt-get update -q && apt-get install -qy --no-install-recommends chromium; } \
		|| echo "no Chromium: tests of pages in a browser will skip (Debian, as root: apt-get install chromium)"

# For the tests of GNSS tracks inside films
exiftool:
	@command -v exiftool >/dev/null \
		|| { test "$$(id -u)" = 0 && command -v apt-get >/dev/null \
			&& apt-get update -q && apt-get install -qy --no-install-recommends libimage-exiftool-perl; } \
		|| echo "no ExifTool: tests of GNSS tracks in films will skip (Debian, as root: apt-get install libimage-exiftool-perl)"

# First the tests that compute, one on each core; then those that start processes and wait for them, three at a time
test: browser exiftool setup
	@$(BIN)/python -m tests.run

# The tests that compute under the kernels of other processors, or VARIANT="NAME,..."; perf/accuracy/cpus.py lists them
test-cpus: setup
	@$(BIN)/python -m tests.run --cpus "$(VARIANT)"

# Of that a sample, for CI
test-cpus-sample: setup
	@$(BIN)/python -m tests.run --sample

# Then property tests with examples that are new each time
test-slow: setup
	$(BIN)/python -m pytest -m slow
	$(BIN)/python -m pytest -n $(CORES) --dist worksteal -m 'hypothesis and $(ON_EACH_CHANGE)' --hypothesis-profile=explore

# The demo and the tests on each Python that answers here, each in an environment of its own
pythons:
	@for version in $(PYTHONS); do \
		python$$version -c '' 2>/dev/null || { echo "no Python $$version here"; continue; }; \
		$(MAKE) --no-print-directory demo test PYTHON=python$$version VENV=.venv-$$version || exit 1; \
	done

# What a user installs: the wheel in an empty environment, without the checkout
wheel-test: setup
	$(BIN)/python -m tests.installed_wheel

# The same without an installation: uvx and pipx, from an index of this computer, on each Python that is here
index-test: setup
	$(BIN)/python -m tests.installed_index

# docs/ as a site, in out/site; a broken link fails it
site: $(SITE_VENV)/.ready
	NO_MKDOCS_2_WARNING=1 $(SITE_VENV)/bin/mkdocs build --strict --quiet

$(SITE_VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(SITE_VENV)
	$(SITE_VENV)/bin/python -m pip install --quiet --disable-pip-version-check '.[site]'
	@touch $@

# Wheel, source distribution, the list of what is in them and their digests, in out/dist: docs/deployment.md
dist: $(DIST_VENV)/.ready
	$(DIST_VENV)/bin/python .ci/dist.py out/dist

$(DIST_VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(DIST_VENV)
	$(DIST_VENV)/bin/python -m pip install --quiet --disable-pip-version-check build 'setuptools>=77' cyclonedx-bom
	@touch $@

# A million mutated messages, references and files; FUZZ_SEED=N gives others.
fuzz: setup
	$(BIN)/python -m tests.fuzz --cases 1000000 --seed $(or $(FUZZ_SEED),6)

# Every fault on a running vehicle: out/faults.md
faults: setup
	$(BIN)/python -m perf faults --markdown out/faults.md

# The budgets of the running system, on a machine that does nothing else
onroad: setup
	$(BIN)/python -m pytest -m onroad

# What the system does on this machine: out/perf/report.md
perf: setup
	$(BIN)/python -m perf all --output out/perf

# The shipped networks from their seed, on the built-in world alone: hours on four cores; what was begun goes on
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

# mypy sees the packages as they are installed, with runtime/ and perf/ inside birdslam/
types: setup
	rm -rf $(TYPES) && mkdir -p $(TYPES)/birdslam
	ln -s $(CURDIR)/birdslam/* $(CURDIR)/runtime $(CURDIR)/perf $(TYPES)/birdslam/
	cd $(TYPES) && $(CURDIR)/$(BIN)/mypy --config-file $(CURDIR)/pyproject.toml --cache-dir $(CURDIR)/.mypy_cache

# The drive that ships with birdslam: the three processes at its 33 Hz, then how good it was, bev.png and drive.mp4
demo: setup
	$(BIN)/birdslam run --source demo --output out/demo

# The moving picture of the README
picture: setup
	$(BIN)/birdslam run --source demo --rate max --set source.frames=420 --output out/picture --video out/picture/drive.mp4
	$(BIN)/python docs/animation.py out/picture/drive.mp4 docs/drive.webp 40 210

# The main job on a real sequence
demo-kitti: setup
	@test -d $(DATA)/kitti_odometry/sequences/00 || { echo "make demo-kitti needs KITTI odometry 00 in $(DATA)/kitti_odometry/sequences/00 (set BIRDSLAM_DATA)"; exit 1; }
	@test -f $(MODELS)/yolox_nano_416.onnx && test -f $(MODELS)/twinlitenet_640x360.onnx || { echo "make demo-kitti needs yolox_nano_416.onnx and twinlitenet_640x360.onnx in $(MODELS) (set BIRDSLAM_MODELS)"; exit 1; }
	$(BIN)/birdslam run --source kitti:$(DATA)/kitti_odometry/sequences/00 --model detector=$(MODELS)/yolox_nano_416.onnx \
		--model segmenter=$(MODELS)/twinlitenet_640x360.onnx --output out/00

clean:
	rm -rf $(VENV) $(TRAIN_VENV) $(SITE_VENV) $(DIST_VENV) $(PYTHONS:%=.venv-%) out build *.egg-info
